"""Commands as messages of any robot: the paths of a topic map, filled with values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from curation_ros.bags.cdr_encoding import encode
from curation_ros.bags.cdr_paths import Keyed, Named, ValuePath, resolve_path
from curation_ros.bags.definitions import PRIMITIVES, Definitions, parse_definition
from curation_ros.bags.schemas import message_schema
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import NS_PER_S, Floats
from policy_node.policy import Command

_HEADER = "std_msgs/msg/Header"


@dataclass(frozen=True)
class _Topic:
    """A command topic: its type, and where the values of its fields stand in a message."""

    name: str
    type: str
    definitions: Definitions
    paths: dict[str, tuple[ValuePath, ...]] = field(default_factory=dict)


class CommandMessages:
    """Turns a command into one message for each topic that carries part of it.

    Values of a message that no command field maps are zero. A list of numbers with names beside
    it, such as the positions of a JointState, gets the mapped names, and zeros in the lists beside
    it: some readers fail on an empty one. A header gets the stamp of the observation that is
    answered, and the frame of the topic map's `command`.

    Attributes:
        topics: topic -> message type.
    """

    def __init__(self, topic_map: TopicMap, fields: tuple[str, ...]) -> None:
        """Look up where the values go.

        Args:
            topic_map: of the robot.
            fields: that commands have.

        Raises:
            ConfigError: if a field is none of the map, or its paths do not lead to numbers.
            BagError: if a message type has no definition here.
        """
        self._frame = str(topic_map.command.get("frame", ""))
        self._topics: dict[str, _Topic] = {}
        for spec in topic_map.only(fields).fields.values():
            topic = self._topics.get(spec.topic) or _topic_of(spec)
            self._topics[spec.topic] = topic
            topic.paths[spec.name] = tuple(
                resolve_path(topic.type, topic.definitions, path) for path in spec.values
            )
            if any(path.is_text for path in topic.paths[spec.name]):
                raise ConfigError(f"command {spec.name!r}: {topic.type} has a text there")
        self.topics = {topic.name: topic.type for topic in self._topics.values()}

    def encode(self, command: Command, stamp_ns: int) -> list[tuple[str, bytes]]:
        """The messages of a command.

        Args:
            command: (d,) values by field.
            stamp_ns: of the observation that it answers.

        Returns:
            (topic, CDR bytes) of each topic, in the order of the map.

        Raises:
            EpisodeError: if a value does not fit its message, such as 300 in an int8.
        """
        return [
            (topic.name, self._message(topic, command, stamp_ns))
            for topic in self._topics.values()
        ]

    def _message(self, topic: _Topic, command: Mapping[str, Floats], stamp_ns: int) -> bytes:
        message: dict[str, Any] = {}
        first = topic.definitions[topic.type][:1]
        if first and first[0].base == _HEADER:
            sec, nanosec = divmod(stamp_ns, NS_PER_S)
            stamp = {"sec": sec, "nanosec": nanosec}
            message[first[0].name] = {"stamp": stamp, "frame_id": self._frame}
        for name, paths in topic.paths.items():
            for path, value in zip(paths, command[name], strict=True):
                _put(message, topic, path, float(value))
        return encode(topic.type, topic.definitions, message)


def _topic_of(spec: FieldSpec) -> _Topic:
    text = message_schema(spec.type).text
    definitions = parse_definition(spec.type, text, lambda name: message_schema(name).text)
    return _Topic(spec.topic, spec.type, definitions)


def _put(message: dict[str, Any], topic: _Topic, path: ValuePath, value: float) -> None:
    """Put one value at its path, and make all that leads to it."""
    owner, at = topic.type, message
    steps = list(path.steps)
    while steps:
        member = next(f for f in topic.definitions[owner] if f.name == steps[0])
        name = str(steps.pop(0))
        if member.kind == "one":
            if not steps:
                at[name] = _number(member.base, value)
                return
            at, owner = at.setdefault(name, {}), member.base
            continue
        elements = at.setdefault(name, [])
        step = steps.pop(0)
        if isinstance(step, Named):
            _put_named(at, topic.definitions, owner, name, step, value)
            return
        if isinstance(step, Keyed):
            number = _number(_base(topic.definitions, member.base, "value"), value)
            elements.append({"key": step.wanted, "value": number})
            return
        wanted = member.size if member.kind == "array" else int(step) + 1
        while len(elements) < wanted:
            elements.append({} if member.is_struct else 0)
        if not steps:
            elements[int(step)] = _number(member.base, value)
            return
        at, owner = elements[int(step)], member.base


def _put_named(
    at: dict[str, Any],
    definitions: Definitions,
    owner: str,
    member: str,
    named: Named,
    value: float,
) -> None:
    """Put a value beside its name; all lists of numbers there have one element per name."""
    names = at.setdefault(named.names, [])
    if named.wanted not in names:
        names.append(named.wanted)
    for beside in definitions[owner]:
        if beside.kind == "sequence" and beside.base in PRIMITIVES:
            numbers = at.setdefault(beside.name, [])
            numbers += [0] * (len(names) - len(numbers))
    at[member][names.index(named.wanted)] = _number(_base(definitions, owner, member), value)


def _base(definitions: Definitions, owner: str, member: str) -> str:
    return next(f.base for f in definitions[owner] if f.name == member)


def _number(base: str, value: float) -> float | int:
    """The nearest number of a type: integers are rounded."""
    return value if base in ("float32", "float64") else round(value)
