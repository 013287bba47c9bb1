"""Recording without ROS: samples and episode events in, one bag per episode and notices out."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from curation_ros.bags import open_bag
from curation_ros.bags.qos import QosProfile
from curation_ros.bags.recovery import recover_bag
from curation_ros.bags.writer import BagWriter
from curation_ros.core.episode.gate import DRAIN_S, Closed, EpisodeGate
from curation_ros.core.episode.status import EpisodeEvent, event_to_json
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import BagError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.partials import RECOVERING
from curation_ros.files import FileLock
from curation_ros.version import __version__

_SPACE_PERIOD_S = 1.0


@dataclass(frozen=True)
class RecordedTopic:
    """A mapped topic as it is subscribed: its resolved name, type and QoS."""

    name: str
    type: str
    qos: QosProfile


@dataclass(frozen=True)
class Notice:
    """What happened to the recording of an episode."""

    state: Literal["recording", "closed", "failed"]
    id: str
    name: str
    reason: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)


@dataclass
class _TopicStats:
    """Loss and silence of one topic during one episode."""

    last_seq: int = 0
    last_ns: int = -1
    lost: int = 0
    gaps: int = 0
    longest_ns: int = 0
    back: int = 0
    publishers: int = 1

    def note(self, sample: Sample, max_gap_ns: int) -> None:
        if self.last_ns >= 0:
            step = sample.stamp_ns - self.last_ns
            self.gaps += step > max_gap_ns
            self.back += step < 0
            self.longest_ns = max(self.longest_ns, step)
            if sample.seq and self.last_seq:
                self.lost += max(0, sample.seq - self.last_seq - 1)
                if sample.seq < self.last_seq:  # another publisher counts from its own start
                    self.publishers = max(self.publishers, 2)
        self.last_seq, self.last_ns = sample.seq, sample.stamp_ns


@dataclass
class _OpenBag:
    event: EpisodeEvent
    writer: BagWriter
    lock: FileLock
    stats: dict[str, _TopicStats]


class Recording:
    """Writes one bag per episode into a dataset; each bag appears whole or is recovered later.

    While an episode runs, its bag is partial, and a file lock claims it. So a recorder that starts
    can distinguish a bag that is being written from one whose recorder died.
    """

    def __init__(
        self,
        dataset: Dataset,
        topic_map: TopicMap,
        topics: Mapping[str, RecordedTopic],
        *,
        min_free_mb: float = 500.0,
        drain_timeout_s: float = DRAIN_S,
        flush_period_s: float = 0.1,
        publishers: Callable[[str], int] | None = None,
    ) -> None:
        """Make a recording.

        Args:
            dataset: where bags go.
            topic_map: which topics are recorded.
            topics: topic of the map -> how it is subscribed.
            min_free_mb: with less free space no episode starts, and a running one is closed.
            drain_timeout_s: how long to wait for late samples after an episode ended.
            flush_period_s: at most this much of an episode is lost if the process is killed.
            publishers: topic of the map -> number of its publishers on the graph.
        """
        self.dataset = dataset
        self.topic_map = topic_map
        self.topics = dict(topics)
        self.min_free_mb = min_free_mb
        self.flush_period_s = flush_period_s
        self.gate = EpisodeGate(
            topic_map.topics, max_gap_s=topic_map.max_gap_s, drain_timeout_s=drain_timeout_s
        )
        self._publishers = publishers or (lambda _topic: 1)
        self._open: dict[str, _OpenBag] = {}
        self._known: set[str] = set()
        self._flushed_s = 0.0
        self._space_checked_s = 0.0
        self._max_gap_ns = int(topic_map.max_gap_s * NS_PER_S)

    @property
    def open_ids(self) -> tuple[str, ...]:
        """Episodes that are being written."""
        return tuple(self._open)

    def free_mb(self) -> float:
        """Free space of the dataset's disk; 0 if the disk is gone."""
        try:
            return shutil.disk_usage(self.dataset.path).free / 1e6
        except OSError:
            return 0.0

    def counts(self, episode_id: str) -> dict[str, int]:
        """Distinct stamps per topic that an open episode has so far."""
        window = self.gate.window(episode_id)
        return window.counts() if window is not None else {}

    def event(self, event: EpisodeEvent, now_s: float) -> list[Notice]:
        """Take an event of the episode's owner; `started` opens a bag."""
        was_open = event.id in self.gate.open_ids
        early = self.gate.event(event, now_s)
        notices = []
        if event.event == "started" and event.id in self.gate.open_ids and not was_open:
            if self.dataset.bag_path(event.id).exists():
                self._known.add(event.id)
            else:
                notices.append(self._open_bag(event))
            for sample in sorted(early, key=lambda s: s.log_ns):
                notices += self._write(event.id, sample)
        return notices + self._close_ready(now_s)

    def sample(self, sample: Sample, now_s: float) -> list[Notice]:
        """Take a sample, and write it if it belongs to an episode."""
        episode_id = self.gate.push(sample)
        notices = self._write(episode_id, sample) if episode_id is not None else []
        window = self.gate.window(episode_id) if episode_id is not None else None
        if window is None or window.ended is not None:
            notices += self._close_ready(now_s)
        return notices

    def tick(self, now_s: float) -> list[Notice]:
        """Flush, check the free space, and close complete bags; call it every 0.1 s."""
        notices = []
        if now_s - self._flushed_s >= self.flush_period_s:
            self._flushed_s = now_s
            for episode_id, bag in list(self._open.items()):
                try:
                    bag.writer.flush()
                except BagError as err:
                    notices.append(self._fail(episode_id, str(err)))
        if self._open and now_s - self._space_checked_s >= _SPACE_PERIOD_S:
            self._space_checked_s = now_s
            if self.free_mb() < self.min_free_mb:
                notices += self.abort(f"free space fell below {self.min_free_mb:g} MB")
        return notices + self._close_ready(now_s)

    def abort(self, reason: str) -> list[Notice]:
        """Close every open bag as aborted; each keeps what it has."""
        notices = []
        for episode_id, bag in list(self._open.items()):
            end_ns = max((s.last_ns for s in bag.stats.values()), default=bag.event.start_ns)
            event = replace(
                bag.event,
                event="aborted",
                end_ns=max(end_ns, bag.event.start_ns),
                reason=f"aborted: {reason}",
            )
            notices.append(self._close_bag(Closed(event, self.counts(episode_id), ())))
        return notices

    # --- one bag --------------------------------------------------------------------------------

    def _open_bag(self, event: EpisodeEvent) -> Notice:
        if self.free_mb() < self.min_free_mb:
            reason = f"{self.free_mb():.0f} MB free, at least {self.min_free_mb:g} are wanted"
            return Notice("failed", event.id, event.name, reason)
        folder = self.dataset.partials.path(event.id)
        try:
            lock = self.dataset.partials.claim(event.id)
        except OSError as err:
            reason = f"{err.filename or folder}: {err.strerror}"
            return Notice("failed", event.id, event.name, reason)
        if lock is None:
            return Notice("failed", event.id, event.name, "another recorder has this episode")
        try:
            writer = BagWriter(folder, event.id, custom_data=self._custom_data(event))
        except CurationError as err:
            lock.release()
            return Notice("failed", event.id, event.name, str(err))
        stats = {t: _TopicStats(publishers=self._publishers(t)) for t in self.topics}
        bag = _OpenBag(event, writer, lock, stats)
        try:
            for topic in self.topics.values():
                writer.add_topic(topic.name, topic.type, (topic.qos,))
        except CurationError as err:
            return self._drop(bag, str(err))
        self._open[event.id] = bag
        return Notice("recording", event.id, event.name)

    def _write(self, episode_id: str, sample: Sample) -> list[Notice]:
        bag = self._open.get(episode_id)
        if bag is None:
            # Only a sample makes it a failure: `started` may be latched from long ago.
            if episode_id not in self._known:
                return []
            self._known.remove(episode_id)
            return [Notice("failed", episode_id, "", "the dataset already has this episode")]
        try:
            name = self.topics[sample.topic].name
            bag.writer.write(name, sample.log_ns, sample.publish_ns, sample.seq, sample.data)
        except BagError as err:
            return [self._fail(episode_id, str(err))]
        bag.stats[sample.topic].note(sample, self._max_gap_ns)
        return []

    def _close_ready(self, now_s: float) -> list[Notice]:
        return [
            self._close_bag(closed)
            for closed in self.gate.close_ready(now_s)
            if closed.event.id in self._open
        ]

    def _close_bag(self, closed: Closed) -> Notice:
        bag = self._open.pop(closed.event.id)
        lines = [closed.event.reason] if closed.event.reason else []
        for topic, stats in bag.stats.items():
            stats.publishers = max(stats.publishers, self._publishers(topic))
            if stats.publishers > 1:
                lines.append(f"unknown-loss: topic {topic!r} has {stats.publishers} publishers")
        event = replace(closed.event, reason="\n".join(lines))
        if not any(bag.writer.counts.values()):
            return self._drop(bag, "no message of it has arrived")
        try:
            bag.writer.close(self._custom_data(event, bag.stats, closed))
            self.dataset.partials.publish(event.id)
            self.dataset.partials.forget(event.id)
        except CurationError as err:
            bag.writer.abandon()
            return Notice("failed", event.id, event.name, str(err))
        finally:
            bag.lock.release()
        reason = "; ".join(lines)
        return Notice("closed", event.id, event.name, reason, closed.counts)

    def _drop(self, bag: _OpenBag, reason: str) -> Notice:
        """Remove an empty bag."""
        bag.writer.abandon()
        shutil.rmtree(self.dataset.partials.path(bag.event.id), ignore_errors=True)
        self.dataset.partials.forget(bag.event.id)
        bag.lock.release()
        return Notice("failed", bag.event.id, bag.event.name, reason)

    def _fail(self, episode_id: str, reason: str) -> Notice:
        """Give up a bag; it stays partial, and the next recorder that starts recovers it."""
        bag = self._open.pop(episode_id)
        bag.writer.abandon()
        bag.lock.release()
        return Notice("failed", episode_id, bag.event.name, reason)

    def _custom_data(
        self,
        event: EpisodeEvent,
        stats: Mapping[str, _TopicStats] | None = None,
        closed: Closed | None = None,
    ) -> dict[str, str]:
        data = {
            "episode": json.dumps(event_to_json(event)),
            "topic_map": json.dumps(self.topic_map.to_json()),
            "topics": json.dumps({topic: t.name for topic, t in self.topics.items()}),
            "recorder": f"curation_ros {__version__}",
        }
        if stats is not None and closed is not None:
            recorded = {
                topic: {
                    "count": closed.counts.get(topic, 0),
                    "expected": event.counts.get(topic),
                    "lost": s.lost if s.publishers == 1 else None,
                    "gaps": s.gaps,
                    "longest_gap_ns": s.longest_ns,
                    "stamps_back": s.back,
                    "publishers": s.publishers,
                }
                for topic, s in stats.items()
            }
            data["recording"] = json.dumps({"topics": recorded, "missing": list(closed.missing)})
        return data


