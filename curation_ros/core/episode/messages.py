"""ROS messages as plain data: their members as dicts, lists, numbers and texts.

A message is put together here once, for DDS (`curation_ros.nodes.messages.to_ros`) and for bags
(`curation_ros.bags.messages.to_cdr`). It has the form that `CdrDecoder.read_message` returns.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from curation_ros.core.episode.status import Status
from curation_ros.core.types import NS_PER_S

CLOCK = "rosgraph_msgs/msg/Clock"
JOINT_STATE = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
STATUS_ARRAY = "diagnostic_msgs/msg/DiagnosticArray"
TWIST = "geometry_msgs/msg/TwistStamped"

WORLD_FRAME = "world"
"""Frame of every pose and twist."""

Content = Mapping[str, Any]


class PlainMessage(NamedTuple):
    """A message and where it goes.

    Attributes:
        topic: relative name, or an absolute one such as `/clock`.
        type: such as `sensor_msgs/msg/JointState`.
        content: every member of the type by its name.
    """

    topic: str
    type: str
    content: Content


def time(stamp_ns: int) -> Content:
    """A builtin_interfaces/Time."""
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    return {"sec": sec, "nanosec": nanosec}


def clock(stamp_ns: int) -> Content:
    """A rosgraph_msgs/Clock."""
    return {"clock": time(stamp_ns)}


def joint_state(
    names: Sequence[str],
    position: Iterable[float],
    velocity: Iterable[float],
    effort: Iterable[float],
    stamp_ns: int,
) -> Content:
    """A sensor_msgs/JointState.

    Velocity and effort are always filled, because some readers fail on an empty list at the end.

    Args:
        names: (n,) joints.
        position: (n,) in rad or m.
        velocity: (n,) in rad/s or m/s.
        effort: (n,) in Nm or N.
        stamp_ns: stamp of the header.
    """
    return {
        "header": _header(stamp_ns, ""),
        "name": list(names),
        "position": [float(v) for v in position],
        "velocity": [float(v) for v in velocity],
        "effort": [float(v) for v in effort],
    }


def pose(position_m: Iterable[float], quat_xyzw: Iterable[float], stamp_ns: int) -> Content:
    """A geometry_msgs/PoseStamped in the world frame.

    Args:
        position_m: (3,).
        quat_xyzw: (4,).
        stamp_ns: stamp of the header.
    """
    x, y, z, w = quat_xyzw
    orientation = {"x": float(x), "y": float(y), "z": float(z), "w": float(w)}
    return {
        "header": _header(stamp_ns, WORLD_FRAME),
        "pose": {"position": _vector(position_m), "orientation": orientation},
    }


def twist(linear: Iterable[float], stamp_ns: int) -> Content:
    """A geometry_msgs/TwistStamped in the world frame.

    Args:
        linear: (3,) command, unitless in [-1, 1].
        stamp_ns: stamp of the observation that the command answers.
    """
    return {
        "header": _header(stamp_ns, WORLD_FRAME),
        "twist": {"linear": _vector(linear), "angular": _vector((0.0, 0.0, 0.0))},
    }


def status_array(statuses: Iterable[Status], stamp_ns: int) -> Content:
    """A diagnostic_msgs/DiagnosticArray: statuses under one stamp."""
    return {
        "header": _header(stamp_ns, ""),
        "status": [
            {
                "level": status.level,
                "name": status.name,
                "message": status.message,
                "hardware_id": status.hardware_id,
                "values": [{"key": k, "value": v} for k, v in status.values.items()],
            }
            for status in statuses
        ],
    }


def _header(stamp_ns: int, frame_id: str) -> Content:
    return {"stamp": time(stamp_ns), "frame_id": frame_id}


def _vector(xyz: Iterable[float]) -> Content:
    x, y, z = xyz
    return {"x": float(x), "y": float(y), "z": float(z)}
