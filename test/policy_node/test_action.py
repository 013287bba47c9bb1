from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import PERIOD_NS, TOPIC_MAP, demonstration

from curation_ros.core.errors import PolicyError
from policy_node.action import ActionSpec


def with_commands(episode, **fields):
    return replace(episode, fields={**episode.fields, **fields})


def test_scale_round_trip():
    episode, action = demonstration(0), ActionSpec(0.2)
    targets = action.targets(episode)
    assert targets.shape == (60, 4)
    commands = [action.command(row) for row in targets]
    np.testing.assert_allclose([xyz for xyz, _ in commands], episode.fields["twist"], atol=1e-12)
    np.testing.assert_array_equal([g for _, g in commands], episode.fields["gripper"][:, 0])


def test_faster_commands_are_clipped_and_counted():
    twist = np.zeros((60, 3))
    twist[:6, 0] = 0.5
    twist[6:12, 1] = 0.2
    episode, action = with_commands(demonstration(0), twist=twist), ActionSpec(0.2)
    assert np.abs(action.targets(episode)).max() == 1.0
    assert action.clipped_fraction(episode) == pytest.approx(6 / 180)


def test_hold_takes_the_last_command_even_from_before_the_span():
    gripper = np.zeros((60, 1))
    gripper[10], gripper[40] = 1.0, -1.0
    episode = with_commands(demonstration(0), gripper=gripper)
    targets = ActionSpec().targets(episode)[:, 3]
    assert (targets[:10] == 0).all()
    assert (targets[10:40] == 1).all()
    assert (targets[40:] == -1).all()
    cut = ActionSpec().targets(episode, (21 * PERIOD_NS, 30 * PERIOD_NS))
    assert (cut[:, 3] == 1).all()


@pytest.mark.parametrize(("output", "gripper"), [(-0.2, -1.0), (0.7, 1.0), (0.0, 0.0)])
def test_gripper_is_the_sign_of_the_output_and_zero_holds(output, gripper):
    assert ActionSpec().command(np.array([0.0, 0.0, 0.0, output]))[1] == gripper


def test_gripper_that_opens_the_other_way_is_refused():
    gripper = replace(TOPIC_MAP.gripper, opens=1, open_value=1.0, closed_value=-1.0)
    for other in (gripper, None):
        with pytest.raises(PolicyError, match=r"expected \(-1.0, 1.0\)"):
            ActionSpec().check(replace(TOPIC_MAP, gripper=other), "policy x")


def test_twist_in_metres_is_refused():
    fields = {**TOPIC_MAP.fields, "twist": replace(TOPIC_MAP.fields["twist"], unit="m/s")}
    with pytest.raises(PolicyError, match="3 unitless values, found 3 in 'm/s'"):
        ActionSpec().check(replace(TOPIC_MAP, fields=fields), "policy x")


def test_twist_that_is_not_finite_is_refused_inside_the_span_only():
    twist = np.zeros((60, 3))
    twist[50, 2] = np.inf
    episode = with_commands(demonstration(0), twist=twist)
    with pytest.raises(PolicyError, match="twist in row 50 is not finite"):
        ActionSpec().targets(episode)
    assert len(ActionSpec().targets(episode, (0, 30 * PERIOD_NS))) == 30


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_scale_out_of_range_is_refused(scale):
    with pytest.raises(PolicyError, match="action scale"):
        ActionSpec(scale)
