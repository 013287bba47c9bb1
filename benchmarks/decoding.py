"""From bags to arrays and to seven scores: ours beside rosbags and the two mcap-ros2-support.

All readers take turns in one process on one core, and ratios are taken within a round. Each
reader is used as its documentation does, gives the same arrays (checked), and need not open
metadata.yaml.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mcap_ros2.decoder
import mcap_ros2_support_fast.decoder
import numpy as np
import numpy.typing as npt
from mcap.reader import make_reader
from one_core import rows_of
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from curation_ros.bags import BagWriter, open_bag
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.decision.fitted_scorers import fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent, event_to_json
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.episodes import read_episode

COMMAND = "python benchmarks/decoding.py"
N_ROUNDS = 9
N_MESSAGES = 5000
N_STEPS = 350
N_EPISODES = 24
N_REFERENCES = 10
STEP_NS = 50_000_000
START_NS = 1_781_000_000_000_000_000
#: The recorder flushes every 0.1 s, which ends a chunk: in lockstep the simulator makes some 25
#: steps in it, a robot at 20 Hz makes 2.
STEPS_A_CHUNK = {"lockstep": 25, "20 Hz": 2}
TARGETS = {"rosbags": 10.0, "mcap-ros2-support": 10.0, "mcap-ros2-support-fast": 4.0}
SCORES_TARGET = 5.0
PAPER = (
    "smoothness",
    "entropy",
    "gripper_timing",
    "isolation_forest",
    "ensemble",
    "knn",
    "trajectory_alignment",
)
JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
ARM = [f"robot0_joint{k}" for k in range(1, 8)] + [f"gripper0_finger_joint{k}" for k in (1, 2)]
PHASES = ("PREGRASP", "DESCEND", "GRASP", "LIFT", "TRANSPORT", "RELEASE")

Arrays = dict[str, npt.NDArray[Any]]
#: A file and the topics that are wanted -> (topic, message).
MessageReader = Callable[[Path, list[str]], Iterator[tuple[str, Any]]]

_STORE = get_typestore(Stores.ROS2_JAZZY)


# --- bags as our recorder writes them -----------------------------------------------------------


def _make(type_name: str, **members: Any) -> Any:
    return _STORE.types[type_name](**members)


def _header(stamp_ns: int) -> Any:
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    stamp = _make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return _make("std_msgs/msg/Header", stamp=stamp, frame_id="world")


def _joints(stamp_ns: int, names: list[str], values: npt.NDArray[np.float64]) -> Any:
    """`values` are position, velocity and effort."""
    position, velocity, effort = np.ascontiguousarray(values)
    return _make(
        JOINTS,
        header=_header(stamp_ns),
        name=names,
        position=position,
        velocity=velocity,
        effort=effort,
    )


def _pose(stamp_ns: int, row: Iterable[float]) -> Any:
    x, y, z, qx, qy, qz, qw = map(float, row)
    position = _make("geometry_msgs/msg/Point", x=x, y=y, z=z)
    orientation = _make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw)
    pose = _make("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    return _make(POSE, header=_header(stamp_ns), pose=pose)


def _phase(stamp_ns: int, index: int, progress: float, episode_id: str) -> Any:
    pairs = {"index": str(index), "progress": repr(progress)}
    status = _make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=0,
        name="phase",
        message=PHASES[index],
        hardware_id=episode_id,
        values=[_make("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in pairs.items()],
    )
    return _make("diagnostic_msgs/msg/DiagnosticArray", header=_header(stamp_ns), status=[status])


def _twist(stamp_ns: int, linear: Iterable[float]) -> Any:
    vector = "geometry_msgs/msg/Vector3"
    x, y, z = map(float, linear)
    twist = _make(
        "geometry_msgs/msg/Twist",
        linear=_make(vector, x=x, y=y, z=z),
        angular=_make(vector, x=0.0, y=0.0, z=0.0),
    )
    return _make("geometry_msgs/msg/TwistStamped", header=_header(stamp_ns), twist=twist)


def _write(writer: BagWriter, topic: str, stamp_ns: int, number: int, message: Any) -> None:
    writer.add_topic(f"/{topic}", message.__msgtype__)
    data = bytes(_STORE.serialize_cdr(message, message.__msgtype__))
    writer.write(f"/{topic}", stamp_ns + 2_000_000, stamp_ns, number, data)


def write_topic(folder: Path, type_name: str) -> Path:
    """A bag of many messages of one topic; returns its file."""
    rng = np.random.default_rng(1)
    writer = BagWriter(folder, folder.name)
    for k in range(N_MESSAGES):
        stamp_ns = START_NS + k * STEP_NS
        if type_name == JOINTS:
            message = _joints(stamp_ns, ARM, rng.standard_normal((3, len(ARM))))
        else:
            message = _pose(stamp_ns, rng.standard_normal(7))
        _write(writer, "topic", stamp_ns, k + 1, message)
        if (k + 1) % STEPS_A_CHUNK["lockstep"] == 0:
            writer.flush()
    writer.close()
    return writer.path


def write_episode(folder: Path, topic_map: TopicMap, number: int, pace: str) -> EpisodeEvent:
    """A pick and place of the LIBERO robot; motion, pace and goal vary with the number."""
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
    quat = [1.0, 0.0, 0.0, 0.0]
    for k, t in enumerate(stamps.tolist()):
        progress = (k - edges[phase[k]]) / N_STEPS
        command = np.array([[1.0 if is_closed[k] else -1.0], [0.0], [0.0]])
        messages = {
            "eef_pose": _pose(t, [*eef[k], *quat]),
            "joint_states": _joints(t, ARM, joints[k]),
            "objects/akita_black_bowl_1/pose": _pose(t, [*bowl[k], *quat]),
            "objects/plate_1/pose": _pose(t, [0.05, 0.2, 0.9, *quat]),
            "phase": _phase(t, int(phase[k]), float(progress), event.id),
            "command/twist": _twist(t, twist[k]),
            "command/gripper": _joints(t, ["gripper"], command),
        }
        for topic, message in messages.items():
            _write(writer, topic, t, k + 1, message)
        if (k + 1) % STEPS_A_CHUNK[pace] == 0:
            writer.flush()
    writer.close()
    return event


# --- the other readers --------------------------------------------------------------------------


def read_rosbags(path: Path, topics: list[str]) -> Iterator[tuple[str, Any]]:
    """Messages by rosbags."""
    with AnyReader([path.parent]) as reader:
        connections = [c for c in reader.connections if c.topic in topics]
        for connection, _, raw in reader.messages(connections):
            yield connection.topic, reader.deserialize(raw, connection.msgtype)


def read_mcap(factory: Any) -> MessageReader:
    """Messages by the reader of the mcap package and a decoder factory.

    One factory serves many files, although it keeps decoders by schema id: where it is used,
    equal ids mean equal schemas, and a decoder made anew for each file would take most time.
    """

    def read(path: Path, topics: list[str]) -> Iterator[tuple[str, Any]]:
        with path.open("rb") as file:
            reader = make_reader(file, decoder_factories=[factory])
            for _, channel, _, message in reader.iter_decoded_messages(
                topics, log_time_order=False
            ):
                yield channel.topic, message

    return read


#: Reader -> makes it, for files whose schemas have the same ids.
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
    values = [np.array([getattr(m, x) for m in messages]) for x in _LISTS]
    return {"stamps": _stamps(messages), "values": np.concatenate(values, axis=1)}


_LISTS = ("position", "velocity", "effort")
_POSE_PATHS = [*(f"pose.position.{x}" for x in "xyz"), *(f"pose.orientation.{x}" for x in "xyzw")]
#: Ours looks every joint up by its name, the others trust the order of the first message.
_PATHS = {JOINTS: [f"{x}.{name}" for x in _LISTS for name in ARM], POSE: _POSE_PATHS}


def arrays_by_us(path: Path, type_name: str) -> Arrays:
    """A topic as arrays, by curation_ros."""
    paths = _PATHS[type_name]
    field = {"topic": "topic", "type": type_name, "role": "clock", "values": paths}
    bag = open_bag(path)
    decoder = bag.decoder()
    blocks = list(bag.blocks(topic_map_from_json({"fields": {"values": field}})))
    columns = [decoder.decode_block(type_name, paths, block.messages) for block in blocks]
    if any(found.bad for found in columns):
        raise SystemExit("the benchmark has written a bag that cannot be read")
    return {
        "stamps": np.concatenate([block.stamps_ns for block in blocks]),
        "values": np.concatenate([found.values for found in columns]),
    }


def episode_by(
    reader: MessageReader, path: Path, topic_map: TopicMap, event: EpisodeEvent
) -> Episode:
    """An episode by another reader: what is known of it beside its messages is given."""
    found: dict[str, list[Any]] = {f"/{topic}": [] for topic in topic_map.topics}
    for topic, message in reader(path, list(found)):
        found[topic].append(message)
    eef, joints = _poses(found["/eef_pose"]), found["/joint_states"]
    order = [joints[0].name.index(name) for name in ARM]
    position = np.array([m.position for m in joints])[:, order]
    index = {label: float(k) for k, label in enumerate(PHASES)}
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


# --- measuring ----------------------------------------------------------------------------------


@dataclass
class Turns:
    """Seconds of each contestant, round by round."""

    seconds: dict[str, list[float]]

    def ratio(self, name: str, other: str) -> float:
        """How many times faster the first is; the median of the rounds."""
        pairs = zip(self.seconds[other], self.seconds[name], strict=True)
        return statistics.median(slow / fast for slow, fast in pairs)

    def median(self, name: str) -> float:
        """Seconds a turn."""
        return statistics.median(self.seconds[name])


def take_turns(contestants: Mapping[str, Callable[[], object]], n_rounds: int) -> Turns:
    """Run each in turn, once more than asked for: the first round warms up."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for round_index in range(n_rounds + 1):
        for name, run_once in contestants.items():
            started_s = time.perf_counter()
            run_once()
            if round_index:
                seconds[name].append(time.perf_counter() - started_s)
    return Turns(seconds)


