"""Commands as messages of any robot: the paths of a topic map, filled with values."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from curation_ros.bags.cdr_paths import Keyed, Named, ValuePath, resolve_path
from curation_ros.bags.definitions import PRIMITIVES, TEXTS, Definitions, Field, parse_definition
from curation_ros.bags.schemas import message_schema
from curation_ros.core.episode import messages
from curation_ros.core.episode.messages import PlainMessage
from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import ConfigError, EpisodeError
from policy_node.policy import Command

_HEADER = "std_msgs/msg/Header"
_FLOATS = ("float32", "float64")
#: Unsigned in ROS 2.
_BYTES = ("byte", "char")


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

    def messages(self, command: Command, stamp_ns: int) -> list[PlainMessage]:
        """The messages of a command.

        Args:
            command: (d,) values by field.
            stamp_ns: of the observation that it answers.

        Returns:
            One message per topic, in the order of the map.

        Raises:
            EpisodeError: if a value does not fit its message, such as 300 in an int8.
        """
        return [
            PlainMessage(topic.name, topic.type, self._content(topic, command, stamp_ns))
            for topic in self._topics.values()
        ]

    def _content(self, topic: _Topic, command: Command, stamp_ns: int) -> Mapping[str, Any]:
        content = _zeros(topic.definitions, topic.type)
        first = topic.definitions[topic.type][0]
        if first.base == _HEADER:
            content[first.name] = {"stamp": messages.time(stamp_ns), "frame_id": self._frame}
        for name, paths in topic.paths.items():
            for path, value in zip(paths, command[name], strict=True):
                _put(content, topic, path, float(value))
        return content


def _topic_of(spec: FieldSpec) -> _Topic:
    text = message_schema(spec.type).text
    definitions = parse_definition(spec.type, text, lambda name: message_schema(name).text)
    return _Topic(spec.topic, spec.type, definitions)


def _zeros(definitions: Definitions, type_name: str) -> dict[str, Any]:
    """A message with every number zero, every text empty, and every list as short as it may be."""
    return {member.name: _zero(definitions, member) for member in definitions[type_name]}


def _zero(definitions: Definitions, member: Field) -> Any:
    if member.kind == "one":
        return _zero_element(definitions, member)
    n = member.size if member.kind == "array" else 0
    return [_zero_element(definitions, member) for _ in range(n)]


def _zero_element(definitions: Definitions, member: Field) -> Any:
    if member.is_struct:
        return _zeros(definitions, member.base)
    return "" if member.base in TEXTS else _number(member.base, 0.0, member.name)


def _put(content: dict[str, Any], topic: _Topic, path: ValuePath, value: float) -> None:
    """Put one value at its path, and make all that leads to it."""
    owner, at = topic.type, content
    steps = list(path.steps)
    while steps:
        member = next(f for f in topic.definitions[owner] if f.name == steps[0])
        name = str(steps.pop(0))
        if member.kind == "one":
            if not steps:
                at[name] = _number(member.base, value, path.text)
                return
            at, owner = at[name], member.base
            continue
        step = steps.pop(0)
        if isinstance(step, Named):
            _put_named(at, topic.definitions[owner], member, step, value)
            return
        if isinstance(step, Keyed):
            of_value = next(f for f in topic.definitions[member.base] if f.name == "value")
            number = _number(of_value.base, value, path.text)
            at[name].append({**_zeros(topic.definitions, member.base), "key": step.wanted})
            at[name][-1]["value"] = number
            return
        elements = at[name]
        elements += [
            _zero_element(topic.definitions, member) for _ in range(int(step) + 1 - len(elements))
        ]
        if not steps:
            elements[int(step)] = _number(member.base, value, path.text)
            return
        at, owner = elements[int(step)], member.base


def _put_named(
    at: dict[str, Any],
    members: tuple[Field, ...],
    member: Field,
    named: Named,
    value: float,
) -> None:
    """Put a value beside its name; all lists of numbers there have one element per name."""
    names = at[named.names]
    if named.wanted not in names:
        names.append(named.wanted)
    for beside in members:
        if beside.kind == "sequence" and beside.base in PRIMITIVES:
            zero = _number(beside.base, 0.0, beside.name)
            at[beside.name] += [zero] * (len(names) - len(at[beside.name]))
    at[member.name][names.index(named.wanted)] = _number(member.base, value, named.wanted)


def _number(base: str, value: float, where: str) -> float | int | bool:
    """The nearest number of a type: integers are rounded.

    Raises:
        EpisodeError: if it is out of the range of the type.
    """
    if base in _FLOATS:
        return value
    if base == "bool":
        return bool(round(value))
    limits = np.iinfo("uint8" if base in _BYTES else base)
    number = round(value)
    if not limits.min <= number <= limits.max:
        raise EpisodeError(f"command {where!r}: {number} is out of the range of {base}")
    return number
