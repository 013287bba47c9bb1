"""ROS 2 message definitions (.msg text, `ros2msg` schemas) as plain fields."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Literal, NamedTuple

from curation_ros.core.errors import BagError

#: Fixed-size types of .msg files and their struct codes; byte and char are unsigned in ROS 2.
PRIMITIVES = {
    "bool": "?",
    "byte": "B",
    "char": "B",
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
#: Text types and their codes here.
TEXTS = {"string": "s", "wstring": "w"}

SEPARATOR = "=" * 80

_SECTION = re.compile(r"^={20,}[ \t]*\r?\n[ \t]*MSG:[ \t]*(\S+)[ \t]*$", re.MULTILINE)
_LINE = re.compile(
    r"(?P<base>[A-Za-z][\w/]*)(?:<=(?P<text_bound>\d+))?"
    r"(?:\[(?P<bounded><=)?(?P<size>\d*)\](?P<list>))?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)"
)
# Names from ROS 1 that old .msg files still use.
_ALIASES = {
    "time": "builtin_interfaces/msg/Time",
    "duration": "builtin_interfaces/msg/Duration",
    "Header": "std_msgs/msg/Header",
}


class Field(NamedTuple):
    """One member of a message.

    Attributes:
        name: member name.
        base: a key of PRIMITIVES or TEXTS, or a full message type such as `std_msgs/msg/Header`.
        kind: one value, an array of fixed size, or a sequence.
        size: length of the array, or the bound of the sequence (0: none).
        text_bound: longest text in characters, 0: none.
    """

    name: str
    base: str
    kind: Literal["one", "array", "sequence"] = "one"
    size: int = 0
    text_bound: int = 0

    @property
    def is_struct(self) -> bool:
        """Whether its elements are messages."""
        return self.base not in PRIMITIVES and self.base not in TEXTS


#: Message type -> its members in order of the wire.
Definitions = dict[str, tuple[Field, ...]]


def full_type_name(name: str, package: str = "") -> str:
    """`pkg/msg/Type` for any spelling of a message type (`pkg/Type`, or `Type` in its package)."""
    parts = name.split("/")
    if len(parts) == 1:
        return _ALIASES.get(name, f"{package}/msg/{name}")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


def parse_definition(
    type_name: str, text: str, find: Callable[[str], str] | None = None
) -> Definitions:
    """Read a message definition with those that it depends on.

    Args:
        type_name: type that the text begins with.
        text: its .msg text, then a section `MSG: pkg/Type` for each dependency.
        find: gives the text of a dependency that has no section of its own.

    Returns:
        Every type that can be reached from `type_name`, itself first.

    Raises:
        BagError: for a line that is no member, a dependency without definition, or a type that
            contains itself.
    """
    parts = _SECTION.split(text)
    sections = {full_type_name(type_name): parts[0]}
    for name, body in zip(parts[1::2], parts[2::2], strict=True):
        sections.setdefault(full_type_name(name), body)
    found: Definitions = {}
    pending = [full_type_name(type_name)]
    while pending:
        name = pending.pop(0)
        if name in found:
            continue
        if name not in sections:
            if find is None:
                text = f"definition of {type_name} has no section for {name}"
                raise BagError(text, finding="bad-definition")
            sections[name] = _SECTION.split(find(name))[0]
        found[name] = _parse_members(name, sections[name])
        pending += [field.base for field in found[name] if field.is_struct]
    _refuse_cycles(type_name, found)
    return found


def dependencies(type_name: str, text: str) -> list[str]:
    """Message types of the members in one .msg text, in order, without repetitions."""
    members = _parse_members(full_type_name(type_name), text)
    return list(dict.fromkeys(field.base for field in members if field.is_struct))


def _parse_members(type_name: str, text: str) -> tuple[Field, ...]:
    package = type_name.split("/")[0]
    members = []
    for raw in text.splitlines():
        line = raw.split("#", 1)[0].strip()
        if not line or line.startswith("@"):
            continue
        match = _LINE.fullmatch(line)
        if match is None:
            text = f"definition of {type_name}: {line[:60]!r} is no member of a message"
            raise BagError(text, finding="bad-definition")
        if match["rest"].startswith("="):
            continue  # a constant: not on the wire
        base = match["base"]
        if base not in PRIMITIVES and base not in TEXTS:
            base = full_type_name(base, package)
        kind: Literal["one", "array", "sequence"] = "one"
        if match["list"] is not None:
            kind = "sequence" if match["bounded"] or not match["size"] else "array"
        size, text_bound = int(match["size"] or 0), int(match["text_bound"] or 0)
        members.append(Field(match["name"], base, kind, size, text_bound))
    return tuple(members)


def _refuse_cycles(type_name: str, found: Definitions) -> None:
    # Depth-first with an explicit stack: a hostile definition must not exhaust Python's own.
    done: set[str] = set()
    path: list[str] = []
    stack: list[tuple[str, bool]] = [(full_type_name(type_name), False)]
    while stack:
        name, leaving = stack.pop()
        if leaving:
            path.pop()
            done.add(name)
            continue
        if name in path:
            text = f"definition of {type_name}: {name} contains itself"
            raise BagError(text, finding="bad-definition")
        if name in done:
            continue
        if len(path) >= 64:
            text = f"definition of {type_name}: nested deeper than 64 messages"
            raise BagError(text, finding="bad-definition")
        path.append(name)
        stack.append((name, True))
        stack += [(field.base, False) for field in found[name] if field.is_struct]
