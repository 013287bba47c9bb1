"""Takes of a graph for the live curator, and a curator that watches them."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from decided import decide_on
from episodes import make_episode, make_reference, topic_map
from streams import ended, samples_of, started

from curation_ros.bags import CdrDecoder
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.live.curator import Decided, LiveCurator

DRAIN_S = 3.0
#: A scorer of each kind; the others take seconds to fit and are tested on their own.
SCORERS = ("gripper_timing", "smoothness", "knn", "length")


@functools.cache
def fitted() -> Curation:
    return Curation.fit(
        CurationSettings(scorers=SCORERS), make_reference(np.random.default_rng(7))
    )


@functools.cache
def good_take() -> Episode:
    return make_episode(np.random.default_rng(1), name="good")


@functools.cache
def early_take() -> Episode:
    """The object is let go in mid-air."""
    return make_episode(np.random.default_rng(2), open_at=140, name="early")


@functools.cache
def stream_of(name: str) -> tuple[Sample, ...]:
    return tuple(samples_of({"good": good_take, "early": early_take}[name]()))


def live_curator(dataset: Dataset, curation: Curation | None = None) -> LiveCurator:
    return LiveCurator(
        dataset, topic_map(), CdrDecoder(), curation or fitted(), drain_timeout_s=DRAIN_S
    )


def watch(
    live: LiveCurator,
    episode: Episode,
    samples: Iterable[Sample],
    end: EpisodeEvent | None = None,
    source: str = "live",
) -> list[Decided]:
    """Play an episode to a curator, and let its patience run out."""
    decided = live.event(started(episode, source=source), 0.0)
    for sample in samples:
        decided += live.sample(sample, 0.0)
    decided += live.event(end or ended(episode, source=source), 0.0)
    return decided + live.tick(DRAIN_S)


def interleaved(samples: Sequence[Sample], seed: int) -> list[Sample]:
    """The same stream as another subscriber may receive it: in order within a topic only."""
    queues: dict[str, list[Sample]] = {}
    for sample in samples:
        queues.setdefault(sample.topic, []).append(sample)
    waiting = {topic: iter(queue) for topic, queue in queues.items()}
    turns = np.random.default_rng(seed).permutation([s.topic for s in samples])
    return [next(waiting[topic]) for topic in turns]


def only_decision(decided: list[Decided]) -> Decision:
    """The one decision on a bag."""
    [one] = decided
    assert one.latency_s is None
    return one.decision


def decision_on_bag(dataset: Dataset, episode: Episode) -> Decision:
    return decide_on(fitted(), read_episode(dataset.bag_path(episode.id)))


def stripped(decision: Decision) -> Decision:
    """A decision without what only its log knows."""
    evidence = {k: v for k, v in decision.evidence.items() if k != "bag"}
    return replace(decision, revision=1, evidence=evidence)
