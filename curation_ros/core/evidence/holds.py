"""What is to be carried in an episode, and what is known of each time that it was."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.evidence.once import once_per_episode
from curation_ros.core.types import NS_PER_S, Mask

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import TopicMap

#: Phases in which a grasped object moves with the effector, in their order. These two names are
#: the convention for every robot and task: a topic map that has neither of them has no carry
#: phases, and each time that the gripper stays closed counts instead.
CARRY_PHASES = ("LIFT", "TRANSPORT")
#: Without phases, a hold begins this long after the command to close.
CLOSING_S = 0.5
#: What was true of a grasp is taken from this time before the hold.
GRASP_S = 0.6

State = Literal["carried", "broken", "never", "unknown"]


@dataclass(frozen=True)
class Hold:
    """One time that something was carried, or should have been. Steps are rows of the episode.

    Attributes:
        object: field of the object that was nearest at the grasp. Of evidence from the fingers:
            the field that was read. Empty if the object could not be identified.
        first, last: steps in which it was to be carried; `last` is the last one so far.
        state: `carried` until it was released; `broken` if it left the effector; `never` carried;
            `unknown`, for a reason.
        reason: why the state is `unknown`; else empty.
        departed: first step at which it had begun to leave; None if it did not.
        noticed: step at which that was certain.
        phase: phase in which it left, or in which the episode ended; empty without phases.
        n_carried: steps before it left; all of them if it did not.
        gap_m: growth of the distance from the effector when the loss was noticed, in metres.
        opened: whether the gripper had been commanded to open when it left.
    """

    object: str
    first: int
    last: int
    state: State = "unknown"
    reason: str = ""
    departed: int | None = None
    noticed: int | None = None
    phase: str = ""
    n_carried: int = 0
    gap_m: float = 0.0
    opened: bool = False

    @property
    def n_steps(self) -> int:
        """Steps in which the object was to be carried."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class Carrying:
    """What became of everything that was grasped in an episode.

    Attributes:
        holds: in their order, without those in which the effector hardly moved.
        reason: why there is none.
    """

    holds: tuple[Hold, ...] = ()
    reason: str = ""

    @property
    def worst(self) -> Hold | None:
        """The hold that decides: the first broken one, else unknown, never carried, carried."""
        for state in ("broken", "unknown", "never", "carried"):
            for hold in self.holds:
                if hold.state == state:
                    return hold
        return None

    @property
    def state(self) -> State:
        """The state of the worst hold; `unknown` if nothing was held."""
        return self.worst.state if self.worst is not None else "unknown"

    @property
    def coupling(self) -> float:
        """Share of the steps of all holds in which the object was carried; NaN without holds."""
        steps = sum(h.n_steps for h in self.holds)
        return sum(h.n_carried for h in self.holds) / steps if steps else float("nan")


def carry_labels(topic_map: TopicMap) -> dict[int, str]:
    """Index -> name of the carry phases of a topic map; empty if it has none."""
    specs = topic_map.with_role("phase")
    labels = specs[0].labels if specs else ()
    return {k: label for k, label in enumerate(labels) if label in CARRY_PHASES}


@once_per_episode
def carry_steps(episode: Episode) -> tuple[Mask, Mask]:
    """In which steps something is to be carried, and in which steps that is not known.

    Returns:
        Two (T,) masks. With carry phases: the steps in one of them, and the steps of unknown
        phase. Without: the steps from CLOSING_S after a command to close, and no step.

    Raises:
        EpisodeError: if there are neither carry phases nor a command of the gripper.
    """
    labels = carry_labels(episode.topic_map)
    phase = episode.phase if labels else None
    if phase is not None:
        return np.isin(phase, list(labels)), ~(phase >= 0)
    closed: Mask = commanded(episode) < 0
    begins = closed.copy()
    begins[1:] &= ~closed[:-1]
    began = np.maximum.accumulate(np.where(begins, np.arange(len(closed)), 0))
    for_ns = episode.stamps_ns - episode.stamps_ns[began]
    return closed & (for_ns >= int(CLOSING_S * NS_PER_S)), np.zeros_like(closed)


def without_holds(topic_map: TopicMap, otherwise: str) -> str:
    """Why an episode has no hold: the carry phases that it never reached, else another reason."""
    names = " or ".join(carry_labels(topic_map).values())
    return f"it never came to {names}" if names else otherwise


def no_evidence(error: EpisodeError) -> str:
    """The message of an error as a reason, without the id of the episode before it."""
    return str(error).partition(": ")[2]
