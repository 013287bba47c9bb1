"""Fields of a topic map in this process: what nodes decode from the simulated robot's messages.

A policy that is rolled out here observes and commands the same values as one on the graph.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from curation_ros.core.episode.topic_map import FieldSpec, TopicMap
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Floats
from sim_node.environment import Command, Environment
from sim_node.messages import GRIPPER_JOINT, RobotMessages
from sim_node.tasks.task import Step

#: (topic, path) -> place in x, y, z and gripper.
_COMMANDS = {
    ("command/twist", "twist.linear.x"): 0,
    ("command/twist", "twist.linear.y"): 1,
    ("command/twist", "twist.linear.z"): 2,
    ("command/gripper", f"position.{GRIPPER_JOINT}"): 3,
}


class ObservedFields:
    """Reads fields from observations.

    Args:
        env: the environment that is observed.
        topic_map: says which field is which value of which topic.
        names: the fields to read.

    Raises:
        ConfigError: if a field is not in the map, or the robot does not send its topic.
    """

    def __init__(self, env: Environment, topic_map: TopicMap, names: Iterable[str]) -> None:
        self._messages = RobotMessages(env)
        self._specs = [_spec(topic_map, name) for name in names]
        for spec in self._specs:
            if self._messages.types.get(spec.topic) != spec.type:
                raise ConfigError(
                    f"field {spec.name!r}: the simulated robot does not send {spec.type} on "
                    f"topic {spec.topic!r}; it sends {', '.join(self._messages.types)}"
                )
        self._topics = tuple(dict.fromkeys(spec.topic for spec in self._specs))
        self._places: list[tuple[FieldSpec, list[tuple[str | int, ...]]]] = []

    def values(self, step: Step) -> dict[str, Floats]:
        """Values of the fields at one step.

        Returns:
            Field -> (d,) values; of a phase the index of its label.

        Raises:
            ConfigError: if a path leads nowhere, or the map does not know a phase.
        """
        contents = {topic: self._messages.content(topic, 0, step, "") for topic in self._topics}
        if not self._places:  # every observation has the same members in the same order
            self._places = [
                (spec, [_place(spec, contents[spec.topic], path) for path in spec.values])
                for spec in self._specs
            ]
        found = {}
        for spec, places in self._places:
            content = contents[spec.topic]
            if spec.labels:
                found[spec.name] = np.array([_label(spec, _at(content, places[0]))])
            else:
                found[spec.name] = np.array([float(_at(content, p)) for p in places])
        return found


class CommandedFields:
    """Makes a command of the fields that a policy answers with.

    Args:
        topic_map: says which field is which value of which topic.
        names: the fields.

    Raises:
        ConfigError: if a field is not in the map, or the robot does not take its values.
    """

    def __init__(self, topic_map: TopicMap, names: Iterable[str]) -> None:
        self._places: dict[str, list[int]] = {}
        for spec in (_spec(topic_map, name) for name in names):
            for path in spec.values:
                if (spec.topic, path) not in _COMMANDS:
                    known = ", ".join(f"{path} of {topic}" for topic, path in _COMMANDS)
                    raise ConfigError(
                        f"field {spec.name!r}: the simulated robot takes no command {path!r} on "
                        f"topic {spec.topic!r}; it takes {known}"
                    )
            self._places[spec.name] = [_COMMANDS[spec.topic, path] for path in spec.values]

    def command(self, values: Mapping[str, Floats]) -> Command:
        """The command; what no field sets is zero, and the gripper holds.

        Args:
            values: (d,) values by field.
        """
        numbers = np.zeros(4)
        for name, places in self._places.items():
            numbers[places] = values[name]
        return Command(numbers[:3], float(numbers[3]))


def _spec(topic_map: TopicMap, name: str) -> FieldSpec:
    if name not in topic_map.fields:
        raise ConfigError(f"no field {name!r} in the topic map: {', '.join(topic_map.fields)}")
    return topic_map.fields[name]


def _place(spec: FieldSpec, content: Mapping[str, Any], path: str) -> tuple[str | int, ...]:
    """Where a path leads: keys and indices; see `curation_ros.bags.cdr_paths` for the paths."""
    tokens = path.split(".")
    place: list[str | int] = []
    at: Any = content
    beside: Mapping[str, Any] = {}
    try:
        while tokens:
            if isinstance(at, Mapping):
                beside = at
                place.append(tokens.pop(0))
            elif tokens[0].isdigit():
                place.append(int(tokens.pop(0)))
            elif isinstance(at[0], Mapping):
                keys = [entry["key"] for entry in at]
                place += [keys.index(".".join(tokens)), "value"]
                tokens = []
            else:
                place.append(beside["name"].index(".".join(tokens)))
                tokens = []
            at = _at(content, place)
        if not spec.labels:
            float(at)
    except (KeyError, IndexError, ValueError, TypeError) as err:
        raise ConfigError(
            f"field {spec.name!r}: no value at {path!r} of topic {spec.topic!r}"
        ) from err
    return tuple(place)


def _at(content: Any, place: Iterable[str | int]) -> Any:
    for key in place:
        content = content[key]
    return content


def _label(spec: FieldSpec, name: str) -> float:
    if name not in spec.labels:
        raise ConfigError(
            f"field {spec.name!r}: phase {name!r} is none of {', '.join(spec.labels)}"
        )
    return float(spec.labels.index(name))
