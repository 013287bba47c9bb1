"""Plain data to ROS messages and back; the keys live in `curation_ros.core.episode.status`."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped
from sensor_msgs.msg import JointState

from curation_ros.core.episode import messages
from curation_ros.core.episode.status import Status
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.types import NS_PER_S

_Fill = Callable[[Any, Any], None]
_Part = tuple[Callable[[Any], Any] | None, _Fill | None]


def message_type(type_name: str, topic: str = "") -> type:
    """The Python class of a message type.

    Raises:
        ConfigError: if its package is not installed here; bags of it can still be scored.
    """
    package, _, name = type_name.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)  # type: ignore[no-any-return]
    except (ImportError, AttributeError):
        raise ConfigError(
            f"topic {topic!r}: message type {type_name} is not installed: install "
            f"ros-jazzy-{package.replace('_', '-')}, or score bags of it offline"
        ) from None


def to_ros(type_name: str, content: Mapping[str, Any]) -> Any:
    """Make a ROS message of a plain one, see `curation_ros.core.episode.messages`.

    Args:
        type_name: such as `sensor_msgs/msg/JointState`.
        content: every member of the type by its name.
    """
    kind, fill = _type(type_name)
    message = kind()
    fill(message, content)
    return message


@cache
def _type(type_name: str) -> tuple[type, _Fill]:
    """The class of a message type, and what fills a message of it with plain data."""
    kind: Any = message_type(type_name)
    fields = kind.get_fields_and_field_types()
    parts = {name: _part(member) for name, member in fields.items()}
    return kind, partial(_fill, list(parts.items()))


def _fill(parts: list[tuple[str, _Part]], message: Any, content: Mapping[str, Any]) -> None:
    for name, (convert, fill) in parts:
        if fill is not None:
            fill(getattr(message, name), content[name])
        else:
            value = content[name]
            setattr(message, name, value if convert is None else convert(value))


def _part(kind: str) -> _Part:
    """What converts the plain value of a member, or fills a member that is a message.

    It is filled in place, because making another message takes twice the time.
    """
    if kind == "octet":
        # An int would be sent as 0xff, without an error.
        return lambda value: bytes([value]), None
    if "/" not in kind:
        return None, None
    package, name = kind.removeprefix("sequence<").removesuffix(">").split("/")
    full_name = f"{package}/msg/{name}"
    if kind.startswith("sequence<"):
        return lambda values: [to_ros(full_name, value) for value in values], None
    return None, _type(full_name)[1]


def time_to_ros(stamp_ns: int) -> Time:
    """Nanoseconds to a message stamp."""
    return Time(**messages.time(stamp_ns))


def time_from_ros(stamp: Time) -> int:
    """A message stamp to nanoseconds."""
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def status_to_ros(status: Status) -> DiagnosticStatus:
    """One status."""
    return array_to_ros([status], 0).status[0]


def status_from_ros(status: DiagnosticStatus) -> Status:
    """One status; of a repeated key the last value counts."""
    return Status(
        level=status.level[0],
        name=status.name,
        message=status.message,
        hardware_id=status.hardware_id,
        values={v.key: v.value for v in status.values},
    )


def array_to_ros(statuses: Sequence[Status], stamp_ns: int) -> DiagnosticArray:
    """Statuses under one stamp."""
    return to_ros(messages.STATUS_ARRAY, messages.status_array(statuses, stamp_ns))


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
    return to_ros(messages.POSE, messages.pose(position_m, quat_xyzw, stamp_ns))


def twist_to_ros(linear: Iterable[float], stamp_ns: int) -> TwistStamped:
    """A unitless command in [-1, 1] that answers the observation of `stamp_ns`."""
    return to_ros(messages.TWIST, messages.twist(linear, stamp_ns))


def joints_to_ros(
    names: Sequence[str],
    position: Iterable[float],
    velocity: Iterable[float],
    effort: Iterable[float],
    stamp_ns: int,
) -> JointState:
    """Joints; velocity and effort are always filled."""
    return to_ros(
        messages.JOINT_STATE, messages.joint_state(names, position, velocity, effort, stamp_ns)
    )
