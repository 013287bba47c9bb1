"""Messages of many types with random values, serialised by rosbags: no ROS is needed."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from mcap.writer import CompressionType
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_typestore

from curation_ros.bags import BagWriter, QosProfile

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
TWIST = "geometry_msgs/msg/TwistStamped"
STATUS = "diagnostic_msgs/msg/DiagnosticArray"
START_NS = 1_700_000_000_000_000_000
STEP_NS = 50_000_000


def make(type_name: str, **members: Any) -> Any:
    return STORE.types[type_name](**members)


def to_cdr(message: Any, *, little_endian: bool = True) -> bytes:
    name = message.__msgtype__
    return bytes(STORE.serialize_cdr(message, name, little_endian=little_endian))


def header(stamp_ns: int, frame_id: str = "world") -> Any:
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    stamp = make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame_id)


def joint_state(
    stamp_ns: int, positions: dict[str, float], velocity: Any = None, effort: Any = None
) -> Any:
    n = len(positions)
    return make(
        JOINTS,
        header=header(stamp_ns),
        name=list(positions),
        position=np.array(list(positions.values()), dtype=np.float64),
        velocity=np.zeros(n) if velocity is None else np.asarray(velocity, dtype=np.float64),
        effort=np.zeros(n) if effort is None else np.asarray(effort, dtype=np.float64),
    )


def pose(stamp_ns: int, xyz: Any, quat_xyzw: Any = (0.0, 0.0, 0.0, 1.0)) -> Any:
    x, y, z, w = quat_xyzw
    return make(
        POSE,
        header=header(stamp_ns),
        pose=make(
            "geometry_msgs/msg/Pose",
            position=make("geometry_msgs/msg/Point", **dict(zip("xyz", xyz, strict=True))),
            orientation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def twist(stamp_ns: int, linear: Any) -> Any:
    vector = "geometry_msgs/msg/Vector3"
    return make(
        TWIST,
        header=header(stamp_ns),
        twist=make(
            "geometry_msgs/msg/Twist",
            linear=make(vector, **dict(zip("xyz", linear, strict=True))),
            angular=make(vector, x=0.0, y=0.0, z=0.0),
        ),
    )


def status(stamp_ns: int, message: str, values: dict[str, str]) -> Any:
    pairs = [make("diagnostic_msgs/msg/KeyValue", key=k, value=v) for k, v in values.items()]
    one = make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=0,
        name="phase",
        message=message,
        hardware_id="id",
        values=pairs,
    )
    return make(STATUS, header=header(stamp_ns), status=[one])


def random_message(type_name: str, rng: np.random.Generator, depth: int = 0) -> Any:
    """A message of any type with random values; lists have 0 to 3 elements."""
    _, fields = STORE.fielddefs[type_name]
    members = {name: _random_member(kind, rng, depth) for name, kind in fields}
    return make(type_name, **members)


def _random_member(kind: Any, rng: np.random.Generator, depth: int) -> Any:
    node, detail = kind
    if node == Nodetype.BASE:
        return _random_scalar(detail, rng)
    if node == Nodetype.NAME:
        return random_message(detail, rng, depth + 1)
    inner, size = detail
    n = size if node == Nodetype.ARRAY else int(rng.integers(0, 3 if size == 0 else size + 1))
    if inner[0] == Nodetype.BASE and inner[1][0] != "string":
        dtype = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(inner[1][0], inner[1][0])
        values = [_random_scalar(inner[1], rng) for _ in range(n)]
        return np.array(values, dtype=dtype)
    return [_random_member(inner, rng, depth) for _ in range(n)]


def _random_scalar(detail: Any, rng: np.random.Generator) -> Any:
    name, bound = detail
    if name == "string":
        n = int(rng.integers(0, min(bound or 9, 9) + 1))
        return "".join(rng.choice(list("abcdefgh/._é€"), n))[: bound or 9]
    if name == "bool":
        return bool(rng.integers(2))
    if name in ("byte", "octet"):
        return int(rng.integers(128))  # rosbags takes it as signed, ROS 2 as unsigned
    if name.startswith("float"):
        return float(np.dtype(name).type(rng.normal()))
    info = np.iinfo("uint8" if name == "char" else name)
    return int(rng.integers(info.min, info.max, dtype=info.dtype.type, endpoint=True))


def to_plain(value: Any) -> Any:
    """A message of rosbags as `CdrDecoder.read_message` gives it, with lists for arrays."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [to_plain(v) for v in value]
    if isinstance(value, dict):
        return {k: to_plain(v) for k, v in value.items()}
    if hasattr(value, "__msgtype__"):
        names = [name for name, _ in STORE.fielddefs[value.__msgtype__][1]]
        if names == ["structure_needs_at_least_one_member"]:
            return {}
        return {name: to_plain(getattr(value, name)) for name in names}
    return value


#: Compressions of chunks that other writers use.
COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


def make_writer(
    folder: Path, name: str, *, compression: str = "zstd", custom_data: Any = None
) -> BagWriter:
    """A writer whose chunks are compressed as asked for."""
    with patch("curation_ros.bags.writer.COMPRESSION", COMPRESSIONS[compression]):
        return BagWriter(folder, name, custom_data=custom_data)


def write_bag(
    folder: Path,
    messages: list[tuple[str, int, Any]],
    *,
    custom_data: dict[str, str] | None = None,
    flush_every: int = 20,
    compression: str = "zstd",
) -> BagWriter:
    """Write (topic, stamp_ns, message) as the recorder does, and close the bag."""
    writer = make_writer(folder, folder.name, custom_data=custom_data, compression=compression)
    numbers: dict[str, itertools.count[int]] = {}
    for k, (topic, stamp_ns, message) in enumerate(messages):
        writer.add_topic(topic, message.__msgtype__, [QosProfile(depth=1000)])
        number = next(numbers.setdefault(topic, itertools.count(1)))
        writer.write(topic, stamp_ns + 1000, stamp_ns, number, to_cdr(message))
        if k % flush_every == flush_every - 1:
            writer.flush()
    writer.close({})
    return writer


def episode_messages(n: int = 40) -> list[tuple[str, int, Any]]:
    """A small episode of every topic, with a phase and growing values."""
    out: list[tuple[str, int, Any]] = []
    for k in range(n):
        t = START_NS + k * STEP_NS
        joints = {f"robot0_joint{j}": 0.1 * j + 0.01 * k for j in range(1, 8)}
        fingers = {"gripper0_finger_joint1": 0.02, "gripper0_finger_joint2": -0.02}
        phase = "PREGRASP" if k < n // 2 else "GRASP"
        out += [
            ("/joint_states", t, joint_state(t, joints | fingers)),
            ("/eef_pose", t, pose(t, (0.1 * k, 0.2, 0.3))),
            ("/phase", t, status(t, phase, {"index": "1", "progress": repr(k / n)})),
            ("/command/twist", t, twist(t, (0.01 * k, -0.5, 0.25))),
            ("/command/gripper", t, joint_state(t, {"gripper": -1.0})),
        ]
    return out
