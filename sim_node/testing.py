"""Conformance of tasks and environments: the rules of their protocols, each one a sentence.

Run a task or a simulator of your own through these checks in a test:

    def test_my_environment():
        check_environment(MyEnvironment, [state_a, state_b])

    def test_my_task():
        check_task(my_task, ["generated-0-000", "generated-0-001"])
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from curation_ros.core.errors import ConfigError, SimError
from curation_ros.core.types import Floats
from curation_ros.testing.rules import expect, refuses
from sim_node.environment import (
    GRIPPER_CLOSE,
    GRIPPER_HOLD,
    GRIPPER_OPEN,
    Command,
    Environment,
    Observation,
)
from sim_node.episodes import run_episode
from sim_node.settings import EpisodeLimits
from sim_node.starts import official_name
from sim_node.tasks.task import PhaseTracker, Step, Task

# --- rules of an environment ------------------------------------------------------------------

NAMES = "`joint_names` and `object_names` are unique, and the last two joints are the fingers."
PERIOD = "`control_period_ns` is a positive integer."
SHAPES = (
    "An observation has finite float64 arrays of the shapes in `Observation`, for all objects."
)
REPEATS = "Equal start and equal commands give equal bits, whatever ran before."
SEPARATE = "Two environments share no state."
COPIES = "A later step does not change an earlier observation."
LEAVES = "The arrays of a start state and of a command are not changed."
COUNTS = "`n_steps` is the number of commands since the reset."
MOVES = "An action moves the effector along its axis, in its direction."
CLIPS = "An action beyond [-1, 1] is executed as if it were clipped."
SIGN = "Only the sign of a gripper command counts."
GRIPS = "The fingers are wider apart after opening than after closing."
HOLDS = "A gripper command of 0 keeps closed fingers closed."
ASKS = "`is_success` gives a bool, and does not change what follows."
BAD_STATE = "`reset` raises SimError for a state that is too short or not finite."
BAD_COMMAND = "`step` raises SimError for a command that is not 3 finite numbers and a finite one."
UNCHANGED = "A refused command is not executed."
CLOSED = "A closed environment raises SimError in `reset` and `step`; closing it again is allowed."

# --- rules of a task ----------------------------------------------------------------------------

PHASES = "The task has at least two phases with unique names."
CARRY = "`carry_phases` are phases of the task, at least one, in their order."
OBJECTS = "`moved_object` and `goal_object` are two objects of the environment."
STARTS = "`start` gives the name that was asked for, and the same state each time."
OWN_STATE = "Changing the state of a start does not change the next start of that name."
DIFFER = "Starts of different names have different states."
NO_START = "`start` raises ConfigError for a name that is none, or beyond the official starts."
UNSOLVED = "The goal does not hold at the start."
SOLVES = "The expert succeeds from every start that is given."
COMMANDS = "The expert's action is 3 finite numbers in [-1, 1], its gripper command -1, 0 or +1."
SEEDED = "Experts of one seed give equal commands, and an expert of another seed differs."
VISITS = "The expert passes through every phase."
ADVANCES = "Phases begin with the first one and advance by at most one per step."
PROGRESS = "Progress is in [0, 1] and never falls within a phase."
BLIND = "A tracker does not read the objects of later observations."
ALONE = "Two trackers share no state."

_N_STEPS = 12
_N_CLOSING = 40
_STILL_M = 1e-3


def check_environment(make: Callable[[], Environment], states: Sequence[ArrayLike]) -> None:
    """Run an environment through the rules.

    Args:
        make: makes an environment; equal each time, and with no state in common.
        states: (k,) start states, at least two, from which the effector can move 5 cm freely.

    Raises:
        AssertionError: with the sentence of the first rule that is broken.
        ValueError: if there are fewer than two states.
    """
    if len(states) < 2:
        raise ValueError(f"{len(states)} states are given, expected at least 2")
    env, other = make(), make()
    first, second = (np.array(state, dtype=np.float64) for state in states[:2])
    _check_description(env)
    for state in (first, second):
        _check_observations(env, state)
    _check_repetition(env, other, first, second)
    _check_arrays(env, first)
    _check_motion(env, first)
    _check_gripper(env, first)
    _check_refusals(env, first)
    env.close()
    other.close()
    env.close()
    refuses(partial(env.reset, first), SimError, CLOSED)
    refuses(partial(env.step, np.zeros(3), 0.0), SimError, CLOSED)


def check_task(task: Task, starts: Sequence[str], limits: EpisodeLimits | None = None) -> None:
    """Run a task through the rules; its environment is made and closed here.

    Args:
        task: what to check.
        starts: names of starts, at least two, from each of which the expert is to succeed.
        limits: of the expert's episodes.

    Raises:
        AssertionError: with the sentence of the first rule that is broken.
        ValueError: if there are fewer than two starts.
    """
    if len(starts) < 2:
        raise ValueError(f"{len(starts)} starts are given, expected at least 2")
    expect(len(set(task.phases)) == len(task.phases) >= 2, PHASES)
    in_order = [name for name in task.phases if name in task.carry_phases]
    expect(bool(in_order) and in_order == list(task.carry_phases), CARRY)
    _check_starts(task, starts)
    env = task.environment()
    try:
        names = {task.moved_object, task.goal_object}
        expect(len(names) == 2 and names <= set(env.object_names), OBJECTS)
        for seed, name in enumerate(starts):
            _check_expert(task, env, name, seed, limits or EpisodeLimits())
    finally:
        env.close()


# --- environment --------------------------------------------------------------------------------


def _check_description(env: Environment) -> None:
    for names in (env.joint_names, env.object_names):
        expect(len(set(names)) == len(names), NAMES)
    expect(len(env.joint_names) > 2, NAMES)
    expect(isinstance(env.control_period_ns, int) and env.control_period_ns > 0, PERIOD)


def _check_observations(env: Environment, state: Floats) -> None:
    n_arm = len(env.joint_names) - 2
    shapes = dict.fromkeys([f.name for f in fields(Observation)], (n_arm,))
    shapes |= {"eef_position_m": (3,), "eef_quat_xyzw": (4,)}
    shapes |= {name: (2,) for name in shapes if name.startswith("finger_")}
    del shapes["objects"]
    for observation in _play(env, state, _commands(0)):
        for name, shape in shapes.items():
            expect(_is_array(getattr(observation, name), shape), f"{SHAPES} ({name})")
        expect(list(observation.objects) == list(env.object_names), SHAPES)
        for position, quat in observation.objects.values():
            expect(_is_array(position, (3,)) and _is_array(quat, (4,)), SHAPES)


def _check_repetition(env: Environment, other: Environment, first: Floats, second: Floats) -> None:
    expected = _bits(_play(env, first, _commands(1)))
    _play(env, second, _commands(2)[: _N_STEPS // 2])
    expect(_bits(_play(env, first, _commands(1))) == expected, REPEATS)
    expect(env.n_steps == _N_STEPS, COUNTS)
    expect(_bits(_play(other, first, _commands(1))) == expected, REPEATS)
    both: tuple[list[Observation], list[Observation]] = ([env.reset(first)], [])
    other.reset(second)
    for one, opposite in zip(_commands(1), _commands(2), strict=True):
        both[0].append(env.step(*one))
        both[1].append(other.step(*opposite))
    expect(_bits(both[0]) == expected, SEPARATE)
    asked = [env.reset(first)]
    for command in _commands(1):
        asked.append(env.step(*command))
        expect(isinstance(env.is_success(), bool), ASKS)
    expect(_bits(asked) == expected, ASKS)


def _check_arrays(env: Environment, state: Floats) -> None:
    given = state.copy()
    kept = env.reset(given)
    before = _bits([kept])
    for action, gripper in _commands(3):
        command = action.copy()
        env.step(command, gripper)
        expect(np.array_equal(command, action), LEAVES)
    expect(np.array_equal(given, state), LEAVES)
    expect(_bits([kept]) == before, COPIES)


def _check_motion(env: Environment, state: Floats) -> None:
    for axis in range(3):
        for sign in (-1.0, 1.0):
            action = np.zeros(3)
            action[axis] = 0.5 * sign
            seen = _play(env, state, [Command(action, GRIPPER_OPEN)] * _N_STEPS)
            moved = seen[-1].eef_position_m - seen[0].eef_position_m
            expect(int(np.abs(moved).argmax()) == axis and moved[axis] * sign > 0.0, MOVES)
    wide, inside = np.array([3.0, -0.5, 0.0]), np.array([1.0, -0.5, 0.0])
    played = [_play(env, state, [Command(action, 1.0)] * 3) for action in (wide, inside)]
    expect(_bits(played[0]) == _bits(played[1]), CLIPS)


def _check_gripper(env: Environment, state: Floats) -> None:
    rest = np.zeros(3)
    played = [_play(env, state, [Command(rest, value)] * 3) for value in (0.2, GRIPPER_CLOSE)]
    expect(_bits(played[0]) == _bits(played[1]), SIGN)
    closed = _play(env, state, [Command(rest, GRIPPER_CLOSE)] * _N_CLOSING)[-1].finger_width_m
    for _ in range(_N_STEPS):
        held = env.step(rest, GRIPPER_HOLD).finger_width_m
    expect(abs(held - closed) < _STILL_M, HOLDS)
    opened = _play(env, state, [Command(rest, GRIPPER_OPEN)] * _N_CLOSING)[-1].finger_width_m
    expect(opened > closed, GRIPS)


def _check_refusals(env: Environment, state: Floats) -> None:
    bad = state.copy()
    bad[0] = np.nan
    for wrong in (bad, state[:-1]):
        refuses(partial(env.reset, wrong), SimError, BAD_STATE)
    before = _bits(_play(env, state, _commands(4)))
    seen = [env.reset(state)]
    for k, command in enumerate(_commands(4)):
        for action, gripper in (([0.0, np.nan, 0.0], 1.0), ([0.0, 0.0], 1.0), (bad[:3], np.inf)):
            refuses(partial(env.step, action, gripper), SimError, BAD_COMMAND)
        expect(env.n_steps == k, UNCHANGED)
        seen.append(env.step(*command))
    expect(_bits(seen) == before, UNCHANGED)


# --- task ---------------------------------------------------------------------------------------


def _check_starts(task: Task, names: Sequence[str]) -> None:
    states = []
    for name in names:
        start = task.start(name)
        kept = start.state.tobytes()
        again = task.start(name)
        expect(start.name == name and again.state.tobytes() == kept, STARTS)
        start.state[:] = np.nan
        expect(task.start(name).state.tobytes() == kept, OWN_STATE)
        states.append(kept)
    expect(len(set(states)) == len(set(names)), DIFFER)
    for wrong in ("nonsense", official_name(task.n_official_starts)):
        refuses(partial(task.start, wrong), ConfigError, NO_START)


def _check_expert(
    task: Task, env: Environment, name: str, seed: int, limits: EpisodeLimits
) -> None:
    start = task.start(name)
    env.reset(start.state)
    expect(not env.is_success(), UNSOLVED)
    steps: list[Step] = []
    commands: list[Command] = []

    def keep(step: Step, command: Command) -> None:
        steps.append(step)
        commands.append(command)

    result = run_episode(env, task, start, task.expert(seed), limits, on_step=keep)
    for action, gripper in commands:
        is_action = np.shape(action) == (3,) and bool(np.isfinite(action).all())
        expect(is_action and bool(np.abs(action).max() <= 1.0), COMMANDS)
        expect(gripper in (GRIPPER_OPEN, GRIPPER_HOLD, GRIPPER_CLOSE), COMMANDS)
    expect(result.is_success, f"{SOLVES} ({name}, expert {seed}: {result.stage})")
    expect(all(result.phase_steps), f"{VISITS} ({name}: {result.phase_steps})")
    again, another = ([_answers(task, s, steps)] for s in (seed, seed + 1))
    expect(again == [_bits_of(commands)] != another, SEEDED)
    _check_tracker(task, steps)


def _check_tracker(task: Task, steps: Sequence[Step]) -> None:
    observations = [step.observation for step in steps]
    seen = _track(task.tracker(observations[0]), observations)
    expect(seen[0][0] == 0, ADVANCES)
    for (before, old), (after, new) in pairwise(seen):
        expect(after in (before, before + 1), ADVANCES)
        expect(after > before or new >= old, PROGRESS)
    expect(all(0.0 <= progress <= 1.0 for _, progress in seen), PROGRESS)
    far = {name: (at + 9.0, quat) for name, (at, quat) in observations[0].objects.items()}
    blind = [observations[0], *(replace(o, objects=far) for o in observations[1:])]
    expect(_track(task.tracker(observations[0]), blind) == seen, BLIND)
    one, other = task.tracker(observations[0]), task.tracker(observations[0])
    for observation in observations[:_N_STEPS]:
        one.update(observation)
    expect(_track(other, observations) == seen, ALONE)


# --- what the checks share ----------------------------------------------------------------------


def _commands(seed: int) -> list[Command]:
    rng = np.random.default_rng(seed)
    return [
        Command(rng.uniform(-0.5, 0.5, 3), float(rng.integers(-1, 2))) for _ in range(_N_STEPS)
    ]


def _play(env: Environment, state: Floats, commands: Iterable[Command]) -> list[Observation]:
    return [env.reset(state), *(env.step(*command) for command in commands)]


def _track(tracker: PhaseTracker, seen: Iterable[Observation]) -> list[tuple[int, float]]:
    return [(tracker.update(observation), tracker.progress) for observation in seen]


def _answers(task: Task, seed: int, steps: Iterable[Step]) -> bytes:
    expert = task.expert(seed)
    return _bits_of(Command(*expert.act(step)) for step in steps)


def _bits_of(commands: Iterable[Command]) -> bytes:
    return b"".join(np.array([*action, gripper]).tobytes() for action, gripper in commands)


def _bits(seen: Iterable[Observation]) -> bytes:
    parts = []
    for observation in seen:
        arrays = [getattr(observation, f.name) for f in fields(observation)][:-1]
        for pose in observation.objects.values():
            arrays += pose
        parts += [np.asarray(array).tobytes() for array in arrays]
    return b"".join(parts)


def _is_array(value: object, shape: tuple[int, ...]) -> bool:
    return (
        isinstance(value, np.ndarray)
        and value.dtype == np.float64
        and value.shape == shape
        and bool(np.isfinite(value).all())
    )
