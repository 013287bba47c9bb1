"""Joins the samples of several topics to observations, while they arrive."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.types import NS_PER_S, Floats

#: Observations or samples that are kept per topic. Without an episode, old ones are of no use.
_MOST_KEPT = 100


class Joined(NamedTuple):
    """An observation.

    Attributes:
        stamp_ns: of the observation.
        values: (d,) values by field; empty where fields are missing.
        missing: why it has no values; empty where it has.
    """

    stamp_ns: int
    values: Mapping[str, Floats]
    missing: str = ""


class Joiner(Protocol):
    """Collects the samples of all observed topics.

    Attributes:
        starts_at_start: whether the first observation of an episode has its start stamp.
    """

    starts_at_start: bool

    def add(self, topic: str, stamp_ns: int, values: Mapping[str, Floats]) -> None:
        """Take the fields of one sample."""

    def take(self, start_ns: int) -> list[Joined]:
        """Observations from a stamp on that are complete now, oldest first, each once."""

    def clear(self, before_ns: int | None = None) -> None:
        """Forget everything, or everything before a stamp."""


class EqualStamps:
    """An observation is complete when all topics have a sample of one stamp, as in lockstep."""

    starts_at_start = True

    def __init__(self, topic_map: TopicMap) -> None:
        self._n_fields = len(topic_map.fields)
        self._waiting: dict[int, dict[str, Floats]] = {}

    def add(self, topic: str, stamp_ns: int, values: Mapping[str, Floats]) -> None:
        """See `Joiner.add`."""
        self._waiting.setdefault(stamp_ns, {}).update(values)
        if len(self._waiting) > _MOST_KEPT:
            del self._waiting[min(self._waiting)]

    def take(self, start_ns: int) -> list[Joined]:
        """See `Joiner.take`."""
        stamps = [
            stamp_ns
            for stamp_ns, values in self._waiting.items()
            if stamp_ns >= start_ns and len(values) == self._n_fields
        ]
        return [Joined(stamp_ns, self._waiting.pop(stamp_ns)) for stamp_ns in sorted(stamps)]

    def clear(self, before_ns: int | None = None) -> None:
        """See `Joiner.clear`."""
        for stamp_ns in [s for s in self._waiting if before_ns is None or s < before_ns]:
            del self._waiting[stamp_ns]


class LatestSamples:
    """Each sample of the clock topic is an observation, with the latest samples of the others.

    This is how episodes are built of topics whose stamps differ. A sample that is older than the
    map's `max_gap_s` is too old.
    """

    starts_at_start = False

    def __init__(self, topic_map: TopicMap) -> None:
        self._map = topic_map
        self._max_gap_ns = round(topic_map.max_gap_s * NS_PER_S)
        self._samples: dict[str, dict[int, Mapping[str, Floats]]] = {}
        self._clock_stamps: list[int] = []

    def add(self, topic: str, stamp_ns: int, values: Mapping[str, Floats]) -> None:
        """See `Joiner.add`."""
        kept = self._samples.setdefault(topic, {})
        kept[stamp_ns] = values
        if len(kept) > _MOST_KEPT:
            del kept[min(kept)]
        if topic == self._map.clock_topic:
            self._clock_stamps = [*self._clock_stamps, stamp_ns][-_MOST_KEPT:]

    def take(self, start_ns: int) -> list[Joined]:
        """See `Joiner.take`."""
        stamps = sorted({stamp_ns for stamp_ns in self._clock_stamps if stamp_ns >= start_ns})
        self._clock_stamps = []
        return [self._joined(stamp_ns) for stamp_ns in stamps]

    def clear(self, before_ns: int | None = None) -> None:
        """See `Joiner.clear`; samples stay, as they may be the latest of the next episode."""
        self._clock_stamps = [
            s for s in self._clock_stamps if before_ns is not None and s >= before_ns
        ]

    def _joined(self, stamp_ns: int) -> Joined:
        values: dict[str, Floats] = {}
        for topic in self._map.topics:
            kept = self._samples.get(topic, {})
            latest = max((s for s in kept if s <= stamp_ns), default=None)
            if latest is None or stamp_ns - latest > self._max_gap_ns:
                gap_s = self._map.max_gap_s
                return Joined(stamp_ns, {}, f"no sample on {topic} within {gap_s:g} s")
            values.update(kept[latest])
        return Joined(stamp_ns, values)


#: How the policy node may join samples, by the value of its parameter `stamps`.
JOINERS: dict[str, type[EqualStamps] | type[LatestSamples]] = {
    "equal": EqualStamps,
    "latest": LatestSamples,
}
