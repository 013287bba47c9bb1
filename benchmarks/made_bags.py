"""Bags in the form that our recorder writes, for benchmarks of reading."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from curation_ros.bags import BagWriter
from curation_ros.bags.messages import to_cdr
from curation_ros.core.episode import messages
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.messages import JOINT_STATE, POSE, STATUS_ARRAY, TWIST, PlainMessage
from curation_ros.core.episode.status import EpisodeEvent, Status, event_to_json, phase_to_status
from curation_ros.core.episode.topic_map import TopicMap

N_MESSAGES = 5000
N_STEPS = 350
STEP_NS = 50_000_000
START_NS = 1_781_000_000_000_000_000
#: Steps per chunk. The recorder flushes every 0.1 s, which ends a chunk. In that time the
#: simulator makes about 25 steps in lockstep, and a robot at 20 Hz makes 2.
STEPS_PER_CHUNK = {"lockstep": 25, "20 Hz": 2}
ARM = [f"robot0_joint{k}" for k in range(1, 8)] + [f"gripper0_finger_joint{k}" for k in (1, 2)]
_QUAT_XYZW = (1.0, 0.0, 0.0, 0.0)
_PLATE_M = (0.05, 0.2, 0.9)


def _write(writer: BagWriter, message: PlainMessage, stamp_ns: int, number: int) -> None:
    topic = f"/{message.topic}"
    writer.add_topic(topic, message.type)
    data = to_cdr(message.type, message.content)
    writer.write(topic, stamp_ns + 2_000_000, stamp_ns, number, data)


def write_topic(folder: Path, type_name: str) -> Path:
    """Write a bag with many messages of one topic.

    Args:
        folder: of the bag.
        type_name: JOINT_STATE or POSE.

    Returns:
        The file of the bag.
    """
    rng = np.random.default_rng(1)
    writer = BagWriter(folder, folder.name)
    for k in range(N_MESSAGES):
        stamp_ns = START_NS + k * STEP_NS
        if type_name == JOINT_STATE:
            position, velocity, effort = rng.standard_normal((3, len(ARM)))
            content = messages.joint_state(ARM, position, velocity, effort, stamp_ns)
        else:
            values = rng.standard_normal(7)
            content = messages.pose(values[:3], values[3:], stamp_ns)
        _write(writer, PlainMessage("topic", type_name, content), stamp_ns, k + 1)
        if (k + 1) % STEPS_PER_CHUNK["lockstep"] == 0:
            writer.flush()
    writer.close()
    return writer.path


@dataclass(frozen=True)
class Motion:
    """A pick and place, with one row per step.

    Attributes:
        phase: (T,) index of the phase.
        progress: (T,) progress within the phase.
        twist: (T, 3) command, unitless.
        eef_m: (T, 3) position of the effector.
        bowl_m: (T, 3) position of the bowl.
        joints: (T, 3, 9) position, velocity and effort of ARM.
        is_closed: (T,) whether the gripper is commanded to be closed.
    """

    phase: npt.NDArray[np.int64]
    progress: npt.NDArray[np.float64]
    twist: npt.NDArray[np.float64]
    eef_m: npt.NDArray[np.float64]
    bowl_m: npt.NDArray[np.float64]
    joints: npt.NDArray[np.float64]
    is_closed: npt.NDArray[np.bool_]


def make_motion(number: int) -> Motion:
    """The motion of a demonstration; way, durations and goal vary with its number."""
    rng = np.random.default_rng(number)
    edges = np.cumsum([0, 60, 45, 20, 60, 130]) + np.concatenate([[0], rng.integers(-6, 7, 5)])
    phase = np.searchsorted(edges, np.arange(N_STEPS), side="right") - 1
    ways = np.array(
        [[0.3, 0.2, -0.2], [0, 0, -0.6], [0, 0, 0], [0, 0, 0.6], [0.2, 0.4, -0.1], [0, 0, 0]]
    )
    twist = np.clip(
        (ways + 0.05 * rng.standard_normal(ways.shape))[phase]
        + 0.02 * rng.standard_normal((N_STEPS, 3)),
        -1,
        1,
    )
    eef = np.array([0.0, 0.0, 1.2]) + np.cumsum(twist * 0.013, axis=0)
    is_closed = (phase >= 2) & (phase < 5)
    width = np.convolve(np.where(is_closed, 0.012, 0.08), np.ones(4) / 4, mode="full")[:N_STEPS]
    width[:3] = 0.08
    joints = np.cumsum(0.01 * rng.standard_normal((N_STEPS, 3, len(ARM))), axis=0)
    joints[:, 0, 7:] = np.column_stack([width / 2, -width / 2])
    bowl = np.where(is_closed[:, None], eef, eef[int(np.argmax(is_closed))])
    progress = (np.arange(N_STEPS) - edges[phase]) / N_STEPS
    return Motion(phase, progress, twist, eef, bowl, joints, is_closed)


def messages_at(motion: Motion, k: int, t: int, phase: Status) -> Iterator[PlainMessage]:
    """All messages of step `k`, at stamp `t`."""

    def pose(topic: str, position_m: Iterable[float]) -> PlainMessage:
        return PlainMessage(topic, POSE, messages.pose(position_m, _QUAT_XYZW, t))

    def joints(topic: str, names: list[str], values: Iterable[Iterable[float]]) -> PlainMessage:
        position, velocity, effort = values
        content = messages.joint_state(names, position, velocity, effort, t)
        return PlainMessage(topic, JOINT_STATE, content)

    yield pose("eef_pose", motion.eef_m[k])
    yield joints("joint_states", ARM, motion.joints[k])
    yield pose("objects/akita_black_bowl_1/pose", motion.bowl_m[k])
    yield pose("objects/plate_1/pose", _PLATE_M)
    yield PlainMessage("phase", STATUS_ARRAY, messages.status_array([phase], t))
    yield PlainMessage("command/twist", TWIST, messages.twist(motion.twist[k], t))
    gripper = 1.0 if motion.is_closed[k] else -1.0
    yield joints("command/gripper", ["gripper"], ([gripper], [0.0], [0.0]))


def write_episode(folder: Path, topic_map: TopicMap, number: int, pace: str) -> EpisodeEvent:
    """Write a pick-and-place demonstration of the LIBERO robot.

    Args:
        folder: of the bag.
        topic_map: stored in the bag.
        number: of the episode, see `make_motion`.
        pace: one of STEPS_PER_CHUNK.

    Returns:
        The event at the end of the episode.
    """
    motion = make_motion(number)
    stamps = START_NS + STEP_NS * (np.arange(N_STEPS) + 1)
    event = EpisodeEvent(
        new_episode_id(),
        f"bench-{number:04d}",
        "ended",
        START_NS,
        int(stamps[-1]),
        dict.fromkeys(topic_map.topics, N_STEPS),
    )
    writer = BagWriter(
        folder,
        folder.name,
        custom_data={
            "episode": json.dumps(event_to_json(event)),
            "topic_map": json.dumps(topic_map.to_json()),
            "topics": json.dumps({topic: f"/{topic}" for topic in topic_map.topics}),
        },
    )
    [labels] = [spec.labels for spec in topic_map.with_role("phase")]
    for k, t in enumerate(stamps.tolist()):
        phase = int(motion.phase[k])
        status = phase_to_status(event.id, labels[phase], phase, float(motion.progress[k]))
        for message in messages_at(motion, k, t, status):
            _write(writer, message, t, k + 1)
        if (k + 1) % STEPS_PER_CHUNK[pace] == 0:
            writer.flush()
    writer.close()
    return event
