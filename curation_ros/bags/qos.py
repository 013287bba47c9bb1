"""Quality of service of a topic, as rosbag2 stores it in metadata version 9: by names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from curation_ros.bags.yaml_text import dump_yaml, load_yaml
from curation_ros.core.types import NS_PER_S

# RMW_DURATION_INFINITE, the largest int64 in nanoseconds.
_INFINITE_NS = 9_223_372_036_854_775_807

# Numbers of rmw/types.h, which bags before version 9 have instead of names.
_NAMES: dict[str, dict[int, str]] = {
    "history": {0: "system_default", 1: "keep_last", 2: "keep_all", 3: "unknown"},
    "reliability": {
        0: "system_default",
        1: "reliable",
        2: "best_effort",
        3: "unknown",
        4: "best_available",
    },
    "durability": {
        0: "system_default",
        1: "transient_local",
        2: "volatile",
        3: "unknown",
        4: "best_available",
    },
    "liveliness": {
        0: "system_default",
        1: "automatic",
        2: "manual_by_node",
        3: "manual_by_topic",
        4: "unknown",
        5: "best_available",
    },
}


@dataclass(frozen=True)
class QosProfile:
    """Offered quality of service of one topic; a duration of None is infinite."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline_ns: int | None = None
    lifespan_ns: int | None = None
    liveliness: str = "automatic"
    liveliness_lease_ns: int | None = None
    avoid_ros_namespace_conventions: bool = False

    def to_rosbag2(self) -> dict[str, Any]:
        """As an element of `offered_qos_profiles`."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _duration(self.deadline_ns),
            "lifespan": _duration(self.lifespan_ns),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": _duration(self.liveliness_lease_ns),
            "avoid_ros_namespace_conventions": self.avoid_ros_namespace_conventions,
        }

    @classmethod
    def from_rosbag2(cls, raw: Mapping[str, Any]) -> QosProfile:
        """Read an element of `offered_qos_profiles`, of any metadata version."""

        def name(key: str) -> str:
            value = raw.get(key, "unknown")
            return _NAMES[key].get(value, "unknown") if isinstance(value, int) else str(value)

        return cls(
            history=name("history"),
            depth=int(raw.get("depth", 0)),
            reliability=name("reliability"),
            durability=name("durability"),
            deadline_ns=_nanoseconds(raw.get("deadline")),
            lifespan_ns=_nanoseconds(raw.get("lifespan")),
            liveliness=name("liveliness"),
            liveliness_lease_ns=_nanoseconds(raw.get("liveliness_lease_duration")),
            avoid_ros_namespace_conventions=bool(raw.get("avoid_ros_namespace_conventions")),
        )


MAPPED = QosProfile(depth=1000)
"""Mapped and command topics.

An episode of up to 1,000 steps fits: a subscriber that stalls for a whole episode loses nothing.
"""


def qos_to_yaml(profiles: tuple[QosProfile, ...]) -> str:
    """Text of the channel metadata `offered_qos_profiles`."""
    return dump_yaml([p.to_rosbag2() for p in profiles])


def qos_from_yaml(text: str) -> tuple[QosProfile, ...]:
    """Read the channel metadata `offered_qos_profiles`; empty if it is no such list."""
    try:
        raw = load_yaml(text)
        return tuple(QosProfile.from_rosbag2(item) for item in raw or ())
    except (TypeError, ValueError, AttributeError):
        return ()


def _duration(ns: int | None) -> dict[str, int]:
    sec, nsec = divmod(_INFINITE_NS if ns is None else ns, NS_PER_S)
    return {"sec": sec, "nsec": nsec}


def _nanoseconds(raw: Any) -> int | None:
    if not isinstance(raw, Mapping):
        return None
    sec, nsec = int(raw.get("sec", 0)), int(raw.get("nsec", 0))
    # Older versions and some vendors write infinity as the largest 32-bit numbers.
    if sec >= _INFINITE_NS // NS_PER_S or {sec, nsec} <= {2147483647, 4294967295}:
        return None
    return sec * NS_PER_S + nsec
