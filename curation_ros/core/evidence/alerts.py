"""Alerts: what has gone wrong with an episode that still runs.

The evidence is that of rule `evidence`, in its order: the pose of the object; where that cannot
tell, what the fingers hold; and, where the pose has not told it sooner, the command to open.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.carrying import (
    GRASP_S,
    CarryWatch,
    Hold,
    carry_labels,
    watched,
)
from curation_ros.core.evidence.fingers import grip_of
from curation_ros.core.evidence.gripper import commanded, contradiction
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import TopicMap

#: With one of these so far, values may be older than they look: then nobody is alarmed.
_BLINDING = ("clock-back", "duplicate-stamp", "not-finite", "undecodable")
#: A gripper that stays open for so long was not opened by a slip of the thumb; a pose that is
#: worth its name has shown by then what came of it.
OPEN_S = 0.2
#: Steps of it within the phase: a topic may be one behind the other.
_OPEN_STEPS = 2
#: Beside what is lost, `opened-early` is told; the others are what is lost.
LOST = ("grip-lost", "not-carried", "object-lost")

#: What can be told: the step at which it was sure, since when that needs whole data, and what.
_Told = tuple[int, int, Finding]


class AlertWatch:
    """Looks at an episode as it grows, and says once what the operator must know now.

    Invariant: it says the same of an episode that grows as of the whole one at once; only sooner.

    Args:
        topic_map: of the episode.
        usual: ids of findings that trusted episodes show, too; they are not told.

    Attributes:
        has_spoken: whether it has said what it had to say.
    """

    def __init__(self, topic_map: TopicMap, *, usual: Collection[str] = ()) -> None:
        self._watch = CarryWatch(topic_map)
        self._usual = frozenset(usual)
        self.has_spoken = False

    def take(self, episode: Episode) -> Finding | None:
        """Look at the steps that are new.

        Args:
            episode: so far, from its first step on.

        Returns:
            The first that is sure of: `object-lost`, `not-carried` (both by pose), `grip-lost`
            (by the fingers, where the pose cannot tell) and `opened-early` (by a command that
            lasts for OPEN_S); None if there is none, and when it has spoken.
        """
        if self.has_spoken:
            return None
        told = [f for f in self.all(episode) if f.id not in self._usual]
        self.has_spoken = bool(told)
        return told[0] if told else None

    def all(self, episode: Episode) -> list[Finding]:
        """Everything that it could say by now, in the order in which it became sure."""
        self._watch.take(episode)
        return _alerts(episode, self._watch.losses, self._watch.blind_from)


def alerts_of(episode: Episode) -> list[Finding]:
    """Every alert of a whole episode, in the order in which it became sure."""
    seen = watched(episode)
    return _alerts(episode, seen.losses, seen.blind_from)


def _alerts(episode: Episode, losses: Sequence[Hold], blind_from: int | None) -> list[Finding]:
    if any(f.id in _BLINDING for f in episode.findings):
        return []
    gaps = [f.span for f in episode.findings if f.id == "gap"]
    by_pose = [told for hold in losses for told in _lost(hold, episode)]
    found = [
        (at, finding)
        for at, since_ns, finding in (*by_pose, *_by_gripper(episode, blind_from))
        if not any(a <= finding.span[1] and b >= since_ns for a, b in gaps)
    ]
    return [finding for _, finding in sorted(found, key=lambda told: told[0])]


def _by_gripper(episode: Episode, blind_from: int | None) -> list[_Told]:
    found = []
    if blind_from is not None:
        # Without phases nobody says that every closing was to hold something.
        states = ("broken", "never") if carry_labels(episode.topic_map) else ("broken",)
        holds = [h for h in grip_of(episode).holds if h.state in states]
        for told in (t for hold in holds for t in _lost(hold, episode, by_grip=True)):
            found.append((max(told[0], blind_from), *told[1:]))
    found += _opened(episode)
    # Of what was known by then: without a meaning, neither command nor width tell anything.
    with np.errstate(invalid="ignore", over="ignore"):
        return [t for t in found if contradiction(episode.steps(t[0] + 1)) is None]


def _lost(hold: Hold, episode: Episode, *, by_grip: bool = False) -> list[_Told]:
    """That something was lost, or left behind: its phase and time in the message.

    The span is from the first step of leaving to the one at which that was sure; none where the
    hold does not say so for sure.
    """
    if hold.departed is None or hold.noticed is None:
        return []
    left_ns, sure_ns = episode.span(hold.departed, hold.noticed)
    at = f"{left_ns / NS_PER_S:.2f} s{f' in {hold.phase}' if hold.phase else ''}"
    if by_grip:
        what = "had let go" if hold.opened else "held nothing"
        finding = Finding(
            "grip-lost", f"the fingers {what} at {at}, as {hold.object} shows", (left_ns, sure_ns)
        )
    elif hold.state == "never":
        text = f"{hold.object} was left behind at {at}, the effector went on without it"
        finding = Finding("not-carried", text, (left_ns, sure_ns))
    else:
        opened = ", after a command to open" if hold.opened else ""
        text = f"{hold.object} left the effector at {at}{opened}"
        finding = Finding("object-lost", text, (left_ns, sure_ns))
    since_ns = episode.span(hold.first, hold.first)[0] - int(GRASP_S * NS_PER_S)
    return [(hold.noticed, since_ns, finding)]


def _opened(episode: Episode) -> list[_Told]:
    """That a gripper that had closed was told to open, where something is to be carried."""
    labels, phase = carry_labels(episode.topic_map), episode.phase
    if not labels or phase is None:
        return []
    try:
        state = commanded(episode)
    except EpisodeError:  # no gripper in the map, or no such field in the episode
        return []
    is_open = (state > 0) & np.logical_or.accumulate(state < 0)
    in_carry = is_open & np.isin(phase, list(labels))
    shut = np.flatnonzero(~is_open)
    stamps = episode.stamps_ns
    found: list[_Told] = []
    for step in np.flatnonzero(in_carry & ~np.concatenate([[False], in_carry[:-1]])).tolist():
        sure = int(np.searchsorted(stamps, stamps[step] + int(OPEN_S * NS_PER_S)))
        is_long = sure < len(stamps) and not ((shut > step) & (shut <= sure)).any()
        if is_long and in_carry[step : step + _OPEN_STEPS].all():
            span = episode.span(step, sure)
            where = labels[int(phase[step])]
            text = f"the gripper was commanded to open at {span[0] / NS_PER_S:.2f} s in {where}"
            found.append((sure, span[0], Finding("opened-early", text, span)))
    return found
