"""Alerts: what has gone wrong with an episode that still runs.

The evidence is that of rule `evidence`, in its order: the pose of the object; if that gives no
answer, the fingers; and the command to open, if the pose has not shown the loss earlier.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.carrying import CarryWatch, watched
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.evidence.gripper import commanded, contradiction
from curation_ros.core.evidence.holds import GRASP_S, Hold, carry_labels
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import TopicMap

#: After one of these findings values may be older than they look: then there is no alert.
_BLINDING = ("clock-back", "duplicate-stamp", "not-finite", "undecodable")
#: A gripper that stays open this long was not opened by accident. By then a usable pose has shown
#: what became of the object.
OPEN_S = 0.2
#: Steps of the opening that lie within the phase: topics may differ by one step.
_OPEN_STEPS = 2
#: Alerts that something was lost. `opened-early` is the other one; both may be raised.
LOST = ("grip-lost", "not-carried", "object-lost")


class _Alert(NamedTuple):
    """An alert that is possible.

    Attributes:
        step: at which it became certain.
        since_ns: nanoseconds from the start stamp; from there on the data must have no gap.
        finding: the alert itself.
    """

    step: int
    since_ns: int
    finding: Finding


class AlertWatch:
    """Watches an episode that grows, and raises one alert as soon as it is certain.

    Invariant: the alert of a running episode is that of the complete one, only sooner.

    Args:
        topic_map: of the episode.
        usual: ids of findings that trusted episodes show as well; they raise no alert.

    Attributes:
        has_alerted: whether the alert was raised.
    """

    def __init__(self, topic_map: TopicMap, *, usual: Collection[str] = ()) -> None:
        self._watch = CarryWatch(topic_map)
        self._usual = frozenset(usual)
        self.has_alerted = False

    def take(self, episode: Episode) -> Finding | None:
        """Take the steps that are new.

        Args:
            episode: the episode so far, from its first step on.

        Returns:
            The first of these that is certain: `object-lost` or `not-carried` (by the pose),
            `grip-lost` (by the fingers, if the pose gives no answer), `opened-early` (by a
            command that lasts for OPEN_S). None if there is none, and after an alert.
        """
        if self.has_alerted:
            return None
        self._watch.take(episode)
        alerts = _alerts(episode, self._watch.losses, self._watch.blind_from)
        first = next((f for f in alerts if f.id not in self._usual), None)
        self.has_alerted = first is not None
        return first


def alerts_of(episode: Episode) -> list[Finding]:
    """All possible alerts of a complete episode, in the order in which they became certain."""
    found = watched(episode)
    return _alerts(episode, found.losses, found.blind_from)


def _alerts(episode: Episode, losses: Sequence[Hold], blind_from: int | None) -> list[Finding]:
    if any(f.id in _BLINDING for f in episode.findings):
        return []
    gaps = [f.span for f in episode.findings if f.id == "gap"]
    by_pose = [alert for hold in losses for alert in _lost(hold, episode)]
    found = [
        alert
        for alert in (*by_pose, *_by_gripper(episode, blind_from))
        if not any(a <= alert.finding.span[1] and b >= alert.since_ns for a, b in gaps)
    ]
    return [alert.finding for alert in sorted(found, key=lambda alert: alert.step)]


def _by_gripper(episode: Episode, blind_from: int | None) -> list[_Alert]:
    found = []
    if blind_from is not None:
        # Without phases, an empty closing need not have been meant to hold anything.
        states = ("broken", "never") if carry_labels(episode.topic_map) else ("broken",)
        holds = [h for h in held_by_fingers(episode).holds if h.state in states]
        for alert in (a for hold in holds for a in _lost(hold, episode, by_fingers=True)):
            found.append(alert._replace(step=max(alert.step, blind_from)))
    found += _opened(episode)
    # By what was known at the time: if the command's meaning is in doubt, it proves nothing.
    with np.errstate(invalid="ignore", over="ignore"):
        return [a for a in found if contradiction(episode.steps(a.step + 1)) is None]


def _lost(hold: Hold, episode: Episode, *, by_fingers: bool = False) -> list[_Alert]:
    """The alert that something was lost or left behind; none if the hold does not show that.

    Its span runs from the first step of leaving to the one at which that was certain.
    """
    if hold.departed is None or hold.noticed is None:
        return []
    left_ns, certain_ns = episode.span(hold.departed, hold.noticed)
    at = f"{left_ns / NS_PER_S:.2f} s{f' in {hold.phase}' if hold.phase else ''}"
    if by_fingers:
        what = "had let go" if hold.opened else "held nothing"
        id_, text = "grip-lost", f"the fingers {what} at {at}, as {hold.object} shows"
    elif hold.state == "never":
        text = f"{hold.object} was left behind at {at}, the effector went on without it"
        id_ = "not-carried"
    else:
        opened = ", after a command to open" if hold.opened else ""
        id_, text = "object-lost", f"{hold.object} left the effector at {at}{opened}"
    since_ns = episode.span(hold.first, hold.first)[0] - int(GRASP_S * NS_PER_S)
    return [_Alert(hold.noticed, since_ns, Finding(id_, text, (left_ns, certain_ns)))]


def _opened(episode: Episode) -> list[_Alert]:
    """Alerts that a closed gripper was commanded to open while something is to be carried."""
    labels, phase = carry_labels(episode.topic_map), episode.phase
    if not labels or phase is None:
        return []
    try:
        state = commanded(episode)
    except EpisodeError:  # no gripper in the map, or no such field in the episode
        return []
    is_open = (state > 0) & np.logical_or.accumulate(state < 0)
    in_carry = is_open & np.isin(phase, list(labels))
    not_open = np.flatnonzero(~is_open)
    stamps = episode.stamps_ns
    found: list[_Alert] = []
    for step in np.flatnonzero(in_carry & ~np.concatenate([[False], in_carry[:-1]])).tolist():
        certain = int(np.searchsorted(stamps, stamps[step] + int(OPEN_S * NS_PER_S)))
        closed_again = ((not_open > step) & (not_open <= certain)).any()
        if certain >= len(stamps) or closed_again:
            continue
        if in_carry[step : step + _OPEN_STEPS].all():
            span = episode.span(step, certain)
            where = labels[int(phase[step])]
            text = f"the gripper was commanded to open at {span[0] / NS_PER_S:.2f} s in {where}"
            found.append(_Alert(certain, span[0], Finding("opened-early", text, span)))
    return found
