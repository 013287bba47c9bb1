from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import PERIOD_NS, RELATIVE, TOPIC_MAP, demonstration

from curation_ros.core.errors import PolicyError
from policy_node.action import ActionSpec, CommandTerm, action_from_json, action_spec
from policy_node.commands import GripperCommand, ScaledCommand


def with_commands(episode, **fields):
    return replace(episode, fields={**episode.fields, **fields})


def libero(scale=0.2):
    """Twist and gripper, as the variants of LIBERO have them."""
    return ActionSpec(
        (ScaledCommand("twist", "1", (scale,) * 3, (0.0,) * 3), GripperCommand("gripper"))
    )


def targets_of(action, episode, span=None):
    """What the network should answer."""
    return np.clip(action.scaled(episode, span), -1.0, 1.0)


def with_gripper(**changes):
    return replace(TOPIC_MAP, gripper=replace(TOPIC_MAP.gripper, **changes))


def test_variant_of_libero_is_twist_and_gripper():
    assert action_spec(RELATIVE.action, TOPIC_MAP, (), "x") == libero()


def test_scale_round_trip():
    episode, action = demonstration(0), libero()
    targets = targets_of(action, episode)
    assert targets.shape == (60, action.width) == (60, 4)
    commands = [action.command(row) for row in targets]
    twists = [command["twist"] for command in commands]
    np.testing.assert_allclose(twists, episode.fields["twist"], atol=1e-12)
    grippers = [command["gripper"] for command in commands]
    np.testing.assert_array_equal(grippers, episode.fields["gripper"])


def test_faster_commands_are_clipped_and_counted_per_field():
    twist = np.zeros((60, 3))
    twist[:6, 0] = 0.5
    twist[6:12, 1] = 0.2
    episode, action = with_commands(demonstration(0), twist=twist), libero()
    assert np.abs(targets_of(action, episode)).max() == 1.0
    assert action.clipped_shares(action.scaled(episode)) == {"twist": pytest.approx(6 / 180)}


def test_hold_takes_the_last_command_even_from_before_the_span():
    gripper = np.zeros((60, 1))
    gripper[10], gripper[40] = 1.0, -1.0
    episode = with_commands(demonstration(0), gripper=gripper)
    targets = targets_of(libero(), episode)[:, 3]
    assert (targets[:10] == 0).all()
    assert (targets[10:40] == 1).all()
    assert (targets[40:] == -1).all()
    cut = targets_of(libero(), episode, (21 * PERIOD_NS, 30 * PERIOD_NS))
    assert (cut[:, 3] == 1).all()


@pytest.mark.parametrize(("output", "gripper"), [(-0.2, -1.0), (0.7, 1.0), (0.0, 0.0)])
def test_gripper_is_the_sign_of_the_output_and_zero_holds(output, gripper):
    assert libero().command(np.array([0.0, 0.0, 0.0, output]))["gripper"].tolist() == [gripper]


def test_gripper_is_commanded_in_the_numbers_of_the_robot():
    """Continuous, 0.08 open to 0 closed: the targets are those of any other gripper."""
    topic_map = with_gripper(kind="continuous", opens=1, open_value=0.08, closed_value=0.0)
    command = np.full((60, 1), 0.08)
    command[20:40] = 0.002
    episode = replace(with_commands(demonstration(0), gripper=command), topic_map=topic_map)
    action = action_spec([CommandTerm("gripper")], topic_map, (), "x")
    targets = targets_of(action, episode)
    assert targets[:20].tolist() == [[-1.0]] * 20
    assert targets[20:40].tolist() == [[1.0]] * 20
    answers = [action.command(np.array([output]))["gripper"] for output in (-1.0, 1.0, 0.0)]
    assert [answer.tolist() for answer in answers] == [[0.08], [0.0], [0.04]]


def test_gripper_with_other_numbers_is_refused():
    for other in (with_gripper(opens=1, open_value=1.0, closed_value=-1.0),):
        with pytest.raises(PolicyError, match="-1 open to 1 closed") as caught:
            libero().check(other, "policy x")
        assert "1 open to -1 closed" in str(caught.value)
    with pytest.raises(PolicyError, match="gripper is None, expected binary 'gripper'"):
        libero().check(replace(TOPIC_MAP, gripper=None), "policy x")


def test_command_in_another_unit_or_width_is_refused():
    for change, found in (
        ({"unit": "m/s"}, "3 values in 'm/s'"),
        ({"values": ("a",)}, "1 values in '1'"),
    ):
        fields = {**TOPIC_MAP.fields, "twist": replace(TOPIC_MAP.fields["twist"], **change)}
        with pytest.raises(PolicyError, match=f"has {found}, expected 3 in '1'"):
            libero().check(replace(TOPIC_MAP, fields=fields), "policy x")


