from __future__ import annotations

import numpy as np
import pytest
from demonstrations import VARIANTS, demonstration, step_values
from mlps import mlp
from toy_policies import ChunkedPolicy, ImagePolicy, image_steps

from curation_ros.core.errors import PolicyError
from policy_node.controller import PolicyController


def observations(n=9, seed=1):
    episode = demonstration(seed)
    return [step_values(episode, 5 * k) for k in range(n)]


#: What makes a policy, and observations for it.
KINDS = {
    **{f"mlp {name}": (lambda name=name: mlp(name), observations()) for name in VARIANTS},
    "chunked": (ChunkedPolicy, observations()),
    "chunked, ensembles": (lambda: ChunkedPolicy(ensembles=True), observations()),
    "image": (ImagePolicy, image_steps(9)),
}
kinds = pytest.mark.parametrize("kind", KINDS)


def alone(policy, steps):
    """Commands of a policy that sees each step once."""
    policy.reset()
    commands = []
    for values in steps:
        policy.observe(values)
        commands.append(policy.act())
    return commands


def assert_equal(found, expected):
    assert len(found) == len(expected)
    for a, b in zip(found, expected, strict=True):
        assert a.keys() == b.keys()
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])


@kinds
def test_controller_gives_the_commands_of_the_policy(kind):
    make, steps = KINDS[kind]
    controller = PolicyController(make())
    answers = [controller.answer(100 + 50 * k, values) for k, values in enumerate(steps)]
    assert_equal(answers, alone(make(), steps))
    moving = {name: [a[name] for a in answers] for name in answers[0]}
    assert any(np.ptp(values, axis=0).max() > 0.0 for values in moving.values())


@kinds
def test_repeated_step_gets_the_same_command_and_the_next_one_is_not_disturbed(kind):
    make, steps = KINDS[kind]
    controller = PolicyController(make())
    answers = []
    for k, values in enumerate(steps):
        again = [controller.answer(k, values) for _ in range(3)]
        assert_equal(again[1:], again[:-1])
        answers.append(again[0])
    assert_equal(answers, alone(make(), steps))


@kinds
def test_reset_begins_another_episode(kind):
    make, steps = KINDS[kind]
    controller = PolicyController(make())
    for k, values in enumerate(steps[4:]):
        controller.answer(k, values)
    controller.reset()
    answers = [controller.answer(k, values) for k, values in enumerate(steps)]
    assert_equal(answers, alone(make(), steps))


@kinds
def test_step_that_is_refused_may_be_tried_again(kind):
    make, steps = KINDS[kind]
    controller = PolicyController(make())
    lacking = controller.policy.observed[0]
    answers = []
    for k, values in enumerate(steps):
        with pytest.raises(PolicyError, match=f"no field '{lacking}'"):
            controller.answer(k, {n: v for n, v in values.items() if n != lacking})
        answers.append(controller.answer(k, values))
    assert_equal(answers, alone(make(), steps))


def test_policy_that_drove_before_begins_anew():
    policy, steps = ChunkedPolicy(), observations()
    alone(policy, steps[:3])
    controller = PolicyController(policy)
    answers = [controller.answer(k, values) for k, values in enumerate(steps)]
    assert_equal(answers, alone(ChunkedPolicy(), steps))


def test_step_of_the_past_is_refused():
    controller, steps = PolicyController(ChunkedPolicy()), observations()
    controller.answer(7, steps[0])
    with pytest.raises(PolicyError, match="step 6 comes after step 7"):
        controller.answer(6, steps[1])


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ({"twist": np.zeros(3)}, "its command has twist, expected twist, gripper"),
        (
            {"twist": np.array([0.0, np.nan, 0.0]), "gripper": np.ones(1)},
            "its command twist is .*, expected finite numbers",
        ),
    ],
)
def test_command_that_is_none_is_refused_each_time(command, words):
    class Wrong(ChunkedPolicy):
        def act(self):
            return command

    controller = PolicyController(Wrong())
    for _ in range(2):
        with pytest.raises(PolicyError, match=words):
            controller.answer(0, observations()[0])
