"""Terms of an observation: fields, their first values, and differences of these."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from curation_ros.core.episode.topic_map import AT_START, TopicMap
from curation_ros.core.errors import PolicyError

#: How many of a unit are 1 m.
LENGTHS = {"m": 1.0, "cm": 100.0, "mm": 1000.0}
_PER_SI = {**LENGTHS, "rad": 1.0, "deg": math.degrees(1.0)}
_MINUS = " - "
_COMMAND_ROLES = ("action", "gripper")


@dataclass(frozen=True)
class ObservedField:
    """A field of the topic map as a policy was trained on it.

    Attributes:
        name: of the field.
        width: number of values D.
        unit: of the values.
        labels: names of the phases where the field is a phase, else empty. A phase is one value,
            the index of its name, and becomes a one-hot.
    """

    name: str
    width: int
    unit: str = ""
    labels: tuple[str, ...] = ()

    @property
    def per_si(self) -> float:
        """How many of its unit are 1 m or 1 rad; 1 for any other unit."""
        return _PER_SI.get(self.unit, 1.0)

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map in which the field is missing or means something else.

        Raises:
            PolicyError: naming what was found and what was expected.
        """
        found = observed_field(topic_map, self.name, where)
        if found.labels != self.labels:
            raise PolicyError(
                f"{where}: the topic map's phases are {', '.join(found.labels) or 'none'}, "
                f"expected {', '.join(self.labels) or 'none'}"
            )
        if found.width != self.width:
            raise PolicyError(
                f"{where}: field {self.name!r} of the topic map has {found.width} values, "
                f"expected {self.width}"
            )
        if not self.labels and not _is_same_unit(found.unit, self.unit):
            raise PolicyError(
                f"{where}: field {self.name!r} of the topic map is in {found.unit!r}, "
                f"expected {self.unit!r}"
            )


@dataclass(frozen=True)
class Operand:
    """A field in a term: its value in each step, or its first value of the episode."""

    name: str
    is_at_start: bool


@dataclass(frozen=True)
class Term:
    """A part of an observation.

    Attributes:
        text: as written.
        operands: the first one minus the others.
        field: of the first operand.
    """

    text: str
    operands: tuple[Operand, ...]
    field: ObservedField

    @property
    def is_one_hot(self) -> bool:
        """Whether it is a phase."""
        return bool(self.field.labels)

    @property
    def columns(self) -> tuple[str, ...]:
        """Name of every column, such as `eef_position[0]` or `phase=LIFT`."""
        if self.is_one_hot:
            return tuple(f"{self.text}={label}" for label in self.field.labels)
        shown = f"({self.text})" if len(self.operands) > 1 else self.text
        return tuple(f"{shown}[{k}]" for k in range(self.field.width))


def parse_operands(text: str) -> tuple[Operand, ...]:
    """Fields of a term such as `cup_pose@start - tool_pose`."""
    names = (name.strip() for name in text.split(_MINUS))
    return tuple(Operand(name.removesuffix(AT_START), name.endswith(AT_START)) for name in names)


def make_term(text: str, fields: Mapping[str, ObservedField]) -> Term:
    """A term over fields.

    Args:
        text: of the term.
        fields: by name, at least those of the term.

    Raises:
        PolicyError: if a field has no values, a phase does not stand alone, or a difference has
            operands of different widths or units.
    """
    operands = parse_operands(text)
    first = fields[operands[0].name]
    if first.width < 1:
        raise PolicyError(f"observation {text!r}: field {first.name!r} has no values")
    has_phase = any(fields[operand.name].labels for operand in operands)
    if has_phase and (len(operands) > 1 or operands[0].is_at_start or first.width != 1):
        raise PolicyError(
            f"observation {text!r}: a phase has one value and stands alone, without "
            f"{AT_START} and differences"
        )
    for operand in operands[1:]:
        other = fields[operand.name]
        if other.width != first.width or not _is_same_unit(other.unit, first.unit):
            raise PolicyError(
                f"observation {text!r}: {first.name!r} has {first.width} values in "
                f"{first.unit!r}, {other.name!r} has {other.width} in {other.unit!r}; a "
                "difference needs equal units and widths"
            )
    return Term(text, operands, first)


def observed_field(topic_map: TopicMap, name: str, where: str) -> ObservedField:
    """A field of a topic map as a policy observes it.

    Args:
        topic_map: of an episode or of a robot.
        name: of the field.
        where: whose requirement it is, for messages.

    Raises:
        PolicyError: if there is no such field, or it is a command.
    """
    spec = topic_map.fields.get(name)
    if spec is None:
        raise PolicyError(
            f"{where}: the topic map has no field {name!r}; it has "
            f"{', '.join(topic_map.fields) or 'none'}"
        )
    if spec.role in _COMMAND_ROLES:
        raise PolicyError(
            f"{where}: field {name!r} has role {spec.role}: a policy gives commands and cannot "
            "observe them"
        )
    return ObservedField(name, len(spec.values), spec.unit, spec.labels)


def _is_same_unit(a: str, b: str) -> bool:
    """Topic maps write no unit as an empty text or as 1."""
    return (a or "1") == (b or "1")