def test_twist_that_is_not_finite_is_refused_inside_the_span_only():
    twist = np.zeros((60, 3))
    twist[50, 2] = np.inf
    episode = with_commands(demonstration(0), twist=twist)
    with pytest.raises(PolicyError, match="twist in row 50 is not finite"):
        targets_of(libero(), episode)
    assert len(targets_of(libero(), episode, (0, 30 * PERIOD_NS))) == 30
    term = CommandTerm("twist")
    with pytest.raises(PolicyError, match="twist in row 50 is not finite"):
        action_spec([term], TOPIC_MAP, [(episode, None)], "x")
    action_spec([term], TOPIC_MAP, [(episode, (0, 30 * PERIOD_NS))], "x")


@pytest.mark.parametrize("scale", [0.0, -1.0, float("inf"), float("nan")])
def test_scale_out_of_range_is_refused(scale):
    with pytest.raises(PolicyError, match="command 'twist': scale is"):
        libero(scale)


# --- any commands ---------------------------------------------------------------------------


def test_scale_from_the_demonstrations_fills_each_value_and_clips_nothing():
    twist = np.zeros((60, 3))
    twist[5], twist[7] = [0.1, -2.0, 0.0], [-0.4, 1.0, 0.0]
    episode = with_commands(demonstration(0), twist=twist)
    action = action_spec([CommandTerm("twist")], TOPIC_MAP, [(episode, None)], "x")
    assert action.commands[0].scale == (0.4, 2.0, 1.0)  # a value that never moves keeps 1
    assert action.commands[0].center == (0.0, 0.0, 0.0)
    assert action.clipped_shares(action.scaled(episode)) == {"twist": 0.0}
    first = action_spec([CommandTerm("twist")], TOPIC_MAP, [(episode, (0, 6 * PERIOD_NS))], "x")
    assert first.commands[0].scale == (0.1, 2.0, 1.0)


def test_center_from_the_demonstrations_is_the_middle_of_each_value():
    twist = np.tile([1.0, 5.0, -3.0], (60, 1))
    twist[9], twist[30] = [2.0, 5.0, -3.1], [1.5, 5.0, -2.3]
    episode = with_commands(demonstration(0), twist=twist)
    term = CommandTerm("twist", center=())
    action = action_spec([term], TOPIC_MAP, [(episode, None)], "x")
    np.testing.assert_allclose(action.commands[0].center, [1.5, 5.0, -2.7])
    np.testing.assert_allclose(action.commands[0].scale, [0.5, 1.0, 0.4])
    targets = targets_of(action, episode)
    assert action.clipped_shares(action.scaled(episode)) == {"twist": 0.0}
    commands = [action.command(row)["twist"] for row in targets]
    np.testing.assert_allclose(commands, twist, atol=1e-12)


def test_scale_is_one_number_or_one_per_value():
    term = CommandTerm("twist", scale=(0.1, 0.2, 0.3), center=(1.0, 0.0, 0.0))
    action = action_spec([term], TOPIC_MAP, (), "x")
    command = action.command(np.array([1.0, -1.0, 0.5]))["twist"]
    np.testing.assert_allclose(command, [1.1, -0.2, 0.15])
    with pytest.raises(PolicyError, match="scale of 'twist' has 2 numbers, expected 1 or 3"):
        action_spec([replace(term, scale=(0.1, 0.2))], TOPIC_MAP, (), "x")


@pytest.mark.parametrize(
    ("terms", "words"),
    [
        (["nose"], "no field 'nose', expected a command .* its commands are twist, gripper"),
        (["eef_position"], "role effector for 'eef_position', expected a command"),
        (["gripper", "gripper"], "an action names a field twice: gripper, gripper"),
        ([], "at least one command field"),
        (["twist"], "no step to take the scale of 'twist' from"),
    ],
)
def test_command_that_makes_no_sense_is_refused(terms, words):
    with pytest.raises(PolicyError, match=words) as caught:
        action_spec([CommandTerm(name) for name in terms], TOPIC_MAP, (), "variant x")
    assert str(caught.value).startswith("variant x: ")


def test_gripper_of_two_values_is_refused():
    fields = dict(TOPIC_MAP.fields)
    fields["gripper"] = replace(fields["gripper"], values=("position.a", "position.b"))
    with pytest.raises(PolicyError, match="gripper 'gripper' of the topic map has 2 values"):
        libero().check(replace(TOPIC_MAP, fields=fields), "policy x")


# --- on cards -------------------------------------------------------------------------------


def test_plain_data_give_the_same_spec_back():
    assert action_from_json(libero().to_json(), "x") == libero()


@pytest.mark.parametrize(
    "raw",
    [
        None,
        {},
        [],
        [5],
        [{"kind": "scaled", "name": "a"}],
        [{"kind": "scaled", "name": "a", "unit": "", "scale": [0.0], "center": [0.0]}],
        [{"kind": "scaled", "name": "a", "unit": "", "scale": [1.0], "center": []}],
        [{"kind": "scaled", "name": "a", "unit": "", "scale": [1.0], "center": [np.nan]}],
        [{"kind": "gripper", "name": "a", "command": "binary", "open_value": "x"}],
    ],
)
def test_plain_data_of_no_spec_are_refused(raw):
    with pytest.raises(PolicyError, match="card x"):
        action_from_json(raw, "card x")
