"""Parameters of a node as one table, which declares, checks and documents them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from curation_ros.core.errors import ConfigError


@dataclass(frozen=True)
class Parameter:
    """One parameter. All parameters are read once, when the node starts.

    Attributes:
        name: its name.
        default: default value. Its type is the type of the parameter; `()` is an empty list of
            strings.
        description: meaning and unit, in one line.
        low, high: range of a number, inclusive.
        choices: allowed texts; empty: any.
        is_required: whether an empty text is refused.
    """

    name: str
    default: Any
    description: str
    low: float | None = None
    high: float | None = None
    choices: Sequence[str] = ()
    is_required: bool = False


def declare(node: Node, table: Sequence[Parameter]) -> dict[str, Any]:
    """Declare the parameters of a node and read their values.

    Returns:
        Name -> value.

    Raises:
        ConfigError: if a value has the wrong type, is out of range, or is not allowed.
    """
    values = {}
    for p in table:
        descriptor = ParameterDescriptor(description=p.description, read_only=True)
        if p.low is not None and p.high is not None:
            if isinstance(p.default, float):
                span = FloatingPointRange(from_value=float(p.low), to_value=float(p.high))
                descriptor.floating_point_range = [span]
            else:
                span = IntegerRange(from_value=int(p.low), to_value=int(p.high))
                descriptor.integer_range = [span]
        if p.choices:
            descriptor.additional_constraints = "one of: " + ", ".join(p.choices)
        # An empty list has no type, so it is declared by type, without a default.
        default = RosParameter.Type.STRING_ARRAY if p.default == () else p.default
        where = f"{node.get_name()}: parameter {p.name!r}"
        try:
            value = node.declare_parameter(p.name, default, descriptor).value
        except (
            InvalidParameterTypeException,
            InvalidParameterValueException,
            ParameterException,
        ) as err:
            allowed = f" in [{p.low}, {p.high}]" if p.low is not None else ""
            kind = type(p.default).__name__ if p.default != () else "list of strings"
            if isinstance(err, InvalidParameterTypeException):
                if p.default == ():
                    kind += f' ({p.name}:="[one, two]")'
                elif isinstance(p.default, float):
                    kind += " (1.0, not 1)"
            raise ConfigError(f"{where}: expected {kind}{allowed}: {err}") from err
        value = p.default if value is None else value
        if p.choices and value not in p.choices:
            raise ConfigError(f"{where}: {value!r} is none of {', '.join(p.choices)}")
        if p.is_required and not value:
            raise ConfigError(f"{where} is empty: expected the {p.description}")
        # In a launch file, `[$(var reference)]` of an empty reference is a list of one empty text.
        values[p.name] = [text for text in value if text] if p.default == () else value
    return values


def warn_of_unknown(node: Node, table: Sequence[Parameter]) -> None:
    """Log each given parameter that the node does not have.

    It is no error: a file may give parameters to many nodes at once (`/**`).
    """
    for name in sorted(set(node._parameter_overrides) - set(node._parameters)):
        near = get_close_matches(name, [p.name for p in table], 1)
        instead = f"; is {near[0]!r} meant?" if near else ""
        node.get_logger().warning(f"there is no parameter {name!r}: it changes nothing{instead}")


def described(table: Sequence[Parameter]) -> str:
    """The text of --help: one line per parameter."""
    defaults = ["[]" if p.default == () else json.dumps(p.default) for p in table]
    names, width = max(len(p.name) for p in table), max(map(len, defaults))
    lines = [
        f"  {p.name:{names}}  {default:{width}}  {p.description}"
        + (f" ({', '.join(p.choices)})" if p.choices else "")
        + (f" [{p.low:g} to {p.high:g}]" if p.low is not None else "")
        for p, default in zip(table, defaults, strict=True)
    ]
    return "\n".join(["parameters: --ros-args -p NAME:=VALUE -p ...", *lines])
