"""What policies observe and command: variants of a training config, or drafted for a robot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, PolicyError
from curation_ros.core.yaml_file import read_yaml
from policy_node.action import CommandTerm, action_spec
from policy_node.observation import observation_spec
from policy_node.settings import TrainingSettings

DRAFT = "draft"
#: Roles of the fields that a drafted observation takes, in addition to the fingers.
_OBSERVED_ROLES = ("clock", "effector", "observation", "object", "phase")
_OBSERVED_TEXT = f"{', '.join(_OBSERVED_ROLES[:-1])} or {_OBSERVED_ROLES[-1]}"
#: Commands in these units are places to go to; the middle of the demonstrations is their center.
_PLACE_UNITS = ("m", "cm", "mm", "rad", "deg")
_FROM_DATA = "data"


@dataclass(frozen=True)
class Variant:
    """A choice of what a policy observes and what it commands.

    Attributes:
        name: of the variant.
        observation: terms, see `policy_node.observation.ObservationSpec`.
        action: command fields in the order of the outputs.
    """

    name: str
    observation: tuple[str, ...]
    action: tuple[CommandTerm, ...]

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map that this variant cannot be trained on.

        Raises:
            PolicyError: naming what was found and what was expected.
        """
        observation_spec(self.observation, topic_map, where)
        # Without demonstrations: numbers that come from them are not at issue here.
        fixed = [
            replace(term, scale=term.scale or (1.0,), center=term.center or (0.0,))
            for term in self.action
        ]
        action_spec(fixed, topic_map, (), where)

    def to_json(self) -> dict[str, Any]:
        """A training config with this variant alone, as plain data."""
        action: dict[str, Any] = {}
        for term in self.action:
            numbers = {"scale": term.scale, "center": term.center}
            given = {key: _shown(values) for key, values in numbers.items() if values != (0.0,)}
            action[term.field] = given
        entry = {"observation": list(self.observation), "action": action}
        return {"variants": {self.name: entry}}

    def to_yaml(self) -> str:
        """The same as text, for a file."""
        return str(yaml.safe_dump(self.to_json(), sort_keys=False, default_flow_style=None))


@dataclass(frozen=True)
class TrainingConfig:
    """A training config as read from a file.

    Attributes:
        settings: numbers of the training.
        variants: by name, in the order of the file.
        where: its source, for messages.
    """

    settings: TrainingSettings = field(default_factory=TrainingSettings)
    variants: Mapping[str, Variant] = field(default_factory=dict)
    where: str = "training config"

    def variant(self, name: str) -> Variant:
        """A variant by name.

        Raises:
            ConfigError: if there is none of this name.
        """
        if name not in self.variants:
            known = ", ".join(self.variants) or "none"
            raise ConfigError(f"{self.where}: no variant {name!r}; its variants are {known}")
        return self.variants[name]

    def fitting(self, topic_map: TopicMap) -> Variant | None:
        """The first variant that a topic map has all fields for; None where none has."""
        for variant in self.variants.values():
            try:
                variant.check(topic_map, self.where)
            except PolicyError:
                continue
            return variant
        return None


def draft_variant(topic_map: TopicMap) -> Variant:
    """A variant for a robot that nobody has written one for, from the roles of its fields.

    It observes every field with role clock, effector, observation, object or phase, and the
    fingers; it commands every field with role action, and the gripper.

    Raises:
        PolicyError: if the topic map has no such field on either side.
    """
    gripper = topic_map.gripper
    fingers = gripper.fingers if gripper is not None else ""
    observed = [
        spec.name
        for spec in topic_map.fields.values()
        if spec.role in _OBSERVED_ROLES or spec.name == fingers
    ]
    action = []
    for spec in topic_map.with_role("action", "gripper"):
        is_place = spec.unit in _PLACE_UNITS or spec.role == "gripper"
        if gripper is not None and gripper.field == spec.name:
            is_place = False  # the gripper's meaning is known: it has neither scale nor center
        action.append(CommandTerm(spec.name, center=() if is_place else (0.0,)))
    if not (observed and action):
        what, roles = ("command", "action or gripper") if observed else ("observe", _OBSERVED_TEXT)
        raise PolicyError(
            f"no variant can be drafted: the topic map has no field to {what}; expected one with "
            f"role {roles}"
        )
    return Variant(DRAFT, tuple(observed), tuple(action))


def read_training_config(path: Path) -> TrainingConfig:
    """Read a training config, such as `config/training.yaml`.

    Raises:
        ConfigError: if the file is missing, is not YAML, or a key or value is none; the message
            names the file, the key, what was found and what was expected.
    """
    what = "training config"
    where = f"{what} {path}"
    raw = _mapping(read_yaml(path, what), where, ("settings", "variants"))
    settings = settings_from(raw.get("settings") or {}, f"{where}: settings")
    variants = raw.get("variants") or {}
    if not isinstance(variants, Mapping):
        raise ConfigError(f"{where}: variants are {variants!r:.60}, expected a mapping of names")
    return TrainingConfig(
        settings,
        {str(name): _variant(str(name), entry, where) for name, entry in variants.items()},
        where,
    )


