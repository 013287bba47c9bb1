"""Plan episodes to collect: which start, which seeds, and which of them get a defect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.core.errors import ConfigError
from sim_node.defects import DEFECTS, DefectiveController
from sim_node.tasks.task import Task


@dataclass(frozen=True)
class EpisodePlan:
    """One episode to collect.

    Attributes:
        index: place in the order of collection.
        start: name of the start state.
        repetition: number of earlier episodes of the plan with the same start and defect.
        defect: key of `DEFECTS`.
        expert_seed: seed of the expert's variation.
        seed: seed of the defect's variation.
    """

    index: int
    start: str
    repetition: int
    defect: str
    expert_seed: int
    seed: int

    def controller(self, task: Task) -> DefectiveController:
        """The expert of this episode, with its defect."""
        return DEFECTS[self.defect].inject(task.expert(self.expert_seed), task, self.seed)


def plan_episodes(
    n: int,
    contamination: float,
    defect: str,
    seed: int,
    starts: Sequence[str],
    *,
    paired: bool = True,
) -> list[EpisodePlan]:
    """Decide what to collect, and in which order.

    Args:
        n: number of episodes.
        contamination: fraction of defective ones; round(n * contamination) of them.
        defect: key of `DEFECTS` for the defective ones.
        seed: seed of the order and of the seeds of each episode.
        starts: names of start states.
        paired: whether the defective episodes reuse the starts of the clean ones, which makes the
            label independent of the start. Otherwise each episode takes the next start. In both
            cases the list of starts is repeated when it is used up.

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

    repetitions: dict[tuple[str, str], int] = {}
    drafts = []
    for kind, start in chosen:
        drafts.append((kind, start, repetitions.get((kind, start), 0)))
        repetitions[kind, start] = drafts[-1][2] + 1
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
