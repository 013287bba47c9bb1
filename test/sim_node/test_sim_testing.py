"""The conformance checks: ours keep the rules, and each broken rule is named."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from toy import CUP, STEP_M, ToyEnvironment, ToyExpert, ToyTask, ToyTracker

from curation_ros.core.errors import SimError
from sim_node import testing
from sim_node.episodes import run_episode
from sim_node.starts import Start
from sim_node.tasks import TASKS
from sim_node.testing import check_environment, check_task

NAMES = ["generated-0-000", "generated-0-001", "official-01"]
STATES = [ToyTask().start(name).state for name in NAMES]


def test_toy_environment_keeps_the_rules():
    check_environment(ToyEnvironment, STATES)


def test_toy_task_keeps_the_rules():
    check_task(ToyTask(), NAMES)


@pytest.mark.sim
@pytest.mark.parametrize("name", TASKS)
def test_environment_keeps_the_rules(name):
    pytest.importorskip("libero", reason="LIBERO is not installed")
    task = TASKS[name]
    check_environment(task.environment, [task.start(n).state for n in NAMES])


@pytest.mark.sim
@pytest.mark.parametrize("name", TASKS)
def test_task_keeps_the_rules(name):
    pytest.importorskip("libero", reason="LIBERO is not installed")
    assert TASKS[name].name == name
    check_task(TASKS[name], NAMES[:2])


@pytest.mark.sim
def test_stock_environment_keeps_the_rules():
    pytest.importorskip("libero", reason="LIBERO is not installed")
    task = TASKS["bowl_on_plate"]
    states = [task.start(n).state for n in NAMES[:2]]
    check_environment(lambda: task.environment(lean=False), states)


def test_too_little_to_check_with_is_refused():
    with pytest.raises(ValueError, match="1 states are given, expected at least 2"):
        check_environment(ToyEnvironment, STATES[:1])
    with pytest.raises(ValueError, match="1 starts are given, expected at least 2"):
        check_task(ToyTask(), NAMES[:1])


# --- environments that break a rule -------------------------------------------------------------


class SameNames(ToyEnvironment):
    joint_names = ("slide", "slide", "slide", "left", "right")


class NoPeriod(ToyEnvironment):
    control_period_ns = 0


class ShortArrays(ToyEnvironment):
    joint_names = ("slide_x", "left", "right")


class LacksAnObject(ToyEnvironment):
    object_names = (CUP,)


class Remembers(ToyEnvironment):
    n_resets = 0

    def reset(self, start_state):
        self.n_resets += 1
        first = super().reset(start_state)
        first.eef_position_m[:] += 1e-9 * self.n_resets
        return first


class Shares(ToyEnvironment):
    n_running = [0]  # noqa: RUF012 - shared on purpose

    def reset(self, start_state):
        self.n_running[0] = 0
        return super().reset(start_state)

    def step(self, action_xyz, gripper):
        self.n_running[0] += 1
        drift = 1e-3 * (self.n_running[0] > self.n_steps + 1)
        return super().step(np.asarray(action_xyz, dtype=float) + drift, gripper)


class GivesViews(ToyEnvironment):
    def _observe(self):
        observation = super()._observe()
        self._shown = getattr(self, "_shown", np.empty(3))
        self._shown[:] = observation.eef_position_m
        return replace(observation, eef_position_m=self._shown)


class ChangesCommands(ToyEnvironment):
    def step(self, action_xyz, gripper):
        done = super().step(action_xyz, gripper)
        if isinstance(action_xyz, np.ndarray):
            action_xyz *= 0.5
        return done


class CountsResets(ToyEnvironment):
    def reset(self, start_state):
        first = super().reset(start_state)
        self.n_steps = 1
        return first


class Mirrored(ToyEnvironment):
    def step(self, action_xyz, gripper):
        return super().step(np.array(action_xyz) * (1.0, -1.0, 1.0), gripper)


class DoesNotClip(ToyEnvironment):
    def step(self, action_xyz, gripper):
        seen = super().step(action_xyz, gripper)
        beyond = np.asarray(action_xyz) - np.clip(action_xyz, -1.0, 1.0)
        self._eef = self._eef + STEP_M * beyond
        return self._observe() if beyond.any() else seen


class GripsHarder(ToyEnvironment):
    def step(self, action_xyz, gripper):
        seen = super().step(action_xyz, gripper)
        seen.finger_effort_n[:] = gripper if gripper > 0 else 0.0
        return seen


class ClosesToOpen(ToyEnvironment):
    def step(self, action_xyz, gripper):
        return super().step(action_xyz, -gripper)


class LetsGo(ToyEnvironment):
    def step(self, action_xyz, gripper):
        return super().step(action_xyz, gripper or -1.0)


class SuccessPushes(ToyEnvironment):
    def is_success(self):
        self._eef = self._eef + 1e-6
        return super().is_success()


class TakesAnyState(ToyEnvironment):
    def reset(self, start_state):
        return super().reset(np.nan_to_num(start_state))


class TakesAnyCommand(ToyEnvironment):
    def step(self, action_xyz, gripper):
        return super().step(np.nan_to_num(np.resize(action_xyz, 3)), np.nan_to_num(gripper))


class CountsRefusals(ToyEnvironment):
    def step(self, action_xyz, gripper):
        try:
            return super().step(action_xyz, gripper)
        except SimError:
            self.n_steps += 1
            raise


class NeverCloses(ToyEnvironment):
    def close(self):
        pass


@pytest.mark.parametrize(
    ("kind", "rule"),
    [
        (SameNames, testing.NAMES),
        (NoPeriod, testing.PERIOD),
        (ShortArrays, testing.SHAPES),
        (LacksAnObject, testing.SHAPES),
        (Remembers, testing.REPEATS),
        (Shares, testing.SEPARATE),
        (GivesViews, testing.COPIES),
        (ChangesCommands, testing.LEAVES),
        (CountsResets, testing.COUNTS),
        (Mirrored, testing.MOVES),
        (DoesNotClip, testing.CLIPS),
        (GripsHarder, testing.SIGN),
        (ClosesToOpen, testing.GRIPS),
        (LetsGo, testing.HOLDS),
        (SuccessPushes, testing.ASKS),
        (TakesAnyState, testing.BAD_STATE),
        (TakesAnyCommand, testing.BAD_COMMAND),
        (CountsRefusals, testing.UNCHANGED),
        (NeverCloses, testing.CLOSED),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_broken_rule_of_an_environment_is_named(kind, rule):
    with pytest.raises(AssertionError) as error:
        check_environment(kind, STATES)
    assert str(error.value).startswith(rule)


# --- tasks that break a rule --------------------------------------------------------------------


def task_with(**members):
    return type("Changed", (ToyTask,), members)()


class OneState(ToyTask):
    def start(self, name):
        super().start(name)
        return Start(name, super().start(NAMES[0]).state)


class SharedState(ToyTask):
    def __init__(self):
        self._made = {}

    def start(self, name):
        return self._made.setdefault(name, super().start(name))


class Drifting(ToyTask):
    n = 0

    def start(self, name):
        self.n += 1
        return Start(name, super().start(name).state + 1e-6 * self.n)


class AnyStart(ToyTask):
    def start(self, name):
        return super().start(name if "-" in name else NAMES[0])


class EndlessStarts(ToyTask):
    def start(self, name):
        return Start(name, super().start(name.replace("official", "generated-999")).state)


class Done(ToyEnvironment):
    def is_success(self):
        return True


class Idle(ToyExpert):
    def act(self, step):
        return np.zeros(3), -1.0


class Wild(ToyExpert):
    def act(self, step):
        action, gripper = super().act(step)
        return 3.0 * action, gripper


class Gentle(ToyExpert):
    def act(self, step):
        action, gripper = super().act(step)
        return action, 0.5 * gripper


class Jumps(ToyTracker):
    def update(self, observation):
        return 2 * super().update(observation) % 3


class Forgets(ToyTracker):
    def update(self, observation):
        index = super().update(observation)
        self.progress = 0.5 if self.progress > 0.9 else self.progress
        return index


class Overflows(ToyTracker):
    def update(self, observation):
        index = super().update(observation)
        self.progress += 1.0
        return index


class Watches(ToyTracker):
    def update(self, observation):
        self._coaster = observation.objects["coaster"][0].copy()
        return super().update(observation)


class Shared(ToyTracker):
    n_updates = 0

    def __init__(self, first):
        super().__init__(first)
        Shared.n_updates = 0

    def update(self, observation):
        index = super().update(observation)
        Shared.n_updates += 1
        self.progress = min(1.0, self.progress + 1e-9 * Shared.n_updates)
        return index


def driven_by(kind):
    return task_with(expert=lambda self, seed: kind(seed))


def tracked_by(kind):
    return task_with(tracker=lambda self, first: kind(first))


@pytest.mark.parametrize(
    ("task", "rule"),
    [
        (task_with(phases=("TAKE", "CARRY", "CARRY")), testing.PHASES),
        (task_with(carry_phases=()), testing.CARRY),
        (task_with(carry_phases=("LEAVE", "CARRY")), testing.CARRY),
        (task_with(goal_object=CUP), testing.OBJECTS),
        (task_with(goal_object="saucer"), testing.OBJECTS),
        (Drifting(), testing.STARTS),
        (SharedState(), testing.OWN_STATE),
        (OneState(), testing.DIFFER),
        (AnyStart(), testing.NO_START),
        (EndlessStarts(), testing.NO_START),
        (task_with(environment=lambda self, lean=True: Done()), testing.UNSOLVED),
        (driven_by(Idle), testing.SOLVES),
        (driven_by(Wild), testing.COMMANDS),
        (driven_by(Gentle), testing.COMMANDS),
        (driven_by(lambda seed: ToyExpert(0)), testing.SEEDED),
        (task_with(phases=("TAKE", "CARRY", "LEAVE", "REST")), testing.VISITS),
        (tracked_by(Forgets), testing.PROGRESS),
        (tracked_by(Overflows), testing.PROGRESS),
        (tracked_by(Watches), testing.BLIND),
        (tracked_by(Shared), testing.ALONE),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_broken_rule_of_a_task_is_named(task, rule):
    with pytest.raises(AssertionError) as error:
        check_task(task, NAMES)
    assert str(error.value).startswith(rule)


def test_phases_that_jump_are_named():
    """A controller that looks at the phase would not succeed: the tracker is checked alone."""
    task, env = ToyTask(), ToyEnvironment()
    steps = []
    run_episode(
        env,
        task,
        task.start(NAMES[0]),
        task.expert(0),
        on_step=lambda step, _: steps.append(step),
    )
    testing._check_tracker(task, steps)
    with pytest.raises(AssertionError) as error:
        testing._check_tracker(tracked_by(Jumps), steps)
    assert str(error.value) == testing.ADVANCES
