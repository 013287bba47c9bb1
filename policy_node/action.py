"""What a policy commands: targets for training made of an episode's commands, and back."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, PolicyError
from curation_ros.core.types import Floats, Span
from policy_node.commands import (
    GripperCommand,
    ScaledCommand,
    command_field,
    gripper_command_of,
)

#: Rounding in scaling is no clipping.
_ROUNDING = 1e-9
#: Scale of a value that never moves in the demonstrations.
_NO_MOTION = 1.0


@dataclass(frozen=True)
class CommandTerm:
    """A command field as a variant names it.

    Attributes:
        field: name in the topic map.
        scale: command, from the center, that is an output of 1: one number per value of the
            field, or one for all. Empty: the largest command of the demonstrations, per value.
        center: command that is an output of 0, in the same form. Empty: the middle of the
            demonstrations, per value.
    """

    field: str
    scale: tuple[float, ...] = ()
    center: tuple[float, ...] = (0.0,)


@dataclass(frozen=True)
class ActionSpec:
    """How commands become targets in [-1, 1] and outputs become commands.

    Make one with `action_spec`, which takes missing scales from the demonstrations.

    Attributes:
        commands: command fields in the order of the outputs.

    Raises:
        PolicyError: if there is no field, or one is there twice.
    """

    commands: tuple[ScaledCommand | GripperCommand, ...]

    def __post_init__(self) -> None:
        if not self.commands:
            raise PolicyError("an action needs at least one command field, found none")
        if len(set(self.fields)) < len(self.fields):
            raise PolicyError(f"an action names a field twice: {', '.join(self.fields)}")

    @cached_property
    def fields(self) -> tuple[str, ...]:
        """Names of the command fields."""
        return tuple(command.name for command in self.commands)

    @property
    def width(self) -> int:
        """Number of outputs A."""
        return sum(command.width for command in self.commands)

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map whose commands mean something else.

        Args:
            topic_map: of an episode or of a robot.
            where: whose requirement it is, for the message.

        Raises:
            PolicyError: if a field is missing, is no command, or has another width, unit or
                meaning.
        """
        for command in self.commands:
            command.check(topic_map, where)

    def scaled(self, episode: Episode, span: Span | None = None) -> Floats:
        """Commands as outputs, not clipped.

        Args:
            episode: the whole episode: what a gripper holds may have been commanded before the
                span.
            span: nanoseconds from the start stamp, inclusive; None: all steps.

        Returns:
            (T, A): (command - center) / scale; of a gripper -1 open to +1 closed, and 0 before
            its first command.

        Raises:
            PolicyError: if a field is missing or means something else, or a command in the span
                is not finite.
        """
        where = f"episode {episode.id}"
        self.check(episode.topic_map, where)
        try:
            columns = [command.scaled(episode) for command in self.commands]
        except CurationError as err:
            raise PolicyError(str(err)) from err
        stamps = episode.stamps_ns - episode.start_ns
        inside = slice(None) if span is None else (stamps >= span[0]) & (stamps <= span[1])
        for command, values in zip(self.commands, columns, strict=True):
            bad = np.flatnonzero(~np.isfinite(values[inside]).all(axis=1))
            if len(bad):
                raise PolicyError(f"{where}: {command.name} in row {bad[0]} is not finite")
        every: Floats = np.concatenate(columns, axis=1)[inside]
        return every

    def clipped_shares(self, scaled: Floats) -> dict[str, float]:
        """Share of the values of each field that are beyond its scale, of (T, A) `scaled`.

        A gripper has no scale, and no share.
        """
        beyond = np.abs(scaled) > 1.0 + _ROUNDING
        return {
            command.name: float(beyond[:, place].mean())
            for command, place in zip(self.commands, self._places, strict=True)
            if isinstance(command, ScaledCommand)
        }

    def command(self, output: Floats) -> dict[str, Floats]:
        """The command that an output means.

        Args:
            output: (A,) in [-1, 1].

        Returns:
            (d,) values of each field, in its unit.
        """
        return {
            command.name: command.command(output[place])
            for command, place in zip(self.commands, self._places, strict=True)
        }

    @cached_property
    def _places(self) -> tuple[slice, ...]:
        """Outputs of each command."""
        ends = list(itertools.accumulate((c.width for c in self.commands), initial=0))
        return tuple(slice(*pair) for pair in itertools.pairwise(ends))

    def to_json(self) -> list[dict[str, Any]]:
        """Plain data that `action_from_json` reads back to an equal spec."""
        return [command.to_json() for command in self.commands]


