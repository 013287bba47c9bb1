"""Other readers of bags, used as their documentation does, and what they read as our arrays."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import mcap_ros2.decoder
import mcap_ros2_support_fast.decoder
import numpy as np
import numpy.typing as npt
from made_bags import ARM
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.messages import POSE
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.types import NS_PER_S

Arrays = dict[str, npt.NDArray[Any]]
#: A file and the wanted topics -> (topic, message).
MessageReader = Callable[[Path, list[str]], Iterator[tuple[str, Any]]]
#: Lists of numbers in a JointState.
LISTS = ("position", "velocity", "effort")


def read_rosbags(path: Path, topics: list[str]) -> Iterator[tuple[str, Any]]:
    """Read messages with rosbags."""
    with AnyReader([path.parent]) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        for connection, _, raw in reader.messages(connections):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


def read_mcap(factory: Any) -> MessageReader:
    """Make a reader from the mcap package and a decoder factory.

    One factory serves many files, although it keeps decoders by schema id. Here equal ids mean
    equal schemas, and a new decoder for each file would take most of the time.
    """

    def read(path: Path, topics: list[str]) -> Iterator[tuple[str, Any]]:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[factory])
            for _, channel, _, message in reader.iter_decoded_messages(
                topics, log_time_order=False
            ):
                yield channel.topic, message

    return read


#: Reader -> function that makes it, for files whose schemas have the same ids.
READERS: dict[str, Callable[[], MessageReader]] = {
    "rosbags": lambda: read_rosbags,
    "mcap-ros2-support": lambda: read_mcap(mcap_ros2.decoder.DecoderFactory()),
    "mcap-ros2-support-fast": lambda: read_mcap(mcap_ros2_support_fast.decoder.DecoderFactory()),
}


def _stamps(messages: list[Any]) -> npt.NDArray[np.int64]:
    return np.array([m.header.stamp.sec * NS_PER_S + m.header.stamp.nanosec for m in messages])


def _poses(messages: list[Any]) -> npt.NDArray[np.float64]:
    return np.array(
        [
            (p.position.x, p.position.y, p.position.z, o.x, o.y, o.z, o.w)
            for p, o in [(m.pose, m.pose.orientation) for m in messages]
        ]
    )


def arrays_by(reader: MessageReader, path: Path, type_name: str) -> Arrays:
    """A topic as arrays, by another reader."""
    messages = [message for _, message in reader(path, ["/topic"])]
    if type_name == POSE:
        return {"stamps": _stamps(messages), "values": _poses(messages)}
    values = [np.array([getattr(m, x) for m in messages]) for x in LISTS]
    return {"stamps": _stamps(messages), "values": np.concatenate(values, axis=1)}


def episode_by(
    reader: MessageReader, path: Path, topic_map: TopicMap, event: EpisodeEvent
) -> Episode:
    """An episode by another reader.

    Args:
        reader: reads the messages.
        path: file of the bag.
        topic_map: how to build the episode.
        event: everything else that is known about the episode.
    """
    found: dict[str, list[Any]] = {f"/{topic}": [] for topic in topic_map.topics}
    for topic, message in reader(path, list(found)):
        found[topic].append(message)
    eef, joints = _poses(found["/eef_pose"]), found["/joint_states"]
    order = [joints[0].name.index(name) for name in ARM]
    position = np.array([m.position for m in joints])[:, order]
    [labels] = [spec.labels for spec in topic_map.with_role("phase")]
    index = {label: float(k) for k, label in enumerate(labels)}
    fields: Mapping[str, npt.NDArray[np.float64]] = {
        "eef_position": eef[:, :3],
        "eef_quat_xyzw": eef[:, 3:],
        "joint_position": position[:, :7],
        "finger_position": position[:, 7:],
        "bowl_position": _poses(found["/objects/akita_black_bowl_1/pose"])[:, :3],
        "plate_position": _poses(found["/objects/plate_1/pose"])[:, :3],
        "phase": np.array([[index[m.status[0].message]] for m in found["/phase"]]),
        "twist": np.array(
            [(v.x, v.y, v.z) for v in [m.twist.linear for m in found["/command/twist"]]]
        ),
        "gripper": np.array([m.position for m in found["/command/gripper"]]),
    }
    stamps = _stamps(found["/eef_pose"])
    for messages in found.values():
        if not np.array_equal(_stamps(messages), stamps):
            raise SystemExit("the benchmark has written an episode whose stamps differ")
    return Episode(
        id=event.id,
        name=event.name,
        start_ns=event.start_ns,
        end_ns=int(stamps[-1]),
        stamps_ns=stamps,
        fields={name: np.ascontiguousarray(fields[name]) for name in topic_map.fields},
        topic_map=topic_map,
    )
