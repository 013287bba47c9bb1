"""The resampling rule of docs/topic-map.md, written down once more: slowly, and step by step.

It shares nothing with the builder, so that the two may be compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from curation_ros.core.episode.topic_map import FieldSpec, TopicMap

#: Stamp and columns of one message.
Row: TypeAlias = tuple[int, Sequence[float]]


def resample(
    rows: Mapping[str, Sequence[Row]], topic_map: TopicMap, start_ns: int, end_ns: int
) -> tuple[list[int], dict[str, list[list[float]]]]:
    """Values of every field at every stamp of the clock.

    Args:
        rows: field -> what its topic said, in any order, one row a stamp.
        topic_map: roles, interpolation and max_gap_s.
        start_ns, end_ns: window, inclusive.

    Returns:
        The stamps, and field -> a row a stamp.
    """
    inside = {
        name: sorted((ns, list(values)) for ns, values in some if start_ns <= ns <= end_ns)
        for name, some in rows.items()
    }
    gap_ns = int(topic_map.max_gap_s * 1e9)
    stamps = [ns for ns, _ in inside[topic_map.clock]]
    table = {
        name: [_value(spec, inside[name], ns, gap_ns) for ns in stamps]
        for name, spec in topic_map.fields.items()
    }
    complete = [all(row is not None for row in step) for step in zip(*table.values(), strict=True)]
    if not any(complete):
        return [], {name: [] for name in table}
    first, last = complete.index(True), len(complete) - complete[::-1].index(True)
    width = {name: len(spec.values) for name, spec in topic_map.fields.items()}
    return stamps[first:last], {
        name: [
            row if row is not None else [float("nan")] * width[name] for row in some[first:last]
        ]
        for name, some in table.items()
    }


def _value(
    spec: FieldSpec, rows: Sequence[tuple[int, list[float]]], ns: int, gap_ns: int
) -> list[float] | None:
    if spec.role in ("action", "gripper"):  # the answer to what was seen
        answers = [values for stamp, values in rows if ns <= stamp < ns + gap_ns]
        return answers[0] if answers else None
    seen = [(stamp, values) for stamp, values in rows if stamp <= ns]
    if not seen:
        return None
    before, values = seen[-1]
    to_come = [(stamp, following) for stamp, following in rows if stamp > ns]
    if not spec.interpolate or not to_come:
        return values
    after, following = to_come[0]
    share = (ns - before) / (after - before)
    return [a + share * (b - a) for a, b in zip(values, following, strict=True)]
