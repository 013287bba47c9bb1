"""Conformance of a policy: the rules of `policy_node.policy.Policy`, each one a sentence.

Somebody who writes a policy runs it through `check_policy` in a test of their own:

    def test_my_policy(tmp_path):
        check_policy(make_my_policy, steps, tmp_path)

`steps` are observations of one episode, at least three, as the policy would see them.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.testing.rules import expect, refuses
from policy_node.policy import CARD, Command, Policy, Values

OBSERVED = "`observed` names every field that `observe` needs, and no other."
REFUSED = "An observation without a field of `observed` raises PolicyError."
UNCHANGED = "A refused observation leaves the policy as it was."
NOTHING = "`act` raises PolicyError if nothing was observed since `reset`."
COMMANDED = "`act` answers with a one-dimensional, finite float array per field of `commanded`."
ACT_REPEATS = "`act` gives the same command however often it is called for one observation."
REPEATS = "After `reset` the same observations give the same commands."
SEPARATE = "Two policies share no state."
COPIES = "The policy copies what it keeps of an observation."
LEAVES = "The policy does not change the arrays of an observation."
OWN_ANSWER = "Changing a returned command does not change the next one."
SAVED = "A loaded policy has the card of the saved one, and gives the same commands."
KIND = f"`save` writes {CARD} with the kind and the id of the card."
KEEPS = "`save` raises PolicyError if the folder exists, and leaves it as it is."
LOADS = "`load` raises PolicyError if the folder has no policy."
ACCEPTS = "`check` accepts the topic map of the training."
MISSES = "`check` raises PolicyError if the topic map lacks an observed or commanded field."

_LEAST_STEPS = 3


def check_policy(
    make: Callable[[], Policy],
    steps: Sequence[Values],
    folder: Path,
    topic_map: TopicMap | None = None,
) -> None:
    """Run a policy through the rules.

    Args:
        make: makes the policy; equal each time, and with no state in common.
        steps: observations of one episode that the policy can answer, at least three.
        folder: an empty folder, for policies that are saved.
        topic_map: of the training; None: `check` is not tried.

    Raises:
        AssertionError: with the sentence of the first rule that the policy breaks.
        ValueError: if there are fewer than three steps.
    """
    if len(steps) < _LEAST_STEPS:
        raise ValueError(f"{len(steps)} steps are given, expected at least {_LEAST_STEPS}")
    _check_commands(make(), steps)
    commands = _drive(make(), steps)
    _check_repetition(make, steps, commands)
    _check_observed(make(), steps, commands)
    _check_arrays(make, steps, commands)
    _check_files(make(), steps, commands, folder)
    if topic_map is not None:
        _check_topic_map(make(), topic_map)


def _check_commands(policy: Policy, steps: Sequence[Values]) -> None:
    policy.reset()
    for observation in steps:
        policy.observe({name: np.array(array) for name, array in observation.items()})
        command = policy.act()
        expect(set(command) == set(policy.commanded), COMMANDED)
        for values in command.values():
            is_row = isinstance(values, np.ndarray) and values.ndim == 1
            expect(is_row and values.dtype.kind == "f", COMMANDED)
            expect(bool(np.isfinite(values).all()), COMMANDED)


def _check_observed(policy: Policy, steps: Sequence[Values], commands: Sequence[Command]) -> None:
    needed = [{name: values[name] for name in policy.observed} for values in steps]
    try:
        alone = _drive(policy, needed)
    except (KeyError, PolicyError):
        raise AssertionError(OBSERVED) from None
    expect(_are_equal(alone, commands), OBSERVED)
    for name in policy.observed:
        for k in range(_LEAST_STEPS):
            policy.reset()
            answers = [_answer(policy, values) for values in needed[:k]]
            lacking = {key: values for key, values in needed[k].items() if key != name}
            refuses(partial(policy.observe, lacking), PolicyError, REFUSED)
            answers += [_answer(policy, values) for values in needed[k:]]
            expect(_are_equal(answers, commands), UNCHANGED)


def _check_repetition(
    make: Callable[[], Policy], steps: Sequence[Values], commands: Sequence[Command]
) -> None:
    policy, other = make(), make()
    refuses(policy.act, PolicyError, NOTHING)
    _answer(policy, steps[0])
    policy.reset()
    refuses(policy.act, PolicyError, NOTHING)
    for values, expected in zip(steps, commands, strict=True):
        expect(_are_equal([_answer(policy, values)], [expected]), ACT_REPEATS)
        for _ in range(2):
            expect(_are_equal([policy.act()], [expected]), ACT_REPEATS)
    expect(_are_equal(_drive(policy, steps), commands), REPEATS)
    backwards = _drive(make(), steps[::-1])
    policy.reset()
    other.reset()
    both = [
        (_answer(policy, values), _answer(other, opposite))
        for values, opposite in zip(steps, steps[::-1], strict=True)
    ]
    for answers, expected_ones in zip(zip(*both, strict=True), (commands, backwards), strict=True):
        expect(_are_equal(answers, expected_ones), SEPARATE)


def _check_arrays(
    make: Callable[[], Policy], steps: Sequence[Values], commands: Sequence[Command]
) -> None:
    policy = make()
    reused = {name: np.array(values) for name, values in steps[0].items()}
    answers = []
    for step in steps:
        for name, values in step.items():
            if reused[name].shape != values.shape:
                reused[name] = np.array(values)
            reused[name][...] = values
        policy.observe(reused)
        kept = all(np.array_equal(reused[name], values) for name, values in step.items())
        expect(kept, LEAVES)
        for values in reused.values():
            values[...] = 0
        answer = policy.act()
        answers.append({name: values.copy() for name, values in answer.items()})
        for values in answer.values():
            if values.flags.writeable:
                values += 1.0
        expect(_are_equal([policy.act()], answers[-1:]), OWN_ANSWER)
    expect(_are_equal(answers, commands), COPIES)


def _check_files(
    policy: Policy, steps: Sequence[Values], commands: Sequence[Command], folder: Path
) -> None:
    kind = type(policy)
    saved = policy.save(folder / "policy")
    raw = json.loads((saved / CARD).read_text())
    expect((raw.get("kind"), raw.get("id")) == (policy.card.kind, policy.card.id), KIND)
    loaded = kind.load(saved)
    expect(loaded.card == policy.card, SAVED)
    expect(_are_equal(_drive(loaded, steps), commands), SAVED)
    before = _contents(saved)
    refuses(partial(policy.save, saved), PolicyError, KEEPS)
    expect(_contents(saved) == before, KEEPS)
    refuses(partial(kind.load, folder / "nothing"), PolicyError, LOADS)


def _check_topic_map(policy: Policy, topic_map: TopicMap) -> None:
    try:
        policy.check(topic_map)
    except PolicyError as err:
        raise AssertionError(f"{ACCEPTS} ({err})") from err
    for name in (*policy.observed, *policy.commanded):
        others = {key: spec for key, spec in topic_map.fields.items() if key != name}
        refuses(partial(policy.check, replace(topic_map, fields=others)), PolicyError, MISSES)


def _drive(policy: Policy, steps: Iterable[Values]) -> list[Command]:
    policy.reset()
    return [_answer(policy, values) for values in steps]


def _answer(policy: Policy, values: Values) -> Command:
    policy.observe({name: np.array(array) for name, array in values.items()})
    return {name: np.array(numbers) for name, numbers in policy.act().items()}


def _are_equal(found: Sequence[Command], expected: Sequence[Command]) -> bool:
    return len(found) == len(expected) and all(
        a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)
        for a, b in zip(found, expected, strict=True)
    )


def _contents(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}