def settings_from(raw: object, where: str) -> TrainingSettings:
    """Check plain data and make settings of it; keys that are absent take their defaults.

    Raises:
        ConfigError: naming the key, what was found and what was expected.
    """
    known = {f.name: f.default for f in fields(TrainingSettings)}
    given = _mapping(raw, where, tuple(known))
    values: dict[str, Any] = {}
    for key, value in given.items():
        default = known[key]
        if isinstance(default, tuple):
            numbers = value if isinstance(value, list | tuple) else [None]
            if not all(isinstance(n, int) and not isinstance(n, bool) for n in numbers):
                raise ConfigError(f"{where}: {key!r} is {value!r:.60}, expected a list of widths")
            values[key] = tuple(numbers)
            continue
        kind = (int,) if isinstance(default, int) else (int, float)
        if not isinstance(value, kind) or isinstance(value, bool):
            wanted = "a whole number" if kind == (int,) else "a number"
            raise ConfigError(f"{where}: {key!r} is {value!r:.60}, expected {wanted}")
        values[key] = value if kind == (int,) else float(value)
    try:
        return TrainingSettings(**values)
    except PolicyError as err:
        raise ConfigError(f"{where}: {err}") from err


def choose_variant(
    config: TrainingConfig,
    topic_map: TopicMap,
    *,
    name: str = "",
    observation: str = "",
    action: str = "",
) -> Variant:
    """The variant that a person asks for, else the first one that fits, else a draft.

    Args:
        config: with the variants.
        topic_map: of the demonstrations.
        name: of a variant, or `draft`; empty: not asked for.
        observation: terms that replace those of the variant, such as `tool_pose,cup_pose@start`.
        action: fields that replace those of the variant, such as `twist=0.2,gripper`.

    Returns:
        The variant; its name ends in `-changed` if terms or fields were replaced.

    Raises:
        ConfigError: if there is no variant of this name, or the action cannot be read.
        PolicyError: if a draft is needed and the topic map has no fields for one.
    """
    if name in config.variants or name not in ("", DRAFT):
        variant = config.variant(name)
    else:
        fitting = None if name else config.fitting(topic_map)
        variant = fitting or draft_variant(topic_map)
    changes: dict[str, Any] = {}
    if observation:
        changes["observation"] = tuple(term.strip() for term in observation.split(","))
    if action:
        changes["action"] = _command_terms(action)
    return replace(variant, name=f"{variant.name}-changed", **changes) if changes else variant


def _variant(name: str, raw: object, where: str) -> Variant:
    here = f"{where}: variant {name!r}"
    entry = _mapping(raw, here, ("observation", "action"))
    terms = entry.get("observation")
    if not isinstance(terms, list) or not terms or not all(isinstance(t, str) for t in terms):
        raise ConfigError(f"{here}: 'observation' is {terms!r:.60}, expected a list of terms")
    action = entry.get("action")
    if not isinstance(action, Mapping) or not action:
        raise ConfigError(f"{here}: 'action' is {action!r:.60}, expected a mapping of fields")
    commands = tuple(_command_term(str(key), value, here) for key, value in action.items())
    return Variant(name, tuple(terms), commands)


def _command_terms(text: str) -> tuple[CommandTerm, ...]:
    """Command terms of a text such as `twist=0.2,gripper`, which gives a scale to the first."""
    terms = []
    for part in text.split(","):
        name, equals, number = (word.strip() for word in part.partition("="))
        if not name:
            raise ConfigError(f"action {text!r}: expected fields such as twist=0.2,gripper")
        scale: object = number if equals else _FROM_DATA
        if equals and number != _FROM_DATA:
            try:
                scale = float(number)
            except ValueError:
                raise ConfigError(f"action {text!r}: {number!r} is no number") from None
        terms.append(_command_term(name, {"scale": scale}, "action"))
    return tuple(terms)


def _command_term(name: str, raw: object, where: str) -> CommandTerm:
    here = f"{where}: command {name!r}"
    entry = _mapping({} if raw is None else raw, here, ("scale", "center"))
    scale = _numbers(entry.get("scale", _FROM_DATA), f"{here}: scale")
    center = _numbers(entry.get("center", 0.0), f"{here}: center")
    if any(number <= 0.0 for number in scale):
        raise ConfigError(f"{here}: scale is {entry['scale']!r}, expected numbers above 0")
    return CommandTerm(name, scale, center)


def _numbers(raw: object, what: str) -> tuple[float, ...]:
    """A number, or a list of one number per value; empty for `data`."""
    if raw == _FROM_DATA:
        return ()
    entries: Sequence[Any] = raw if isinstance(raw, list) and raw else [raw]
    numbers = [n for n in entries if isinstance(n, int | float) and not isinstance(n, bool)]
    if len(numbers) < len(entries) or not all(math.isfinite(n) for n in numbers):
        raise ConfigError(
            f"{what} is {raw!r:.60}, expected a number, one number per value, or {_FROM_DATA!r}"
        )
    return tuple(map(float, numbers))


def _shown(values: tuple[float, ...]) -> Any:
    if not values:
        return _FROM_DATA
    return values[0] if len(values) == 1 else list(values)


def _mapping(raw: object, where: str, known: Sequence[str]) -> Mapping[str, Any]:
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{where}: expected a mapping, found {raw!r:.60}")
    for key in raw:
        if key not in known:
            raise ConfigError(f"{where}: unknown key {key!r}; known are {', '.join(known)}")
    return raw
