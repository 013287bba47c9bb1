"""Plain data to ROS messages and back; the keys live in `curation_ros.core.episode.status`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped, TwistStamped
from sensor_msgs.msg import JointState

from curation_ros.core.episode.status import Status
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S

_FRAME = "world"


def time_to_ros(stamp_ns: int) -> Time:
    """Nanoseconds to a message stamp."""
    return Time(sec=stamp_ns // NS_PER_S, nanosec=stamp_ns % NS_PER_S)


def time_from_ros(stamp: Time) -> int:
    """A message stamp to nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def status_to_ros(status: Status) -> DiagnosticStatus:
    """One status; `level` is a byte in ROS, and an int would go out as 0xff without a word."""
    return DiagnosticStatus(
        level=bytes([status.level]),
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values=[KeyValue(key=k, value=v) for k, v in status.values.items()],
    )


def status_from_ros(status: DiagnosticStatus) -> Status:
    """One status; a key that stands twice keeps its last value."""
    return Status(
        level=status.level[0],
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values={v.key: v.value for v in status.values},
    )


def array_to_ros(statuses: Sequence[Status], stamp_ns: int) -> DiagnosticArray:
    """Statuses under one stamp."""
    message = DiagnosticArray(status=[status_to_ros(s) for s in statuses])
    message.header.stamp = time_to_ros(stamp_ns)
    return message


def single_from_ros(message: DiagnosticArray) -> Status:
    """The one status of an array.

    Raises:
        EpisodeError: if there is not exactly one.
    """
    if len(message.status) != 1:
        raise EpisodeError(f"expected one status in the message, found {len(message.status)}")
    return status_from_ros(message.status[0])


def pose_to_ros(
    position_m: Iterable[float], quat_xyzw: Iterable[float], stamp_ns: int
) -> PoseStamped:
    """A pose in the world frame."""
    message = PoseStamped()
    message.header.stamp = time_to_ros(stamp_ns)
    message.header.frame_id = _FRAME
    p, q = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = (float(v) for v in position_m)
    q.x, q.y, q.z, q.w = (float(v) for v in quat_xyzw)
    return message


def twist_to_ros(xyz: Iterable[float], stamp_ns: int) -> TwistStamped:
    """A unitless command in [-1, 1] that answers the observation of `stamp_ns`."""
    message = TwistStamped()
    message.header.stamp = time_to_ros(stamp_ns)
    message.header.frame_id = _FRAME
    linear = message.twist.linear
    linear.x, linear.y, linear.z = (float(v) for v in xyz)
    return message


def joints_to_ros(
    names: Sequence[str],
    position: Iterable[float],
    velocity: Iterable[float],
    effort: Iterable[float],
    stamp_ns: int,
) -> JointState:
    """Joints; velocity and effort are always filled: some readers fail on an empty tail."""
    message = JointState(name=list(names))
    message.header.stamp = time_to_ros(stamp_ns)
    message.position = [float(v) for v in position]
    message.velocity = [float(v) for v in velocity]
    message.effort = [float(v) for v in effort]
    return message
