"""Builds an episode from a stream of samples, one by one: the same code live and from a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.joining import (
    TopicSamples,
    join_topics,
    label_indices,
    ordered_samples,
)
from curation_ros.core.episode.stream import Decoder, Messages, Sample, SampleBlock, Stamps
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import Floats

# Decoding many messages in one pass is far cheaper than one by one. Doing it while the episode
# runs leaves little for the moment when its gate closes.
_BATCH = 64


class _Track:
    """All samples of one topic in arrival order, decoded in batches."""

    def __init__(self, topic: str, specs: Sequence[FieldSpec], decoder: Decoder) -> None:
        self.topic = topic
        self.specs = specs
        self.type = specs[0].type
        self.paths = list(dict.fromkeys(path for spec in specs for path in spec.values))
        self.labels = {s.values[0]: s.labels for s in specs if s.labels}
        self._decoder = decoder
        self._pending: list[Sample] = []
        self._stamps: list[Stamps] = []
        self._seqs: list[Stamps] = []
        self._columns: list[Floats] = []
        self.newest_ns = 0
        self.bad: list[tuple[int, str]] = []
        self.unknown: dict[str, int] = {}

    def push(self, sample: Sample) -> None:
        self.newest_ns = max(self.newest_ns, sample.stamp_ns)
        self._pending.append(sample)
        if len(self._pending) >= _BATCH:
            self._decode_pending()

    def push_block(self, block: SampleBlock) -> None:
        self.newest_ns = max(self.newest_ns, int(block.stamps_ns.max(initial=0)))
        self._decode_pending()
        self._decode(block.stamps_ns, block.seqs, block.messages)

    def _decode_pending(self) -> None:
        batch, self._pending = self._pending, []
        if batch:
            self._decode(
                np.array([s.stamp_ns for s in batch], dtype=np.int64),
                np.array([s.seq for s in batch], dtype=np.int64),
                Messages.joined([s.data for s in batch]),
            )

    def _decode(self, stamps: Stamps, seqs: Stamps, messages: Messages) -> None:
        """Keep (n, len(paths)) values; labels become indices, other texts become numbers."""
        values, texts, bad = self._decoder.decode_block(self.type, self.paths, messages)
        if bad:
            # One bad message must not cost its neighbours.
            rows = sorted(bad)
            self.bad += [(int(stamps[row]), str(bad[row])) for row in rows]
            good = np.ones(len(stamps), dtype=bool)
            good[rows] = False
            stamps, seqs, values = stamps[good], seqs[good], values[good]
            texts = {k: column[good] for k, column in texts.items()}
        for k, path in enumerate(self.paths):
            if path in self.labels:
                column = texts[k] if k in texts else np.array([str(x) for x in values[:, k]], "U")
                values[:, k] = label_indices(column, self.labels[path], stamps, self.unknown)
            elif k in texts:
                values[:, k] = [_number(text) for text in texts[k]]
        self._columns.append(values)
        self._stamps.append(stamps)
        self._seqs.append(seqs)

    def ordered(self, start_ns: int, end_ns: int) -> TopicSamples:
        """The samples inside a window in their order."""
        self._decode_pending()
        if len(self._stamps) != 1:  # joined once: repeated calls pay only for what is new
            none = np.empty(0, dtype=np.int64)
            self._stamps = [np.concatenate([*self._stamps, none])]
            self._seqs = [np.concatenate([*self._seqs, none])]
            self._columns = [np.concatenate([*self._columns, np.empty((0, len(self.paths)))])]
        return ordered_samples(
            {path: k for k, path in enumerate(self.paths)},
            self._stamps[0],
            self._seqs[0],
            self._columns[0],
            (start_ns, end_ns),
            undecodable=self.bad,
            unknown=self.unknown,
        )


def _number(text: object) -> float:
    try:
        return float(str(text))
    except ValueError:
        return float("nan")


class EpisodeBuilder:
    """Takes samples in any order and makes an Episode; `partial` may be called at any time.

    The result depends on the set of samples, and on the order of arrival within a topic. It does
    not depend on how they were batched or interleaved, so a live stream and its bag give equal
    episodes.
    """

    def __init__(
        self, topic_map: TopicMap, decoder: Decoder, *, episode_id: str, name: str, start_ns: int
    ) -> None:
        """Start an episode.

        Args:
            topic_map: which fields to build.
            decoder: turns CDR bytes into columns.
            episode_id: identity of the episode.
            name: short name for people.
            start_ns: samples before it are ignored.
        """
        self.topic_map = topic_map
        self.episode_id = episode_id
        self.name = name
        self.start_ns = start_ns
        by_topic: dict[str, list[FieldSpec]] = {}
        for spec in topic_map.fields.values():
            by_topic.setdefault(spec.topic, []).append(spec)
        self._tracks = {t: _Track(t, specs, decoder) for t, specs in by_topic.items()}

    def push(self, sample: Sample) -> None:
        """Take one sample; topics that are not in the map are refused.

        Raises:
            EpisodeError: if the topic is not in the map (labels and outcomes have no way in).
        """
        track = self._track(sample.topic)
        if sample.stamp_ns >= self.start_ns:
            track.push(sample)

    def push_block(self, block: SampleBlock) -> None:
        """Take many samples of one topic; the episode is the same as with one at a time.

        Raises:
            EpisodeError: if the topic is not in the map.
        """
        track = self._track(block.topic)
        wanted = block.stamps_ns >= self.start_ns
        if not wanted.all():
            block = SampleBlock(
                block.topic,
                block.stamps_ns[wanted],
                block.seqs[wanted],
                block.messages.take(wanted),
            )
        track.push_block(block)

    def _track(self, topic: str) -> _Track:
        track = self._tracks.get(topic)
        if track is None:
            raise EpisodeError(
                f"episode {self.episode_id}: topic {topic!r} is not in the topic map"
            )
        return track

    def partial(self) -> Episode:
        """The episode up to the newest stamp of its clock."""
        track = self._tracks[self.topic_map.clock_topic]
        stamps = track.ordered(self.start_ns, np.iinfo(np.int64).max).stamps
        return self.finish(int(stamps[-1]) if len(stamps) else self.start_ns, {})

    @property
    def settled_ns(self) -> int:
        """Oldest of the newest stamps of the topics that have begun; 0 before the first sample."""
        newest = [track.newest_ns for track in self._tracks.values() if track.newest_ns]
        return min(newest, default=0)

    def settled(self) -> Episode:
        """The episode up to `settled_ns`; samples that arrive in order do not change it."""
        return self.finish(max(self.settled_ns, self.start_ns), {})

    def finish(
        self, end_ns: int, counts: Mapping[str, int], findings: Sequence[Finding] = ()
    ) -> Episode:
        """Make the episode.

        Args:
            end_ns: last stamp that belongs to it.
            counts: distinct stamps per topic, as the owner counted them; may be empty.
            findings: what the caller knows in addition (recovered, aborted).

        Returns:
            The episode on its clock, see `join_topics`.
        """
        window = (self.start_ns, end_ns)
        topics = {topic: track.ordered(*window) for topic, track in self._tracks.items()}
        joined = join_topics(self.topic_map, topics, window, counts=counts, findings=findings)
        return Episode(
            id=self.episode_id,
            name=self.name,
            start_ns=self.start_ns,
            end_ns=end_ns,
            stamps_ns=joined.stamps_ns,
            fields=joined.fields,
            topic_map=self.topic_map,
            findings=joined.findings,
        )
