"""Plan episodes, and run them in this process, in the very order of steps of the ROS node."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.core.episode.phases import PHASES
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Floats
from sim_node.defects import DEFECTS, DefectiveController
from sim_node.env import LiberoEnv, Observation
from sim_node.expert import Controller, Expert, ExpertParams
from sim_node.phases import PhaseTracker
from sim_node.starts import Start

MAX_STEPS = 500
STEPS_AFTER_SUCCESS = 20
"""A demonstration goes on for a second, so that it shows what success looks like."""


@dataclass(frozen=True)
class Step:
    """One step: what was seen, in which phase, and the command that answered it.

    Attributes:
        index: from 0.
        observation: before the command.
        phase_index: in `PHASES`.
        phase_progress: in [0, 1].
        action_xyz: (3,) in [-1, 1].
        gripper: -1, 0 or +1.
    """

    index: int
    observation: Observation
    phase_index: int
    phase_progress: float
    action_xyz: Floats
    gripper: float


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode went.

    Attributes:
        start: name of the start state.
        is_success: whether the goal held after any step.
        is_success_at_end: whether it held after the last step.
        n_steps: commands executed.
        success_step: index of the command after which the goal held for the first time.
        stage: name of the phase that was reached.
        phase_steps: steps in each phase.
        given_up: why it was ended before its time; empty where it was not.
    """

    start: str
    is_success: bool
    is_success_at_end: bool
    n_steps: int
    success_step: int | None
    stage: str
    phase_steps: tuple[int, ...]
    given_up: str = ""


@dataclass(frozen=True)
class EpisodePlan:
    """One episode to collect.

    Attributes:
        index: place in the order of collection.
        start: name of the start state.
        repetition: how many earlier episodes of the plan have the same start and defect.
        defect: key of `DEFECTS`.
        expert_seed: of the expert's variation.
        seed: of the defect's variation.
    """

    index: int
    start: str
    repetition: int
    defect: str
    expert_seed: int
    seed: int

    def controller(self, params: ExpertParams | None = None) -> DefectiveController:
        """The expert of this episode, with its defect."""
        return DEFECTS[self.defect].inject(Expert(self.expert_seed, params), self.seed)


def run_episode(
    env: LiberoEnv,
    start: Start,
    controller: Controller,
    *,
    max_steps: int = MAX_STEPS,
    steps_after_success: int = STEPS_AFTER_SUCCESS,
    on_step: Callable[[Step], None] | None = None,
    give_up: Callable[[Step], str] | None = None,
) -> EpisodeResult:
    """Reset, then observe, track the phase, ask for a command and execute it, until the end.

    Args:
        env: reset by this function.
        start: where to start.
        controller: one that has not acted yet.
        max_steps: most commands.
        steps_after_success: commands after the one that succeeded; 0 for evaluating policies.
        on_step: called before each command is executed.
        give_up: called before each command that is executed; a reason ends the episode instead.

    Raises:
        ConfigError: if max_steps is not positive or steps_after_success is negative.
        SimError: if the simulation diverged.
    """
    if max_steps < 1 or steps_after_success < 0:
        raise ConfigError(
            f"max_steps must be >= 1 and steps_after_success >= 0, "
            f"got {max_steps} and {steps_after_success}"
        )
    observation = env.reset(start.state)
    tracker = PhaseTracker.from_observation(observation)
    phase_steps = [0] * len(PHASES)
    success_step: int | None = None
    is_success = False
    given_up = ""
    n_steps = 0
    while n_steps < max_steps:
        phase_index = tracker.update(observation)
        action_xyz, gripper = controller.act(observation, phase_index)
        step = Step(n_steps, observation, phase_index, tracker.progress, action_xyz, gripper)
        if give_up is not None and success_step is None and (given_up := give_up(step)):
            break
        if on_step is not None:
            on_step(step)
        observation = env.step(action_xyz, gripper)
        phase_steps[phase_index] += 1
        n_steps += 1
        is_success = env.is_success()
        if is_success and success_step is None:
            success_step = n_steps - 1
        if success_step is not None and n_steps > success_step + steps_after_success:
            break
    return EpisodeResult(
        start=start.name,
        is_success=success_step is not None,
        is_success_at_end=is_success,
        n_steps=n_steps,
        success_step=success_step,
        stage=tracker.name,
        phase_steps=tuple(phase_steps),
        given_up=given_up,
    )


def plan_episodes(
    n: int,
    contamination: float,
    defect: str,
    seed: int,
    starts: Sequence[str],
    *,
    paired: bool = True,
) -> list[EpisodePlan]:
    """Decide what to collect, in which order.

    Args:
        n: episodes.
        contamination: fraction of defective ones; round(n * contamination) of them.
        defect: key of `DEFECTS` for the defective ones.
        seed: of the order and of every episode's own seeds.
        starts: names of start states.
        paired: the defective episodes recur on the starts of the clean ones, so that a start says
            nothing about the label; otherwise each episode takes the next start. Either way the
            starts begin anew where they run out.

    Raises:
        ConfigError: if a value is out of range or the defect is unknown.
    """
    if n < 1 or not 0.0 <= contamination <= 1.0:
        raise ConfigError(f"need n >= 1 and contamination in [0, 1], got {n}, {contamination}")
    if seed < 0:
        raise ConfigError(f"seed must be >= 0, got {seed}")
    if defect not in DEFECTS:
        raise ConfigError(f"defect {defect!r} is unknown; known: {', '.join(DEFECTS)}")
    if not starts:
        raise ConfigError("no start states to plan with")
    n_defective = round(n * contamination)
    n_clean = n - n_defective
    pool = starts[:n_clean] if paired and n_clean else starts
    chosen = [("none", starts[i % len(starts)]) for i in range(n_clean)]
    first = 0 if paired else n_clean
    chosen += [(defect, pool[(first + i) % len(pool)]) for i in range(n_defective)]

    seen: dict[tuple[str, str], int] = {}
    drafts = []
    for kind, start in chosen:
        drafts.append((kind, start, seen.get((kind, start), 0)))
        seen[kind, start] = drafts[-1][2] + 1
    rng = np.random.default_rng(seed)
    order = rng.permutation(n)
    # Seeds are drawn after the order: they belong to the place in it, not to the kind.
    seeds = rng.integers(0, 2**31, size=(n, 2))
    return [
        EpisodePlan(
            index=index,
            start=drafts[draft][1],
            repetition=drafts[draft][2],
            defect=drafts[draft][0],
            expert_seed=int(seeds[index, 0]),
            seed=int(seeds[index, 1]),
        )
        for index, draft in enumerate(order)
    ]