def recover_partials(dataset: Dataset) -> list[Notice]:
    """Make whole bags of the partial ones that dead recorders have left.

    Each becomes a new bag under its own id, marked as recovered, and the torn one moves to
    quarantine. Bags that a living recorder writes stay as they are.

    Returns:
        One notice per partial bag: closed, or failed with the reason (the bag then stays where it
        is).
    """
    notices = []
    for partial in dataset.partials.all():
        lock = dataset.partials.claim(partial.name)
        if lock is None:
            continue
        with lock:
            try:
                notices.append(_recover(dataset, partial))
                dataset.partials.forget(partial.name)
            except (CurationError, OSError) as err:
                notices.append(Notice("failed", partial.name, "", f"not recovered: {err}"))
    return notices


def _recover(dataset: Dataset, partial: Path) -> Notice:
    target = dataset.bag_path(partial.name)
    if target.exists():  # a recovery was killed after its bag had appeared as a whole
        reason = "its bag is there already"
    else:
        scratch = partial.with_name(partial.name + RECOVERING)
        report = recover_bag(partial, target, scratch=scratch)
        reason = f"recovered {sum(report.messages.values())} messages ({report.tail})"
    event = open_bag(target).event()
    dataset.quarantine(partial, "partial")
    return Notice("closed", partial.name, event.name if event is not None else "", reason)