def _row(name: str, value: float, unit: str, **extra: Any) -> dict[str, Any]:
    empty = {"against": "", "ratio": None, "target": None, "holds": None}
    return {"name": name, "value": value, "unit": unit, **empty, **extra, "command": COMMAND}


def _against(name: str, ratio: float, target: float) -> dict[str, Any]:
    return {
        "against": name,
        "ratio": ratio,
        "target": f"ratio >= {target:g}",
        "holds": ratio >= target,
    }


def measure_decoding(folder: Path, type_name: str, n_rounds: int) -> tuple[Turns, list[Any]]:
    """Messages a second of each reader, and how much faster ours is."""
    short = type_name.split("/")[2]
    path = write_topic(folder / short, type_name)
    contestants: dict[str, Callable[[], Arrays]] = {
        name: functools.partial(arrays_by, make(), path, type_name)
        for name, make in READERS.items()
    }
    contestants["ours"] = functools.partial(arrays_by_us, path, type_name)
    truth = contestants["ours"]()
    for name, read in contestants.items():
        for key, values in read().items():
            if not np.array_equal(values, truth[key]):
                raise SystemExit(f"{name} reads other {key} of {short} than we do")
    turns = take_turns(contestants, n_rounds)
    rows = [
        _row(f"decode {short}, {name}", N_MESSAGES / turns.median(name), "messages/s")
        for name in READERS
    ]
    rows += [
        _row(
            f"decode {short}, ours against {name}",
            N_MESSAGES / turns.median("ours"),
            "messages/s",
            **_against(f"decode {short}, {name}", turns.ratio("ours", name), target),
        )
        for name, target in TARGETS.items()
    ]
    return turns, rows


