"""Alerts: what has gone wrong with an episode that still runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curation_ros.core.carrying import CarryWatch, Hold
from curation_ros.core.findings import Finding
from curation_ros.core.stream import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode import Episode
    from curation_ros.core.topic_map import TopicMap

#: With one of these so far, poses may be older than they look: then nobody is alarmed.
_BLINDING = ("clock-back", "duplicate-stamp", "gap", "not-finite", "undecodable")


class AlertWatch:
    """Looks at an episode as it grows, and says once what the operator must know now.

    Invariant: it says the same of an episode that grows as of the whole one at once; only sooner.

    Args:
        topic_map: of the episode.

    Attributes:
        has_spoken: whether it has said what it had to say.
    """

    def __init__(self, topic_map: TopicMap) -> None:
        self._watch = CarryWatch(topic_map)
        self.has_spoken = False

    def take(self, episode: Episode) -> Finding | None:
        """Look at the steps that are new.

        Args:
            episode: so far, from its first step on.

        Returns:
            `object-lost` or `not-carried`, the first time that it is sure.
        """
        if self.has_spoken:
            return None
        finding = lost_finding(self._watch.take(episode).lost, episode)
        if any(f.id in _BLINDING for f in episode.findings):
            return None
        self.has_spoken = finding is not None
        return finding


def lost_finding(hold: Hold | None, episode: Episode) -> Finding | None:
    """That an object was lost, or left behind: its phase and time in the message.

    Args:
        hold: as `CarryWatch.lost` gives it; any state.
        episode: of the hold.

    Returns:
        None where the hold does not say so for sure. The span is from the first step of leaving
        to the one at which that was sure.
    """
    if hold is None or hold.departed is None or hold.noticed is None:
        return None
    left_ns, sure_ns = episode.span(hold.departed, hold.noticed)
    phase = f" in {hold.phase}" if hold.phase else ""
    opened = ", after a command to open" if hold.opened else ""
    at = f"{left_ns / NS_PER_S:.2f} s{phase}"
    if hold.state == "never":
        text = f"{hold.object} was left behind at {at}, the effector went on without it"
        return Finding("not-carried", text, (left_ns, sure_ns))
    text = f"{hold.object} left the effector at {at}{opened}"
    return Finding("object-lost", text, (left_ns, sure_ns))
