"""Whether a grasped object stays with the effector until it is released.

An object that is held by its rim turns about the point where it is held. When it leaves the table,
its offset from the effector changes by 2 to 3 cm, although it is not dropped. Its distance from
the effector does not change. So the distance is watched, by a sequential test that tolerates
noise, latency and dropouts of the pose.

The effector's frame must lie between the fingers (the tool centre point). In a frame at the flange
the distance of a turning object changes.

Everything here is causal: what is known at a step depends on the steps before it alone. A running
episode and the complete one give the same answers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.grasp import grasp_at
from curation_ros.core.evidence.hold_tracker import HoldTracker
from curation_ros.core.evidence.holds import (
    Carrying,
    Hold,
    State,
    carry_labels,
    carry_steps,
    no_evidence,
    without_holds,
)
from curation_ros.core.evidence.once import once_per_episode
from curation_ros.core.evidence.poses import Poses

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import TopicMap
    from curation_ros.core.types import Mask


@dataclass(frozen=True)
class Watched:
    """What a watch found in a complete episode.

    Attributes:
        carrying: what became of everything that was grasped.
        losses: see `CarryWatch.losses`.
        blind_from: see `CarryWatch`.
    """

    carrying: Carrying
    losses: tuple[Hold, ...]
    blind_from: int | None


@once_per_episode
def watched(episode: Episode) -> Watched:
    """Watch a complete episode."""
    watch = CarryWatch(episode.topic_map).take(episode)
    losses = tuple(watch.losses)  # before `finish` ends the hold that still runs
    return Watched(watch.finish(), losses, watch.blind_from)


def carrying_of(episode: Episode) -> Carrying:
    """What became of everything that was grasped in a complete episode."""
    return watched(episode).carrying


class CarryWatch:
    """Watches an episode that grows. What it has found for a step never changes.

    Args:
        topic_map: of the episode.

    Attributes:
        n_steps: steps taken so far.
        blind_from: first step at which it was known that the poses give no answer; None so far.
    """

    def __init__(self, topic_map: TopicMap) -> None:
        self._topic_map = topic_map
        self._labels = carry_labels(topic_map)
        self._effector = next((s.name for s in topic_map.with_role("effector")), "")
        self._objects = [s.name for s in topic_map.with_role("object") if len(s.values) >= 3]
        self._ended: list[Hold] = []
        self._tracker: HoldTracker | None = None
        self._reason = ""
        self.n_steps = 0
        self.blind_from: int | None = None

    def take(self, episode: Episode) -> Self:
        """Take the steps that are new. The steps before them must be unchanged.

        Args:
            episode: the episode so far, from its first step on.
        """
        first, self.n_steps = self.n_steps, len(episode)
        self._reason = self._reason or self._missing(episode)
        if self._reason:
            self.blind_from = 0
        if self._reason or first >= self.n_steps:
            return self
        held, blind = carry_steps(episode)
        with np.errstate(over="ignore", invalid="ignore"):  # a broken sensor may send anything
            poses = Poses(episode, self._effector, self._objects, self._labels)
            for step in _relevant_steps(held, blind, first):
                if held[step]:
                    if self._tracker is None:
                        self._tracker = HoldTracker(grasp_at(poses, step), step)
                    self._tracker.take(poses, step)
                    self._note(step, self._tracker.state)
                elif not blind[step]:
                    self._note(step, self._end())
        return self

    @property
    def losses(self) -> list[Hold]:
        """Holds whose objects are known by now to have been lost or left behind."""
        holds = [*self._ended, *([] if self._tracker is None else [self._tracker.so_far()])]
        # Without phases, an empty closing need not have been meant to carry anything.
        states = ("broken", "never") if self._labels else ("broken",)
        return [h for h in holds if h.state in states]

    def finish(self) -> Carrying:
        """What is known after the last step. A hold that still runs then is unknown."""
        holds = list(self._ended)
        if self._tracker is not None and (hold := self._tracker.end_of_episode()) is not None:
            holds.append(hold)
        reason = self._reason
        if not holds and not reason:
            reason = without_holds(self._topic_map, "nothing was held for long")
        if not self._labels and any(h.state != "never" for h in holds):
            holds = [h for h in holds if h.state != "never"]
        return Carrying(tuple(holds), reason)

    def _missing(self, episode: Episode) -> str:
        """Why these data cannot show a carry; empty if they can."""
        if not self._objects:
            return "the topic map declares no object with a position"
        if not self._effector:
            return "the topic map declares no effector"
        for name in (self._effector, *self._objects):
            if name not in episode.fields:
                return f"the episode lacks the field {name!r}"
        if episode.fields[self._effector].shape[1] < 3:
            return f"the effector {self._effector!r} has no position of three columns"
        try:
            carry_steps(episode)
        except EpisodeError as err:
            return no_evidence(err)
        return ""

    def _note(self, step: int, state: State | None) -> None:
        if self.blind_from is None and state == "unknown":
            self.blind_from = step

    def _end(self) -> State | None:
        """End the hold that runs, if there is one that counts, and return its state."""
        hold = self._tracker.end() if self._tracker is not None else None
        self._tracker = None
        if hold is None:
            return None
        self._ended.append(hold)
        return hold.state


def _relevant_steps(held: Mask, blind: Mask, first: int) -> list[int]:
    """Steps from `first` on in which something is held, or was in the step before."""
    after = np.zeros_like(held)
    after[1:] = held[:-1] | blind[:-1]
    steps: list[int] = (np.flatnonzero((held | after)[first:]) + first).tolist()
    return steps
