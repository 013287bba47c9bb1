from __future__ import annotations

import numpy as np
import pytest
from demonstrations import demonstration, step_values
from test_policy import policy

from curation_ros.core.errors import PolicyError
from policy_node.controller import PolicyController
from policy_node.observation import VARIANTS, ObservationSpec


@pytest.mark.parametrize("variant", VARIANTS)
def test_controller_sees_what_training_saw(variant):
    made, episode = policy(variant=variant), demonstration(1)
    controller = PolicyController(made)
    for k, row in enumerate(ObservationSpec(variant).from_episode(episode)):
        xyz, gripper = controller.act(step_values(episode, k), int(episode.fields["phase"][k, 0]))
        expected = made.act(row)
        np.testing.assert_array_equal(xyz, expected[0])
        assert gripper == expected[1]


def test_start_is_kept_until_reset():
    made = policy()
    controller = PolicyController(made)
    first, other = step_values(demonstration(1), 0), step_values(demonstration(2), 0)
    controller.act(first, 0)
    held, _ = controller.act(other, 0)
    again, _ = controller.act(other, 0)
    np.testing.assert_array_equal(held, again)
    controller.reset()
    fresh, _ = controller.act(other, 0)
    assert not np.array_equal(held, fresh)
    np.testing.assert_array_equal(
        fresh, made.act(ObservationSpec().from_step({**other, "phase": [0]}, other))[0]
    )


def test_start_is_a_copy():
    controller = PolicyController(policy())
    values = {k: v.copy() for k, v in step_values(demonstration(1), 0).items()}
    first, _ = controller.act(values, 0)
    values["bowl_position"] += 1.0
    second, _ = controller.act(values, 0)
    np.testing.assert_array_equal(first, second)


def test_missing_field_is_named_and_a_failed_first_step_is_not_remembered():
    controller = PolicyController(policy())
    values = step_values(demonstration(1), 0)
    with pytest.raises(PolicyError, match="no field 'plate_position'"):
        controller.act({k: v for k, v in values.items() if k != "plate_position"}, 0)
    with pytest.raises(PolicyError, match="is nan"):
        controller.act({**values, "bowl_position": np.full(3, np.nan)}, 0)
    with pytest.raises(PolicyError, match="phase index"):
        controller.act({**values, "bowl_position": np.ones(3)}, 9)
    xyz, _ = controller.act(values, 0)
    np.testing.assert_array_equal(xyz, PolicyController(policy()).act(values, 0)[0])