def action_spec(
    terms: Sequence[CommandTerm],
    topic_map: TopicMap,
    episodes: Iterable[tuple[Episode, Span | None]],
    where: str,
) -> ActionSpec:
    """Make a spec of the command fields that a variant names.

    Args:
        terms: in the order of the outputs.
        topic_map: of the episodes.
        episodes: what missing scales and centers are taken from, with their spans.
        where: source of the terms, for messages.

    Raises:
        PolicyError: if a field is missing or no command, a scale has another number of values, or
            the demonstrations have commands that are not finite.
    """
    demonstrations, gripper = list(episodes), gripper_command_of(topic_map)
    commands: list[ScaledCommand | GripperCommand] = []
    for term in terms:
        spec = command_field(topic_map, term.field, where)
        if gripper is not None and gripper.name == term.field:
            commands.append(gripper)
            continue
        width = len(spec.values)
        scale = _per_value(term.scale, width, f"{where}: scale of {term.field!r}")
        center = _per_value(term.center, width, f"{where}: center of {term.field!r}")
        if not (scale and center):
            low, high = _range(term.field, demonstrations, where)
            center = center or tuple(map(float, (low + high) / 2.0))
            reach = np.maximum(np.abs(low - center), np.abs(high - center))
            scale = scale or tuple(map(float, np.where(reach > 0.0, reach, _NO_MOTION)))
        try:
            commands.append(ScaledCommand(term.field, spec.unit, scale, center))
        except PolicyError as err:
            raise PolicyError(f"{where}: {err}") from err
    try:
        return ActionSpec(tuple(commands))
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err


def action_from_json(raw: object, where: str) -> ActionSpec:
    """Check plain data and make a spec of it.

    Raises:
        PolicyError: naming the source, what was found and what was expected.
    """
    commands: list[ScaledCommand | GripperCommand] = []
    try:
        if not isinstance(raw, list):
            raise TypeError
        for entry in raw:
            name = str(entry["name"])
            if entry["kind"] == "gripper":
                ends = float(entry["open_value"]), float(entry["closed_value"])
                commands.append(GripperCommand(name, str(entry["command"]), *ends))
                continue
            scale, center = (tuple(map(float, entry[key])) for key in ("scale", "center"))
            commands.append(ScaledCommand(name, str(entry["unit"]), scale, center))
        return ActionSpec(tuple(commands))
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err
    except (KeyError, TypeError, ValueError) as err:
        raise PolicyError(
            f"{where}: 'action' is {raw!r:.60}, expected a list of commands with kind and name"
        ) from err


def _per_value(given: tuple[float, ...], width: int, what: str) -> tuple[float, ...]:
    """One number per value, or nothing where the demonstrations decide."""
    if len(given) == 1:
        return given * width
    if given and len(given) != width:
        raise PolicyError(f"{what} has {len(given)} numbers, expected 1 or {width}")
    return given


def _range(
    name: str, episodes: Sequence[tuple[Episode, Span | None]], where: str
) -> tuple[Floats, Floats]:
    """(D,) least and (D,) largest command of the demonstrations."""
    lows, highs = [], []
    for episode, span in episodes:
        try:
            values = (episode if span is None else episode.within(span)).field(name)
        except CurationError as err:
            raise PolicyError(str(err)) from err
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise PolicyError(f"episode {episode.id}: {name} in row {bad[0]} is not finite")
        if len(values):
            lows.append(values.min(axis=0))
            highs.append(values.max(axis=0))
    if not lows:
        raise PolicyError(f"{where}: no step to take the scale of {name!r} from")
    return np.min(lows, axis=0), np.max(highs, axis=0)
