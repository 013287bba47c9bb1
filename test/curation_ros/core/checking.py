"""Episodes with faults, and the findings that the checks give them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from episodes import (
    topic_map,
    with_fields,
)

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode


def ids_of(episode: Episode, baseline: Baseline | None = None) -> list[str]:
    return [f.id for f in check_episode(episode, baseline)]


def only(episode: Episode, finding_id: str, baseline: Baseline | None = None) -> Finding:
    [found] = [f for f in check_episode(episode, baseline) if f.id == finding_id]
    return found


def with_rows(episode: Episode, name: str, rows: slice | int, values: Any) -> Episode:
    field = episode.fields[name].copy()
    field[rows] = values
    return with_fields(episode, **{name: field})


def holding(episode: Episode, first: int, last: int, *names: str) -> Episode:
    """Fields keep the value of row `first` until row `last`, inclusive."""
    for name in names or tuple(episode.fields):
        episode = with_rows(episode, name, slice(first, last + 1), episode.fields[name][first])
    return episode


def resting(episode: Episode, first: int, last: int, *names: str) -> Episode:
    """Fields keep the value of row `first` until row `last`, and go on from there."""
    for name in names or tuple(episode.fields):
        values = episode.fields[name].copy()
        if name not in ("phase", "gripper"):
            values[last + 1 :] += values[first] - values[last]
        values[first : last + 1] = values[first]
        episode = with_fields(episode, **{name: values})
    return episode


def with_padding(episode: Episode, n: int, *, zeros: bool = False) -> Episode:
    """The episode with n more rows: copies of the last one, or zeros."""
    period = int(episode.stamps_ns[1] - episode.stamps_ns[0])
    more = episode.stamps_ns[-1] + period * np.arange(1, n + 1)
    fields = {
        name: np.concatenate([v, np.repeat(v[-1:], n, axis=0) * (0.0 if zeros else 1.0)])
        for name, v in episode.fields.items()
    }
    stamps = np.concatenate([episode.stamps_ns, more])
    return replace(episode, stamps_ns=stamps, end_ns=int(stamps[-1]), fields=fields)


def restamped(episode: Episode, periods_s: Any) -> Episode:
    offsets = np.concatenate([[0], np.cumsum(np.round(np.asarray(periods_s) * 1e9))])
    stamps = episode.stamps_ns[0] + offsets.astype(np.int64)
    return replace(episode, stamps_ns=stamps, end_ns=int(stamps[-1]))


def bare_map(**changes: Any) -> TopicMap:
    """The map of the package without phases."""
    raw = topic_map().to_json()
    del raw["fields"]["phase"]
    raw["state"] = ["eef_position"]
    raw.update(changes)
    return topic_map_from_json(raw)


def without_phase(episode: Episode) -> Episode:
    fields = {k: v for k, v in episode.fields.items() if k != "phase"}
    return replace(episode, fields=fields, topic_map=bare_map())
