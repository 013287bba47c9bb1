"""Samples of all topics onto the clock of an episode, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.stream import Stamps
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.types import NS_PER_S, Floats, Mask, Span

#: First and last stamp, inclusive.
Window: TypeAlias = tuple[int, int]

_NONE = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class TopicSamples:
    """The samples of one topic within an episode.

    Attributes:
        columns: path -> its column in `values`; see `FieldSpec.values`.
        stamps: (n,) strictly increasing, nanoseconds.
        values: (n, len(columns)).
        conflict_ns: stamps of samples that were left out and have other values than the one kept.
        back_ns: stamps after which the next sample was older.
        undecodable: (stamp, why) of each message that could not be decoded.
        unknown: label that is not in the topic map -> its first stamp.
    """

    columns: Mapping[str, int]
    stamps: Stamps
    values: Floats
    conflict_ns: Stamps = field(default_factory=_NONE.copy)
    back_ns: Stamps = field(default_factory=_NONE.copy)
    undecodable: Sequence[tuple[int, str]] = ()
    unknown: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Joined:
    """The arrays of an episode.

    Attributes:
        stamps_ns: (T,) stamps of the clock.
        fields: name -> (T, D).
        findings: in a stable order.
    """

    stamps_ns: Stamps
    fields: Mapping[str, Floats]
    findings: tuple[Finding, ...]


def ordered_samples(
    columns: Mapping[str, int],
    stamps: Stamps,
    seqs: Stamps,
    values: Floats,
    window: Window,
    *,
    undecodable: Sequence[tuple[int, str]] = (),
    unknown: Mapping[str, int] | None = None,
) -> TopicSamples:
    """The samples inside a window by (stamp, sequence number, arrival), one per stamp.

    Args:
        columns: path -> its column in `values`.
        stamps: (n,) in the order of arrival.
        seqs: (n,) sequence numbers.
        values: (n, len(columns)).
        window: first and last stamp.
        undecodable: (stamp, why) of each message that could not be decoded.
        unknown: label that is not in the topic map -> its first stamp.
    """
    start_ns, end_ns = window
    bad = [(ns, text) for ns, text in undecodable if start_ns <= ns <= end_ns]
    labels = {k: ns for k, ns in (unknown or {}).items() if start_ns <= ns <= end_ns}
    steps = np.diff(stamps)
    if not len(stamps) or (steps > 0).all():
        # In order, and each stamp once: nothing to sort, nothing to choose from.
        low = int(np.searchsorted(stamps, start_ns))
        high = int(np.searchsorted(stamps, end_ns, side="right"))
        return TopicSamples(
            columns, stamps[low:high], values[low:high], undecodable=bad, unknown=labels
        )
    inside = (stamps >= start_ns) & (stamps <= end_ns)
    stamps, values = stamps[inside], values[inside]
    # lexsort is stable: samples that are equal in both keys stay in arrival order.
    order = np.lexsort((seqs[inside], stamps))
    first = np.ones(len(order), dtype=bool)
    first[1:] = np.diff(stamps[order]) != 0
    kept = order[first]
    group = np.cumsum(first) - 1
    differs = ~np.all(
        (values[order] == values[kept][group])
        | (np.isnan(values[order]) & np.isnan(values[kept][group])),
        axis=1,
    )
    return TopicSamples(
        columns,
        stamps[kept],
        values[kept],
        conflict_ns=stamps[order][differs],
        back_ns=stamps[np.flatnonzero(np.diff(stamps) < 0)],
        undecodable=bad,
        unknown=labels,
    )


def label_indices(
    column: npt.NDArray[np.str_] | npt.NDArray[np.object_],
    labels: Sequence[str],
    stamps_ns: Stamps,
    unknown: dict[str, int],
) -> Floats:
    """(n,) index of each label, -1 for those that are not in the map.

    Args:
        column: (n,) texts.
        labels: of the map, in their order.
        stamps_ns: (n,) stamps of the texts.
        unknown: label that is not in the map -> its first stamp; added to.
    """
    values = np.full(len(column), -1.0)
    for index, label in enumerate(labels):
        values[column == label] = index
    for row in np.flatnonzero(values < 0):
        text, stamp_ns = str(column[row]), int(stamps_ns[row])
        unknown[text] = min(unknown.get(text, stamp_ns), stamp_ns)
    return values


def join_topics(
    topic_map: TopicMap,
    topics: Mapping[str, TopicSamples],
    window: Window,
    *,
    counts: Mapping[str, int] | None = None,
    findings: Sequence[Finding] = (),
) -> Joined:
    """Join the samples of all topics on the clock.

    Equal stamps join exactly. Otherwise an observation is the last sample at or before t, and an
    action the first in [t, t + max_gap_s). Steps at either end for which a topic has no value yet
    or no more are left out.

    Args:
        topic_map: which fields to build.
        topics: samples of every topic of the map.
        window: first and last stamp of the episode.
        counts: distinct stamps per topic, as the owner of the episode counted them.
        findings: what the caller knows in addition.
    """
    start_ns, _ = window
    found = list(findings)
    for topic, samples in topics.items():
        expected = (counts or {}).get(topic)
        found += topic_findings(topic, samples, window, topic_map.max_gap_s, expected)
    clock = topics[topic_map.clock_topic].stamps
    fields = {}
    complete = np.ones(len(clock), dtype=bool)
    for spec in topic_map.fields.values():
        is_command = spec.topic in topic_map.command_topics
        limit_ns = int(topic_map.max_gap_s * NS_PER_S) if is_command else None
        values, valid = _on_clock(spec, topics[spec.topic], clock, start_ns, limit_ns)
        fields[spec.name] = values
        if len(topics[spec.topic].stamps):
            complete &= valid
    rows = np.flatnonzero(complete)
    first, last = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
    return Joined(
        clock[first:last],
        {k: v[first:last] for k, v in fields.items()},
        tuple(sorted(found, key=lambda f: (f.id, f.span, f.message))),
    )


def _on_clock(
    spec: FieldSpec, samples: TopicSamples, clock: Stamps, start_ns: int, limit_ns: int | None
) -> tuple[Floats, Mask]:
    """(T, D) values of a field on the clock, NaN where there are none, and which rows are valid.

    `limit_ns` is how long after a step the command may come; None for observations.
    """
    columns = [samples.columns[path] for path in spec.values]
    stamps = samples.stamps
    if np.array_equal(stamps, clock) and not spec.interpolate:
        return np.take(samples.values, columns, axis=1), np.ones(len(clock), dtype=bool)
    values = np.full((len(clock), len(columns)), np.nan)
    if not len(stamps):
        return values, np.zeros(len(clock), dtype=bool)
    if limit_ns is not None:
        index = np.searchsorted(stamps, clock, side="left")
        valid = index < len(stamps)
        valid &= stamps[np.minimum(index, len(stamps) - 1)] < clock + limit_ns
    else:
        index = np.searchsorted(stamps, clock, side="right") - 1
        valid = index >= 0
    values[valid] = samples.values[index[valid]][:, columns]
    if spec.interpolate and valid.any():
        # Offsets: as float64, stamps of today are 256 ns apart.
        at, known = clock[valid] - start_ns, stamps - start_ns
        for k, column in enumerate(columns):
            values[valid, k] = np.interp(at, known, samples.values[:, column])
    return values, valid


def topic_findings(
    topic: str,
    samples: TopicSamples,
    window: Window,
    max_gap_s: float,
    expected: int | None = None,
) -> list[Finding]:
    """What is wrong with the samples of one topic.

    Args:
        topic: its name.
        samples: inside the window.
        window: first and last stamp of the episode.
        max_gap_s: silence that is longer is a finding.
        expected: distinct stamps that the owner of the episode counted, if it did.
    """
    start_ns, end_ns = window
    whole = (0, max(0, end_ns - start_ns))
    found = []

    def at(stamp_ns: int) -> Span:
        offset = min(max(0, stamp_ns - start_ns), whole[1])
        return (offset, offset)

    bad = samples.undecodable
    if bad:
        message = f"topic {topic!r}: {len(bad)} undecodable messages, first: {bad[0][1]}"
        found.append(Finding("undecodable", message, at(bad[0][0])))
    stamps = samples.stamps
    if not len(stamps):
        message = f"topic {topic!r} has no sample in the episode"
        return [*found, Finding("missing-topic", message, whole)]
    if expected is not None and len(stamps) < expected:
        message = f"topic {topic!r}: {len(stamps)} of {expected} samples"
        found.append(Finding("incomplete", message, whole))
    if len(samples.conflict_ns):
        message = f"topic {topic!r}: {len(samples.conflict_ns)} stamps with differing values"
        found.append(Finding("duplicate-stamp", message, at(int(samples.conflict_ns[0]))))
    if len(samples.back_ns):
        message = f"topic {topic!r}: stamps went back {len(samples.back_ns)} times"
        found.append(Finding("clock-back", message, at(int(samples.back_ns[0]))))
    finite = np.isfinite(samples.values)
    if not finite.all():
        bad_rows = np.flatnonzero(~finite.all(axis=1))
        message = f"topic {topic!r}: {len(bad_rows)} samples with NaN or infinite values"
        found.append(Finding("not-finite", message, at(int(stamps[bad_rows[0]]))))
    for label, stamp_ns in sorted(samples.unknown.items()):
        message = f"topic {topic!r}: phase {label!r} is not in the topic map"
        found.append(Finding("unknown-phase", message, at(stamp_ns)))
    return found + _gaps(topic, stamps, window, max_gap_s)


def _gaps(topic: str, stamps: Stamps, window: Window, max_gap_s: float) -> list[Finding]:
    """The longest silence that is too long, if there is one; also at both ends."""
    edges = np.concatenate([window[:1], stamps, window[1:]])
    silent = np.diff(edges)
    gaps = np.flatnonzero(silent > int(max_gap_s * NS_PER_S))
    if not len(gaps):
        return []
    worst = int(gaps[np.argmax(silent[gaps])])
    begin, stop = int(edges[worst]) - window[0], int(edges[worst + 1]) - window[0]
    message = (
        f"topic {topic!r}: silent for {(stop - begin) / NS_PER_S:.3f} s from "
        f"{begin / NS_PER_S:.3f} s ({len(gaps)} gaps above {max_gap_s} s)"
    )
    return [Finding("gap", message, (begin, stop))]