def measure_scores(folder: Path, fastest: str, pace: str, n_rounds: int) -> list[dict[str, Any]]:
    """Milliseconds from a bag to the seven scores of the paper, with ours and the fastest."""
    topic_map = topic_map_or_default("")
    events = {}
    for number in range(N_REFERENCES + N_EPISODES):
        bag = folder / f"{number:03d}-{pace}".replace(" ", "")
        events[bag / f"{bag.name}_0.mcap"] = write_episode(bag, topic_map, number, pace)
    paths = list(events)
    settings = CurationSettings(scorers=PAPER, rule="none", rule_scorer=PAPER[0])
    fitted = fit_scorers(settings, [read_episode(path.parent) for path in paths[:N_REFERENCES]])
    judged = paths[N_REFERENCES:]
    reader = READERS[fastest]()

    def by_us(path: Path) -> Episode:
        return read_episode(path.parent)

    def by_other(path: Path) -> Episode:
        return episode_by(reader, path, topic_map, events[path])

    for path in judged:
        ours, other = by_us(path), by_other(path)
        scores, abstained = fitted.score(ours)
        if ours.digest != other.digest or fitted.score(other)[0] != scores or abstained:
            raise SystemExit(f"{path}: {fastest} and we differ, or a scorer abstains: {abstained}")
    episodes = [by_us(path) for path in judged]
    turns = take_turns(
        {
            "ours": lambda: [fitted.score(by_us(path)) for path in judged],
            "other": lambda: [fitted.score(by_other(path)) for path in judged],
            "reading, ours": lambda: [by_us(path) for path in judged],
            "reading, other": lambda: [by_other(path) for path in judged],
            # A copy: an episode remembers its state and action once they were asked for.
            "scores alone": lambda: [fitted.score(replace(episode)) for episode in episodes],
        },
        n_rounds,
    )

    def ms(name: str) -> float:
        return 1e3 * turns.median(name) / N_EPISODES

    shape = f"{N_STEPS} steps, {pace}"
    return [
        _row(f"bag to seven scores, {shape}, {fastest}", ms("other"), "ms/episode"),
        _row(
            f"bag to seven scores, {shape}, ours",
            ms("ours"),
            "ms/episode",
            **_against(
                f"bag to seven scores, {shape}, {fastest}",
                turns.ratio("ours", "other"),
                SCORES_TARGET,
            ),
        ),
        _row(f"bag to episode, {shape}, {fastest}", ms("reading, other"), "ms/episode"),
        _row(
            f"bag to episode, {shape}, ours",
            ms("reading, ours"),
            "ms/episode",
            against=f"bag to episode, {shape}, {fastest}",
            ratio=turns.ratio("reading, ours", "reading, other"),
        ),
        _row(f"seven scores alone, {shape}", ms("scores alone"), "ms/episode"),
    ]


def measure(n_rounds: int = N_ROUNDS) -> list[dict[str, Any]]:
    """All rows, measured in this process."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        joints, rows = measure_decoding(folder, JOINTS, n_rounds)
        poses, more = measure_decoding(folder, POSE, n_rounds)
        fastest = min(READERS, key=lambda name: joints.median(name) + poses.median(name))
        for pace in STEPS_A_CHUNK:
            more += measure_scores(folder, fastest, pace, n_rounds)
        return [*rows, *more]


def run() -> list[dict[str, Any]]:
    """Measure in a process of its own, with one thread on one core, and return its rows."""
    return rows_of(__file__)


if __name__ == "__main__":
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for result in measure():
        print(json.dumps(result))
