"""Commands of a policy: how one command field becomes outputs of a network, and back."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.types import Floats

COMMAND_ROLES = ("action", "gripper")


@dataclass(frozen=True)
class ScaledCommand:
    """A command field of numbers: its values are `center + scale * output`.

    Attributes:
        name: field of the topic map.
        unit: of its values.
        scale: (D,) in the unit; demonstrations move slower than they may, and targets that fill
            [-1, 1] are learned far better than small ones. Commands beyond it are clipped, so the
            policy is never faster.
        center: (D,) in the unit.

    Raises:
        PolicyError: if a scale is not positive, or a number is not finite.
    """

    name: str
    unit: str
    scale: tuple[float, ...]
    center: tuple[float, ...]

    def __post_init__(self) -> None:
        if not self.scale or len(self.scale) != len(self.center):
            raise PolicyError(
                f"command {self.name!r}: {len(self.scale)} scales and {len(self.center)} centers, "
                "expected one per value"
            )
        for scale in self.scale:
            if not 0.0 < scale < np.inf:
                raise PolicyError(
                    f"command {self.name!r}: scale is {scale}, expected a finite number above 0"
                )
        if not np.isfinite(self.center).all():
            raise PolicyError(
                f"command {self.name!r}: center is {list(self.center)}, expected finite numbers"
            )

    @property
    def width(self) -> int:
        """Number of values D."""
        return len(self.scale)

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map that has another field under this name; see `ActionSpec.check`."""
        found = command_field(topic_map, self.name, where)
        if (len(found.values), found.unit or "1") != (self.width, self.unit or "1"):
            raise PolicyError(
                f"{where}: command {self.name!r} of the topic map has {len(found.values)} values "
                f"in {found.unit!r}, expected {self.width} in {self.unit!r}"
            )

    def scaled(self, episode: Episode) -> Floats:
        """(T, D) commands of the whole episode as outputs, not clipped."""
        return (episode.field(self.name) - self._centers) / self._scales

    def command(self, output: Floats) -> Floats:
        """(D,) command that an output means."""
        values: Floats = output * self._scales + self._centers
        return values

    @cached_property
    def _scales(self) -> Floats:
        return np.array(self.scale)

    @cached_property
    def _centers(self) -> Floats:
        return np.array(self.center)

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "kind": "scaled",
            "name": self.name,
            "unit": self.unit,
            "scale": list(self.scale),
            "center": list(self.center),
        }


@dataclass(frozen=True)
class GripperCommand:
    """The gripper's command: one output, -1 open to +1 closed, whatever the robot's numbers.

    A policy commands the two ends alone: its output's sign decides.

    Attributes:
        name: field of the topic map.
        kind: `binary` or `continuous`, see `GripperSpec`.
        open_value, closed_value: the command at either end.
    """

    name: str
    kind: str = "binary"
    open_value: float = -1.0
    closed_value: float = 1.0

    def __str__(self) -> str:
        ends = f"{self.open_value:g} open to {self.closed_value:g} closed"
        return f"{self.kind} {self.name!r}, {ends}"

    @property
    def width(self) -> int:
        """One output."""
        return 1

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a gripper whose numbers mean something else; see `ActionSpec.check`."""
        found = gripper_command_of(topic_map)
        if found != self:
            raise PolicyError(f"{where}: the topic map's gripper is {found}, expected {self}")
        spec = command_field(topic_map, self.name, where)
        if len(spec.values) != 1:
            raise PolicyError(
                f"{where}: gripper {self.name!r} of the topic map has {len(spec.values)} values, "
                "expected 1"
            )

    def scaled(self, episode: Episode) -> Floats:
        """(T, 1) command in force: a step that holds has that of the last command before it."""
        return (-commanded(episode)).astype(np.float64)[:, None]

    def command(self, output: Floats) -> Floats:
        """(1,) the end that the sign of the output means; exactly 0 holds."""
        if output[0] == 0.0:
            is_binary = self.kind == "binary"
            hold = 0.0 if is_binary else (self.open_value + self.closed_value) / 2.0
            return np.array([hold])
        return np.array([self.closed_value if output[0] > 0.0 else self.open_value])

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return {
            "kind": "gripper",
            "name": self.name,
            "command": self.kind,
            "open_value": self.open_value,
            "closed_value": self.closed_value,
        }


def gripper_command_of(topic_map: TopicMap) -> GripperCommand | None:
    """The gripper's command by its meaning in a topic map; None where the robot has none."""
    spec = topic_map.gripper
    if spec is None:
        return None
    return GripperCommand(spec.field, spec.kind, spec.open_value, spec.closed_value)


def command_field(topic_map: TopicMap, name: str, where: str) -> FieldSpec:
    """A command field of a topic map.

    Args:
        topic_map: of an episode or of a robot.
        name: of the field.
        where: whose requirement it is, for messages.

    Raises:
        PolicyError: if there is no such field, or it is no command.
    """
    spec = topic_map.fields.get(name)
    if spec is None or spec.role not in COMMAND_ROLES:
        commands = ", ".join(f.name for f in topic_map.with_role(*COMMAND_ROLES)) or "none"
        has = "no field" if spec is None else f"role {spec.role} for"
        raise PolicyError(
            f"{where}: the topic map has {has} {name!r}, expected a command (role action or "
            f"gripper); its commands are {commands}"
        )
    return spec
