"""The gate: which sample belongs to which episode, and when an episode has all of its samples.

Shared by recorder and curator, so that both see the same episode.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.core.types import NS_PER_S

#: How long to wait for late samples, in s. The middleware sends a lost message again when it next
#: asks for acknowledgements: Fast DDS does that every 3 s.
DRAIN_S = 5.0


@dataclass
class Window:
    """An episode that is open: what its owner announced, and what has arrived of each topic."""

    started: EpisodeEvent
    ended: EpisodeEvent | None = None
    deadline_s: float | None = None
    stamps: dict[str, set[int]] = field(default_factory=dict)
    newest_ns: dict[str, int] = field(default_factory=dict)

    def holds(self, stamp_ns: int) -> bool:
        """Whether a stamp lies in the window, as far as it is known."""
        end = self.ended.end_ns if self.ended is not None else None
        return self.started.start_ns <= stamp_ns and (end is None or stamp_ns <= end)

    def note(self, sample: Sample) -> None:
        """Note a sample that belongs to the episode."""
        self.stamps.setdefault(sample.topic, set()).add(sample.stamp_ns)
        self.newest_ns[sample.topic] = sample.stamp_ns

    def counts(self) -> dict[str, int]:
        """Distinct stamps of each topic in the window."""
        return {topic: len(stamps) for topic, stamps in self.stamps.items()}

    def end(self, event: EpisodeEvent, deadline_s: float) -> None:
        """Take the end: later samples do not belong to the window."""
        self.ended, self.deadline_s = event, deadline_s
        for topic, stamps in self.stamps.items():
            self.stamps[topic] = {stamp for stamp in stamps if self.holds(stamp)}

    def missing(self, topics: Iterable[str]) -> list[str]:
        """Topics that have neither passed the end stamp nor reached their count."""
        if self.ended is None or self.ended.end_ns is None:
            return list(topics)
        arrived, expected = self.counts(), self.ended.counts
        return [
            topic
            for topic in topics
            if self.newest_ns.get(topic, -1) < self.ended.end_ns
            and (topic not in expected or arrived.get(topic, 0) < expected[topic])
        ]


@dataclass(frozen=True)
class Closed:
    """An episode whose gate has closed.

    Attributes:
        event: the ended or aborted event; its reason names topics that fell silent too early.
        counts: topic -> distinct stamps that arrived.
        missing: topics that were incomplete when the drain time was over.
    """

    event: EpisodeEvent
    counts: dict[str, int]
    missing: tuple[str, ...]


class EpisodeGate:
    """Routes samples into episodes by their stamps.

    A sample belongs to an episode if start_stamp <= stamp <= end_stamp. Samples that arrive before
    `started` wait in a buffer of `max_gap_s` of stamp time. An episode closes when every topic has
    passed the end stamp or reached its count, at the latest `drain_timeout_s` after `ended`. Only
    that timeout uses receive time.
    """

    def __init__(
        self, topics: Iterable[str], *, max_gap_s: float, drain_timeout_s: float = DRAIN_S
    ) -> None:
        """Make a gate for these topics of the map.

        Args:
            topics: the mapped topics.
            max_gap_s: stamp time that is buffered before an episode starts.
            drain_timeout_s: how long to wait after `ended`, seconds of the caller's clock.
        """
        self.topics = tuple(topics)
        self.max_gap_s = max_gap_s
        self.drain_timeout_s = drain_timeout_s
        self._windows: dict[str, Window] = {}
        self._closed: deque[tuple[EpisodeEvent, int]] = deque(maxlen=8)
        # The newest samples of each topic, and the episode that has each.
        self._before: dict[str, deque[tuple[Sample, str | None]]] = {
            topic: deque() for topic in self.topics
        }

    @property
    def open_ids(self) -> tuple[str, ...]:
        """Episodes that have started and not closed, oldest first."""
        return tuple(self._windows)

    def window(self, episode_id: str) -> Window | None:
        """The open window of an episode, for display."""
        return self._windows.get(episode_id)

    def event(self, event: EpisodeEvent, now_s: float) -> list[Sample]:
        """Take an event of the episode's owner.

        Args:
            event: as received. A repeated `started` of a latched topic changes nothing, unless an
                episode is replayed. An end without a start is ignored.
            now_s: any monotonic clock.

        Returns:
            The buffered samples of an episode that starts, in order of arrival per topic.
        """
        if event.event == "started":
            has_closed = any(e.id == event.id for e, _ in self._closed)
            if event.id in self._windows or (has_closed and event.source != "replay"):
                return []
            window = Window(event)
            early = []
            for kept in self._before.values():
                for k, (sample, owner) in enumerate(kept):
                    if window.holds(sample.stamp_ns) and not self._is_taken(sample, owner):
                        window.note(sample)
                        early.append(sample)
                        kept[k] = (sample, event.id)
            self._windows[event.id] = window
            return early
        open_window = self._windows.get(event.id)
        if open_window is not None and open_window.ended is None:
            open_window.end(event, now_s + self.drain_timeout_s)
        return []

    def push(self, sample: Sample) -> str | None:
        """Take a sample; returns the id of the open episode it belongs to, if any.

        Windows of one owner do not overlap. If they do, the younger episode gets the sample.
        """
        owner = None
        for episode_id, window in reversed(self._windows.items()):
            # The newest, not the highest: after a clock went back, old stamps pass no end.
            window.newest_ns[sample.topic] = sample.stamp_ns
            if owner is None and window.holds(sample.stamp_ns):
                window.note(sample)
                owner = episode_id
        before = self._before[sample.topic]
        before.append((sample, owner))
        horizon = sample.stamp_ns - int(self.max_gap_s * NS_PER_S)
        while not horizon <= before[0][0].stamp_ns <= sample.stamp_ns:
            before.popleft()
        return owner

    def close_ready(self, now_s: float) -> list[Closed]:
        """Close and return the episodes that are complete, aborted or out of time."""
        done = []
        for episode_id, window in list(self._windows.items()):
            if window.ended is None or window.deadline_s is None:
                continue
            missing = window.missing(self.topics)
            if window.ended.event != "aborted" and missing and now_s < window.deadline_s:
                continue
            del self._windows[episode_id]
            self._closed.append((window.ended, window.started.start_ns))
            counts = window.counts()
            event = _noting(window.ended, [t for t in missing if counts.get(t)])
            done.append(Closed(event, counts, tuple(missing)))
        return done

    def _is_taken(self, sample: Sample, owner: str | None) -> bool:
        """Whether a sample belongs to another episode, although its stamp fits into several.

        It does if the clock went back between episodes, or one is replayed.
        """
        for episode_id, window in self._windows.items():
            if episode_id == owner:
                known = window.ended is not None and window.ended.end_ns is not None
                return known and window.holds(sample.stamp_ns)
        for event, start_ns in self._closed:
            if event.id == owner:
                return event.end_ns is None or start_ns <= sample.stamp_ns <= event.end_ns
        return False


def _noting(event: EpisodeEvent, missing: Iterable[str]) -> EpisodeEvent:
    """An ended event whose reason names the topics that fell silent before the end.

    Only those that the owner did not count: the builder compares counts itself, and finds topics
    without any sample. A line of the reason goes into the bag, and from there into a replay.
    """
    if event.event != "ended":
        return event
    lines = [line for line in event.reason.splitlines() if line]
    for topic in missing:
        line = f"incomplete: topic {topic!r} fell silent before the end of the episode"
        if topic not in event.counts and line not in lines:
            lines.append(line)
    return replace(event, reason="\n".join(lines))
