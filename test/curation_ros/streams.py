"""Streams of episodes as CDR bytes, as a subscription or a bag yields them; no ROS is needed.

`samples_of(make_episode(...))` is a stream from which the same episode is built again, to the
last bit, so that the made episode is the expectation of a test.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import bag_messages
import numpy as np
from episodes import make_episode, topic_map

from curation_ros.bags import QosProfile
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent, Status
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.dataset.dataset import Dataset
from curation_ros.live.recorder import Notice, RecordedTopic, Recording

#: From a stamp to its message's arrival.
DELAY_NS = 2_000_000
ARM = tuple(f"robot0_joint{k}" for k in range(1, 8))
FINGERS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
#: Space that any machine of ours has.
MIN_FREE_MB = 1.0


def scores_from_status(status: Status) -> dict[str, float | None]:
    """The scores of a decision, None where the scorer abstained."""
    return {
        k.removeprefix("score/"): float(v) if v else None
        for k, v in status.values.items()
        if k.startswith("score/")
    }


def short_episode(
    rng: np.random.Generator | None = None, n_steps: int = 20, **options: Any
) -> Episode:
    """A few steps, for tests that look at bytes and not at motion; the gripper stays open."""
    return make_episode(rng, n_steps, close_at=None, **options)


def messages_of(episode: Episode, step: int) -> dict[str, Any]:
    """Topic of the map -> message (of rosbags) of one step."""
    stamp_ns = int(episode.stamps_ns[step])
    row = {name: values[step].tolist() for name, values in episode.fields.items()}
    joints = dict(zip(ARM, row["joint_position"], strict=True))
    joints |= dict(zip(FINGERS, row["finger_position"], strict=True))
    label = episode.phase_labels[int(row["phase"][0])]
    return {
        "eef_pose": bag_messages.pose(stamp_ns, row["eef_position"], row["eef_quat_xyzw"]),
        "joint_states": bag_messages.joint_state(stamp_ns, joints),
        "objects/akita_black_bowl_1/pose": bag_messages.pose(stamp_ns, row["bowl_position"]),
        "objects/plate_1/pose": bag_messages.pose(stamp_ns, row["plate_position"]),
        "phase": bag_messages.status(stamp_ns, label, {"index": "0", "progress": "0.5"}),
        "command/twist": bag_messages.twist(stamp_ns, row["twist"]),
        "command/gripper": bag_messages.joint_state(stamp_ns, {"gripper": row["gripper"][0]}),
    }


def samples_of(episode: Episode, *, first_seq: int = 1) -> list[Sample]:
    """All messages of an episode in the order in which a simulator in lockstep sends them."""
    out = []
    for step in range(len(episode)):
        stamp_ns = int(episode.stamps_ns[step])
        for k, (topic, message) in enumerate(messages_of(episode, step).items()):
            log_ns = stamp_ns + DELAY_NS + 1000 * k
            data = bag_messages.to_cdr(message)
            out.append(Sample(topic, stamp_ns, first_seq + step, data, log_ns, stamp_ns + 1000))
    return out


def started(episode: Episode, **changes: Any) -> EpisodeEvent:
    """What the owner says at the beginning."""
    event = EpisodeEvent(episode.id, episode.name, "started", episode.start_ns)
    return replace(event, **changes)


def ended(episode: Episode, **changes: Any) -> EpisodeEvent:
    """What the owner says at the end, with a count of every topic."""
    counts = dict.fromkeys(episode.topic_map.topics, len(episode))
    event = EpisodeEvent(
        episode.id, episode.name, "ended", episode.start_ns, episode.end_ns, counts
    )
    return replace(event, **changes)


def recorded_topics(mapped: TopicMap | None = None) -> dict[str, RecordedTopic]:
    """How a recorder in no namespace subscribes to the topics of a map."""
    qos = QosProfile(depth=1000)
    topics = (mapped or topic_map()).topics
    return {t: RecordedTopic(f"/{t}", type_name, qos) for t, type_name in topics.items()}


def make_recording(dataset: Dataset, **options: Any) -> Recording:
    """A recording of the LIBERO robot."""
    options = {"min_free_mb": MIN_FREE_MB, **options}
    return Recording(dataset, topic_map(), recorded_topics(), **options)


def feed(
    recording: Recording,
    episode: Episode,
    samples: Iterable[Sample] | None = None,
    end: EpisodeEvent | None = None,
) -> list[Notice]:
    """Play an episode into a recording, and let its patience run out."""
    notices = recording.event(started(episode), 0.0)
    for sample in samples_of(episode) if samples is None else samples:
        notices += recording.sample(sample, 0.0)
    notices += recording.event(end or ended(episode), 0.0)
    return notices + recording.tick(1e6)


def record(dataset: Dataset, episode: Episode, **options: Any) -> Path:
    """Record an episode into a dataset; returns its bag."""
    notices = feed(make_recording(dataset), episode, **options)
    assert [n.state for n in notices] == ["recording", "closed"], notices
    return dataset.bag_path(episode.id)


def same_arrays(a: Episode, b: Episode) -> bool:
    """Whether two episodes have the same window and, bit by bit, the same values."""
    return a.digest == b.digest


def counts_of(samples: Iterable[Sample]) -> Mapping[str, int]:
    """Distinct stamps by topic."""
    found: dict[str, set[int]] = {}
    for sample in samples:
        found.setdefault(sample.topic, set()).add(sample.stamp_ns)
    return {topic: len(stamps) for topic, stamps in found.items()}
