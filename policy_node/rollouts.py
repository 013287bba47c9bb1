"""Rollouts: a policy and the simulator in one process, step for step as the ROS graph has it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.types import Floats
from policy_node.controller import PolicyController
from policy_node.policy import Policy
from sim_node.environment import Environment
from sim_node.episodes import run_episode
from sim_node.fields import CommandedFields, ObservedFields
from sim_node.settings import MAX_STEPS, EpisodeLimits
from sim_node.starts import Start
from sim_node.tasks.task import Step, Task


@dataclass(frozen=True)
class Rollout:
    """How one rollout went.

    Attributes:
        policy: id of the policy.
        start: name of the start state.
        success: whether the goal held after any step; it ends there.
        steps: commands executed.
        stage: the last phase reached. Phases do not watch the object: a policy that has lost it
            continues to RELEASE, as a defective demonstration does.
        ended: `success`, `max_steps`, or the reason of `GiveUp`.
    """

    policy: str
    start: str
    success: bool
    steps: int
    stage: str
    ended: str = ""

    def to_json(self) -> dict[str, Any]:
        """Plain data, as `curation evaluate` prints it; evaluate never gives up."""
        return {key: value for key, value in asdict(self).items() if key != "ended"}


class SimController:
    """A policy as a controller of the simulator, for one episode.

    Args:
        policy: what acts. It is reset, and must drive nothing else meanwhile.
        env: the environment that it observes.
        topic_map: says which of its fields is which value of which topic.

    Raises:
        ConfigError: if the simulated robot does not send or take one of its fields.
    """

    def __init__(self, policy: Policy, env: Environment, topic_map: TopicMap) -> None:
        self._controller = PolicyController(policy)
        self._observed = ObservedFields(env, topic_map, policy.observed)
        self._commanded = CommandedFields(topic_map, policy.commanded)

    def act(self, step: Step) -> tuple[Floats, float]:
        """(3,) twist and the gripper's command, each in [-1, 1].

        A policy that does not command the gripper leaves it as it is.

        Raises:
            PolicyError: if the policy cannot answer the observation.
        """
        command = self._controller.answer(step.index, self._observed.values(step))
        return self._commanded.command(command)


class GiveUp:
    """Ends a rollout that is as good as lost, to save the steps of a study; for one rollout.

    `lost`: the object lies on the table, at rest, out of reach of the gripper and off the goal, in
    a phase from which the phases never lead back to a grasp. `phase`: the policy has been in one
    phase for twice as long as the slowest demonstration. A success after that counts as a failure,
    as one after `max_steps` does. `benchmarks/giving_up.py` counts how often either rule is wrong.
    """

    #: Steps in one phase; demonstrations take up to 100 in one, and succeed 4 steps into RELEASE.
    PHASE_STEPS, RELEASE_STEPS = 200, 60
    _REST_STEPS, _REST_M = 20, 1e-3
    _ON_TABLE_M, _OUT_OF_REACH_M, _OFF_GOAL_M = 0.02, 0.12, 0.06

    def __init__(self, task: Task) -> None:
        self._names = task.moved_object, task.goal_object
        self._carry_index = task.phases.index(task.carry_phases[0])
        self._last_index = len(task.phases) - 1
        self._height_m = 0.0
        self._phase = -1
        self._phase_steps = 0
        self._lying: list[Floats] = []

    def __call__(self, step: Step) -> str:
        """Reason to end before this step; empty: continue."""
        if step.index == 0:
            self._height_m = float(step.observation.objects[self._names[0]][0][2])
        self._phase_steps = self._phase_steps + 1 if step.phase_index == self._phase else 1
        self._phase = step.phase_index
        is_last = self._phase == self._last_index
        if self._phase_steps > (self.RELEASE_STEPS if is_last else self.PHASE_STEPS):
            return "phase"
        return "lost" if self._is_lost(step) else ""

    def _is_lost(self, step: Step) -> bool:
        moved, goal = (step.observation.objects[name][0] for name in self._names)
        if not (
            self._phase >= self._carry_index
            and moved[2] < self._height_m + self._ON_TABLE_M
            and np.linalg.norm(moved - step.observation.eef_position_m) > self._OUT_OF_REACH_M
            and np.linalg.norm(moved[:2] - goal[:2]) > self._OFF_GOAL_M
        ):
            self._lying.clear()
            return False
        self._lying.append(moved)
        recent = self._lying[-self._REST_STEPS :]
        return len(recent) == self._REST_STEPS and bool(
            np.ptp(recent, axis=0).max() < self._REST_M
        )


def rollout(
    env: Environment,
    task: Task,
    start: Start,
    policy: Policy,
    topic_map: TopicMap,
    max_steps: int = MAX_STEPS,
    *,
    gives_up: bool = False,
) -> Rollout:
    """Let a policy act from one start until it succeeds or the steps are used up.

    Args:
        env: reset by this function.
        task: what is to be done in it.
        start: where to start.
        policy: what acts.
        topic_map: says which field is which value of which topic.
        max_steps: most commands.
        gives_up: whether a rollout that is as good as lost is ended, see `GiveUp`.

    Raises:
        ConfigError: if max_steps is not positive, or the simulated robot does not send or take a
            field of the policy.
        PolicyError: if the policy cannot answer an observation.
        SimError: if the simulation diverged.
    """
    result = run_episode(
        env,
        task,
        start,
        SimController(policy, env, topic_map),
        EpisodeLimits(max_steps, steps_after_success=0),
        give_up=GiveUp(task) if gives_up else None,
    )
    ended = "success" if result.is_success else result.given_up or "max_steps"
    return Rollout(
        policy.card.id, start.name, result.is_success, result.n_steps, result.stage, ended
    )
