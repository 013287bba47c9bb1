"""Paths of a topic map into a message, checked against its definition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias

from curation_ros.bags.definitions import PRIMITIVES, TEXTS, Definitions, Field
from curation_ros.core.errors import ConfigError

#: Members that may name the elements of a list of numbers beside them.
_NAME_LISTS = ("name", "joint_names")


class Named(NamedTuple):
    """Step to the element that a parallel list of names calls `wanted`."""

    names: str
    wanted: str


class Keyed(NamedTuple):
    """Step to the `value` of the element whose `key` is `wanted`."""

    wanted: str


Step: TypeAlias = str | int | Named | Keyed


class ValuePath(NamedTuple):
    """A path as written, the steps that it means, and whether a text stands at its end."""

    text: str
    steps: tuple[Step, ...]
    is_text: bool


def resolve_path(type_name: str, definitions: Definitions, path: str) -> ValuePath:
    """Check a path against a type.

    Raises:
        ConfigError: if the type has no such value, naming what it has.
    """
    tokens = path.split(".")
    steps: list[Step] = []
    owner = type_name

    def wrong(what: str) -> ConfigError:
        return ConfigError(f"path {path!r} of {type_name}: {what}")

    while True:
        fields = {field.name: field for field in definitions[owner]}
        if not tokens or tokens[0] not in fields:
            said = f"{tokens[0]!r} is no member of {owner}" if tokens else f"{owner} is a message"
            raise wrong(f"{said}; it has {', '.join(fields) or 'no members'}")
        field = fields[tokens.pop(0)]
        steps.append(field.name)
        if field.kind != "one":
            names = _names_beside(fields) if field.base in PRIMITIVES else None
            keyed = field.is_struct and _value_beside_key(definitions[field.base])
            rest = ".".join(tokens)
            hints = ["an index", *([f"one of its {names}"] if names else [])]
            hints += ["a key"] if keyed else []
            if not rest:
                raise wrong(f"{field.name!r} is a list: expected {' or '.join(hints)} after it")
            if tokens[0].isascii() and tokens[0].isdigit():
                index = int(tokens.pop(0))
                if field.size and index >= field.size:
                    raise wrong(f"{field.name!r} has at most {field.size} elements")
                steps.append(index)
            elif names:
                return ValuePath(path, (*steps, Named(names, rest)), is_text=False)
            elif keyed:
                return ValuePath(path, (*steps, Keyed(rest)), is_text=keyed in TEXTS)
            else:
                raise wrong(f"expected {' or '.join(hints)} after {field.name!r}, found {rest!r}")
        if not field.is_struct:
            if tokens:
                raise wrong(f"{field.name!r} is a {field.base}, which has no {tokens[0]!r}")
            return ValuePath(path, tuple(steps), is_text=field.base in TEXTS)
        owner = field.base


def _names_beside(fields: Mapping[str, Field]) -> str | None:
    for name in _NAME_LISTS:
        if name in fields and fields[name].base == "string" and fields[name].kind != "one":
            return name
    return None


def _value_beside_key(fields: Sequence[Field]) -> str:
    """Type of `value` where the members are a text `key` and a plain `value`, else empty."""
    by_name = {field.name: field for field in fields}
    key, value = by_name.get("key"), by_name.get("value")
    if key is None or value is None or key.base != "string" or value.is_struct:
        return ""
    return value.base if key.kind == value.kind == "one" else ""
