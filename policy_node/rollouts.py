"""Rollouts: a policy and the simulator in one process, step for step as the ROS graph has it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any

from curation_ros.core.stream import Floats
from policy_node.controller import PolicyController
from policy_node.policy import Policy
from sim_node.env import BOWL, PLATE, LiberoEnv, Observation
from sim_node.episodes import MAX_STEPS, run_episode
from sim_node.starts import Start


@dataclass(frozen=True)
class Rollout:
    """How one rollout went.

    Attributes:
        policy: id of the policy.
        start: name of the start state.
        success: whether the goal held after any step; it ends there.
        steps: commands executed.
        stage: the last phase reached. Phases do not watch the object: a policy that has lost it
            goes on to RELEASE, as a defective demonstration does.
    """

    policy: str
    start: str
    success: bool
    steps: int
    stage: str

    def to_json(self) -> dict[str, Any]:
        """Plain data, as `curation evaluate` prints it."""
        return asdict(self)


def field_values(observation: Observation) -> dict[str, Floats]:
    """What the simulator shows, by the fields of the topic map; lengths in m, angles in rad."""
    return {
        "eef_position": observation.eef_position_m,
        "eef_quat_xyzw": observation.eef_quat_xyzw,
        "joint_position": observation.joint_position_rad,
        "finger_position": observation.finger_position_m,
        "bowl_position": observation.objects[BOWL][0],
        "plate_position": observation.objects[PLATE][0],
    }


class _SimController:
    """A policy in the shape that `run_episode` drives; for one episode."""

    def __init__(self, policy: Policy) -> None:
        self._controller = PolicyController(policy)

    def act(self, observation: Observation, phase_index: int) -> tuple[Floats, float]:
        return self._controller.act(field_values(observation), phase_index)


def rollout(env: LiberoEnv, start: Start, policy: Policy, max_steps: int = MAX_STEPS) -> Rollout:
    """Let a policy act from one start until it succeeds or the steps are used up.

    Args:
        env: reset by this function.
        start: where to start.
        policy: what acts.
        max_steps: most commands.

    Raises:
        ConfigError: if max_steps is not positive.
        PolicyError: if the policy cannot answer an observation.
        SimError: if the simulation diverged.
    """
    result = run_episode(
        env, start, _SimController(policy), max_steps=max_steps, steps_after_success=0
    )
    return Rollout(policy.id, start.name, result.is_success, result.n_steps, result.stage)


def evaluate(
    policy: Policy,
    starts: Iterable[Start],
    env: LiberoEnv | None = None,
    max_steps: int = MAX_STEPS,
    progress: Callable[[Rollout], None] | None = None,
) -> list[Rollout]:
    """One rollout a start, in their order.

    Args:
        policy: what acts.
        starts: where to start.
        env: default: one of its own, closed at the end.
        max_steps: most commands a rollout.
        progress: called after each rollout.

    Raises:
        ConfigError, PolicyError, SimError: as `rollout` does.
    """
    simulator = LiberoEnv() if env is None else env
    try:
        rollouts = []
        for start in starts:
            rollouts.append(rollout(simulator, start, policy, max_steps))
            if progress is not None:
                progress(rollouts[-1])
        return rollouts
    finally:
        if env is None:
            simulator.close()
