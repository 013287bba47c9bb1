"""Builds an episode from a stream of samples, one by one: the same code live and from a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.stream import Decoder, Messages, Sample, SampleBlock, Stamps
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S, Floats

# Decoding many messages in one pass is far cheaper than one by one; doing it while the episode
# runs leaves little for the moment its gate closes.
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
        """Keep (n, len(paths)) values; labels become indices, text becomes numbers."""
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
                values[:, k] = self._indices(column, self.labels[path], stamps)
            elif k in texts:
                values[:, k] = [_number(text) for text in texts[k]]
        self._columns.append(values)
        self._stamps.append(stamps)
        self._seqs.append(seqs)

    def _indices(
        self, column: npt.NDArray[np.str_], labels: Sequence[str], stamps: Stamps
    ) -> Floats:
        values = np.full(len(column), -1.0)
        for index, label in enumerate(labels):
            values[column == label] = index
        for row in np.flatnonzero(values < 0):
            text, stamp_ns = str(column[row]), int(stamps[row])
            self.unknown[text] = min(self.unknown.get(text, stamp_ns), stamp_ns)
        return values

    def ordered(self, start_ns: int, end_ns: int) -> _Ordered:
        """Samples inside the window by (stamp, seq, arrival), one a stamp."""
        self._decode_pending()
        none = np.empty(0, dtype=np.int64)
        stamps = np.concatenate([*self._stamps, none])
        values = np.concatenate([*self._columns, np.empty((0, len(self.paths)))])
        # Joined once: who asks for `partial` again and again pays for what is new alone.
        self._stamps, self._columns = [stamps], [values]
        steps = np.diff(stamps)
        if not len(stamps) or (steps > 0).all():
            # They came in order, each stamp once: nothing to sort, nothing to choose from.
            low = int(np.searchsorted(stamps, start_ns))
            high = int(np.searchsorted(stamps, end_ns, side="right"))
            return _Ordered(stamps[low:high], values[low:high], conflict_ns=none, back_ns=none)
        inside = (stamps >= start_ns) & (stamps <= end_ns)
        stamps, values = stamps[inside], values[inside]
        seqs = np.concatenate([*self._seqs, none])[inside]
        # lexsort is stable: what is equal in both keys stays in arrival order.
        order = np.lexsort((seqs, stamps))
        first = np.ones(len(order), dtype=bool)
        first[1:] = np.diff(stamps[order]) != 0
        kept = order[first]
        group = np.cumsum(first) - 1
        differs = ~np.all(
            (values[order] == values[kept][group])
            | (np.isnan(values[order]) & np.isnan(values[kept][group])),
            axis=1,
        )
        back = np.flatnonzero(np.diff(stamps) < 0)
        return _Ordered(
            stamps[kept],
            values[kept],
            conflict_ns=stamps[order][differs],
            back_ns=stamps[back],
        )


@dataclass(frozen=True)
class _Ordered:
    stamps: Stamps
    values: Floats
    conflict_ns: Stamps
    back_ns: Stamps


def _number(text: object) -> float:
    try:
        return float(str(text))
    except ValueError:
        return float("nan")


class EpisodeBuilder:
    """Takes samples in any order and makes an Episode; `partial` may be asked at any time.

    The result depends on the set of samples (and on the arrival order within a topic), never on
    how they were batched or interleaved: so a live stream and its bag give equal episodes.
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
        """Take many samples of one topic; the episode is the same as if they came one by one.

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
        """Stamp up to which every topic that has begun has come; 0 before the first sample."""
        newest = [track.newest_ns for track in self._tracks.values() if track.newest_ns]
        return min(newest, default=0)

    def settled(self) -> Episode:
        """The episode up to `settled_ns`: samples that come in order do not change it."""
        return self.finish(max(self.settled_ns, self.start_ns), {})

    def finish(
        self, end_ns: int, counts: Mapping[str, int], findings: Sequence[Finding] = ()
    ) -> Episode:
        """Make the episode.

        Args:
            end_ns: last stamp that belongs to it.
            counts: distinct stamps a topic, as its owner counted them; may be empty.
            findings: what the caller knows beside (recovered, aborted).

        Returns:
            The episode on its clock: equal stamps join exactly; else an observation is the last
            sample at or before t and an action the first in [t, t + max_gap_s). Steps at either
            end for which a topic has no value yet or no more are left out.
        """
        found = list(findings)
        tracks = {t: track.ordered(self.start_ns, end_ns) for t, track in self._tracks.items()}
        for topic, ordered in tracks.items():
            found += self._topic_findings(topic, ordered, end_ns, counts.get(topic))
        clock = tracks[self.topic_map.clock_topic].stamps
        fields = {}
        complete = np.ones(len(clock), dtype=bool)
        for spec in self.topic_map.fields.values():
            values, valid = self._join(spec, tracks[spec.topic], clock)
            fields[spec.name] = values
            if len(tracks[spec.topic].stamps):
                complete &= valid
        rows = np.flatnonzero(complete)
        first, last = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        order = sorted(found, key=lambda f: (f.id, f.span, f.message))
        return Episode(
            id=self.episode_id,
            name=self.name,
            start_ns=self.start_ns,
            end_ns=end_ns,
            stamps_ns=clock[first:last],
            fields={k: v[first:last] for k, v in fields.items()},
            topic_map=self.topic_map,
            findings=tuple(order),
        )

    def _join(
        self, spec: FieldSpec, ordered: _Ordered, clock: Stamps
    ) -> tuple[Floats, npt.NDArray[np.bool_]]:
        """(T, D) values of a field on the clock, NaN where there are none, and which rows are."""
        track = self._tracks[spec.topic]
        columns = [track.paths.index(path) for path in spec.values]
        stamps = ordered.stamps
        if np.array_equal(stamps, clock) and not spec.interpolate:
            return np.take(ordered.values, columns, axis=1), np.ones(len(clock), dtype=bool)
        values = np.full((len(clock), len(columns)), np.nan)
        if not len(stamps):
            return values, np.zeros(len(clock), dtype=bool)
        if spec.topic in self.topic_map.command_topics:
            index = np.searchsorted(stamps, clock, side="left")
            limit = int(self.topic_map.max_gap_s * NS_PER_S)
            valid = (index < len(stamps)) & (
                stamps[np.minimum(index, len(stamps) - 1)] < clock + limit
            )
        else:
            index = np.searchsorted(stamps, clock, side="right") - 1
            valid = index >= 0
        values[valid] = ordered.values[index[valid]][:, columns]
        if spec.interpolate and valid.any():
            # Offsets: as float64, stamps of today are 256 ns apart.
            at, known = clock[valid] - self.start_ns, stamps - self.start_ns
            for k, column in enumerate(columns):
                values[valid, k] = np.interp(at, known, ordered.values[:, column])
        return values, valid

    def _topic_findings(
        self, topic: str, ordered: _Ordered, end_ns: int, expected: int | None
    ) -> list[Finding]:
        track = self._tracks[topic]
        whole = (0, max(0, end_ns - self.start_ns))
        found = []

        def at(stamp_ns: int) -> tuple[int, int]:
            offset = min(max(0, stamp_ns - self.start_ns), whole[1])
            return (offset, offset)

        inside = [(ns, text) for ns, text in track.bad if self.start_ns <= ns <= end_ns]
        if inside:
            message = f"topic {topic!r}: {len(inside)} undecodable messages, first: {inside[0][1]}"
            found.append(Finding("undecodable", message, at(inside[0][0])))
        stamps = ordered.stamps
        if not len(stamps):
            message = f"topic {topic!r} has no sample in the episode"
            return [*found, Finding("missing-topic", message, whole)]
        if expected is not None and len(stamps) < expected:
            message = f"topic {topic!r}: {len(stamps)} of {expected} samples"
            found.append(Finding("incomplete", message, whole))
        if len(ordered.conflict_ns):
            message = f"topic {topic!r}: {len(ordered.conflict_ns)} stamps with differing values"
            found.append(Finding("duplicate-stamp", message, at(int(ordered.conflict_ns[0]))))
        if len(ordered.back_ns):
            message = f"topic {topic!r}: stamps went back {len(ordered.back_ns)} times"
            found.append(Finding("clock-back", message, at(int(ordered.back_ns[0]))))
        finite = np.isfinite(ordered.values)
        if not finite.all():
            bad_rows = np.flatnonzero(~finite.all(axis=1))
            message = f"topic {topic!r}: {len(bad_rows)} samples with NaN or infinite values"
            found.append(Finding("not-finite", message, at(int(stamps[bad_rows[0]]))))
        unknown = {k: v for k, v in track.unknown.items() if self.start_ns <= v <= end_ns}
        for label, stamp_ns in sorted(unknown.items()):
            message = f"topic {topic!r}: phase {label!r} is not in the topic map"
            found.append(Finding("unknown-phase", message, at(stamp_ns)))
        edges = np.concatenate([[self.start_ns], stamps, [end_ns]])
        silent = np.diff(edges)
        limit = int(self.topic_map.max_gap_s * NS_PER_S)
        if (silent > limit).any():
            gaps = np.flatnonzero(silent > limit)
            worst = int(gaps[np.argmax(silent[gaps])])
            begin, stop = int(edges[worst]) - self.start_ns, int(edges[worst + 1]) - self.start_ns
            message = (
                f"topic {topic!r}: silent for {(stop - begin) / NS_PER_S:.3f} s from "
                f"{begin / NS_PER_S:.3f} s ({len(gaps)} gaps above {self.topic_map.max_gap_s} s)"
            )
            found.append(Finding("gap", message, (begin, stop)))
        return found
