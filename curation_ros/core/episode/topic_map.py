"""The topic map: which field of which topic is which part of an episode, on any robot."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from curation_ros.core.errors import ConfigError
from curation_ros.core.yaml_file import read_yaml

ROLES = ("clock", "observation", "action", "gripper", "phase", "object", "effector")
STAMPS = ("header", "source")
#: End of a name in `state` and `action` that stands for the first value of a field.
AT_START = "@start"
#: Silence longer than this marks an episode, if the map does not say otherwise; seconds.
MAX_GAP_S = 0.25


@dataclass(frozen=True)
class FieldSpec:
    """One episode field: a (T, len(values)) array read from one topic.

    Attributes:
        name: field name, unique in the map.
        topic: relative topic name, resolved by the node that subscribes.
        type: ROS message type, such as `sensor_msgs/msg/JointState`.
        role: one of ROLES.
        values: paths into the message, one per column: `pose.position.x`, `position.panda_joint1`
            (the element whose `name` is panda_joint1), `status.0.values.progress` (the value whose
            `key` is progress; digits are an index).
        unit: unit of the columns, for people and reports.
        labels: for role `phase`: the names in their order; the column holds their index.
        stamp: `header`, or `source` for a type without one (then the source timestamp counts).
        interpolate: whether a value between two samples is interpolated rather than held.
    """

    name: str
    topic: str
    type: str
    role: str
    values: tuple[str, ...]
    unit: str = ""
    labels: tuple[str, ...] = ()
    stamp: str = "header"
    interpolate: bool = False


@dataclass(frozen=True)
class GripperSpec:
    """What the numbers of the gripper mean.

    Attributes:
        field: the field that commands it (role `gripper`).
        opens: sign of the command that opens, -1 or +1.
        kind: `binary` (the sign decides, 0 holds) or `continuous` (nearer to the open end opens).
        open_value, closed_value: ends of the command's range.
        fingers: the field with finger positions, or empty if there is none. The spread of its
            columns is larger when open.
    """

    field: str
    opens: int = -1
    kind: str = "binary"
    open_value: float = -1.0
    closed_value: float = 1.0
    fingers: str = ""


@dataclass(frozen=True)
class TopicMap:
    """All fields of an episode, checked.

    The first field with role `clock`, else the first with role `effector`, is the clock.

    Attributes:
        fields: by name, in the order of the file.
        clock: name of the field whose stamps are the episode's clock.
        gripper: its meaning, or None if the robot has none.
        state, action: columns of the state and action that the paper's metrics see: field names,
            a trailing `@start` holds a field's first value, a phase field becomes a one-hot.
        max_gap_s: silence longer than this marks the episode.
        command: scale, frame and controller of the commands, as free text for people.
    """

    fields: Mapping[str, FieldSpec]
    clock: str
    gripper: GripperSpec | None = None
    state: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    max_gap_s: float = MAX_GAP_S
    command: Mapping[str, Any] = field(default_factory=dict)

    @property
    def topics(self) -> dict[str, str]:
        """Topic name -> message type, in the order of the map."""
        return {spec.topic: spec.type for spec in self.fields.values()}

    @property
    def command_topics(self) -> frozenset[str]:
        """Topics that carry actions. They answer an observation, so they join forwards."""
        return frozenset(s.topic for s in self.fields.values() if s.role in ("action", "gripper"))

    @property
    def source_stamped(self) -> frozenset[str]:
        """Topics whose types have no header."""
        return frozenset(s.topic for s in self.fields.values() if s.stamp == "source")

    @property
    def clock_topic(self) -> str:
        """The topic whose stamps are the episode's clock."""
        return self.fields[self.clock].topic

    def only(self, names: Iterable[str]) -> TopicMap:
        """The map with only these fields; its clock stays if it is one of them.

        Raises:
            ConfigError: if a name is no field, or there is none.
        """
        wanted = list(names)
        for name in wanted or [""]:
            if name not in self.fields:
                raise ConfigError(f"topic map: no field {name!r}; it has {', '.join(self.fields)}")
        kept = {k: v for k, v in self.fields.items() if k in wanted}
        clock = self.clock if self.clock in kept else next(iter(kept))
        return replace(self, fields=kept, clock=clock, gripper=None, state=(), action=())

    def with_role(self, *roles: str) -> tuple[FieldSpec, ...]:
        """Fields that have one of `roles`, in the order of the map."""
        return tuple(s for s in self.fields.values() if s.role in roles)

    def to_json(self) -> dict[str, Any]:
        """Plain data that `topic_map_from_json` reads back to an equal map."""
        out: dict[str, Any] = {
            "max_gap_s": self.max_gap_s,
            "fields": {
                name: {
                    "topic": s.topic,
                    "type": s.type,
                    "role": s.role,
                    "values": list(s.values),
                    **({"unit": s.unit} if s.unit else {}),
                    **({"labels": list(s.labels)} if s.labels else {}),
                    **({"stamp": s.stamp} if s.stamp != "header" else {}),
                    **({"interpolate": True} if s.interpolate else {}),
                }
                for name, s in self.fields.items()
            },
            "clock": self.clock,
            "state": list(self.state),
            "action": list(self.action),
        }
        if self.gripper is not None:
            out["gripper"] = dict(vars(self.gripper))
        if self.command:
            out["command"] = dict(self.command)
        return out

    @property
    def hash(self) -> str:
        """Identity of the map: the same for equal maps on every machine."""
        text = json.dumps(self.to_json(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def _reject_unknown(found: Mapping[str, Any], known: set[str], where: str) -> None:
    extra = sorted(set(found) - known, key=str)
    if extra:
        raise ConfigError(
            f"{where}: unknown key {extra[0]!r}; known are {', '.join(sorted(known))}"
        )


def _texts(raw: object, what: str) -> tuple[str, ...]:
    """A list of texts; an empty one for None."""
    if raw is None:
        return ()
    if isinstance(raw, Sequence) and not isinstance(raw, str):
        texts = tuple(raw)
        if all(isinstance(text, str) for text in texts):
            return texts
    raise ConfigError(f"{what} must be a list of texts, found {raw!r}")


def _number(raw: Any, what: str) -> float:
    try:
        value = float("nan") if isinstance(raw, bool) else float(raw)
    except (TypeError, ValueError, OverflowError):
        value = float("nan")
    if not math.isfinite(value):
        raise ConfigError(f"{what} must be a number, found {raw!r}")
    return value


def _field_spec(name: str, raw: object, where: str) -> FieldSpec:
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{where}: field {name!r} must be a mapping, found {raw!r}")
    here = f"{where}: field {name!r}"
    known = {"topic", "type", "role", "values", "unit", "labels", "stamp", "interpolate"}
    _reject_unknown(raw, known, here)
    for key in ("topic", "type", "role", "values"):
        if not raw.get(key):
            raise ConfigError(f"{here}: {key!r} is missing")
    if raw["role"] not in ROLES:
        raise ConfigError(f"{here}: role {raw['role']!r} is none of {', '.join(ROLES)}")
    if raw.get("stamp", "header") not in STAMPS:
        raise ConfigError(f"{here}: stamp {raw['stamp']!r} is none of {', '.join(STAMPS)}")
    values = _texts(raw["values"], f"{here}: 'values'")
    labels = _texts(raw.get("labels"), f"{here}: 'labels'")
    if not isinstance(raw.get("interpolate", False), bool):
        found = raw["interpolate"]
        raise ConfigError(f"{here}: 'interpolate' must be true or false, found {found!r}")
    parts = str(raw["type"]).split("/")
    if len(parts) != 3 or parts[1] != "msg":
        raise ConfigError(f"{here}: type {raw['type']!r} is not of the form package/msg/Type")
    if raw["role"] == "phase" and (not labels or len(values) != 1):
        raise ConfigError(f"{here}: a phase needs 'labels' and exactly one value")
    return FieldSpec(
        name=name,
        topic=str(raw["topic"]),
        type=str(raw["type"]),
        role=str(raw["role"]),
        values=values,
        unit=str(raw.get("unit", "")),
        labels=labels,
        stamp=str(raw.get("stamp", "header")),
        interpolate=raw.get("interpolate", False),
    )


def _gripper_spec(raw: object, fields: Mapping[str, FieldSpec], where: str) -> GripperSpec:
    here = f"{where}: gripper"
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{here} must be a mapping, found {raw!r}")
    _reject_unknown(raw, {"field", "opens", "kind", "open_value", "closed_value", "fingers"}, here)
    if "field" not in raw:
        raise ConfigError(f"{here}: 'field' is missing")
    numbers = {
        k: _number(raw[k], f"{here}: {k}")
        for k in ("opens", "open_value", "closed_value")
        if k in raw
    }
    if numbers.get("opens", -1) not in (-1, 1):
        raise ConfigError(f"{here}: opens must be -1 or 1, found {raw['opens']!r}")
    texts = {k: str(raw[k] or "") for k in ("field", "kind", "fingers") if k in raw}
    spec = GripperSpec(**{**texts, **numbers})  # type: ignore[arg-type]  # checked above
    spec = replace(spec, opens=int(spec.opens))
    if spec.field not in fields or fields[spec.field].role != "gripper":
        raise ConfigError(f"{here}: field {spec.field!r} is not a field with role gripper")
    if spec.fingers and spec.fingers not in fields:
        raise ConfigError(f"{here}: fingers {spec.fingers!r} is not a field of this map")
    if spec.kind not in ("binary", "continuous"):
        raise ConfigError(f"{here}: kind must be binary or continuous, found {spec.kind!r}")
    if (spec.open_value - spec.closed_value) * spec.opens <= 0:
        raise ConfigError(
            f"{here}: opens {spec.opens:+d} contradicts open_value {spec.open_value} "
            f"and closed_value {spec.closed_value}"
        )
    return spec


def topic_map_from_json(raw: object, where: str = "topic map") -> TopicMap:
    """Check plain data (of YAML or JSON) and make a topic map of it.

    Args:
        raw: the mapping, as `config/topics.yaml` has it.
        where: name of its source, for messages.

    Raises:
        ConfigError: naming source, key, what was found and what was expected.
    """
    if not isinstance(raw, Mapping) or not isinstance(raw.get("fields"), Mapping):
        raise ConfigError(f"{where}: expected a mapping with the key 'fields', found {raw!r:.60}")
    known = {"fields", "clock", "gripper", "state", "action", "max_gap_s", "command"}
    _reject_unknown(raw, known, where)
    fields = {
        str(name): _field_spec(str(name), spec, where) for name, spec in raw["fields"].items()
    }
    types: dict[str, FieldSpec] = {}
    for spec in fields.values():
        other = types.setdefault(spec.topic, spec)
        if (other.type, other.stamp) != (spec.type, spec.stamp):
            raise ConfigError(
                f"{where}: topic {spec.topic!r} has two types or stamps: "
                f"{other.type} ({other.stamp}) and {spec.type} ({spec.stamp})"
            )
    clocks = [s.name for s in fields.values() if s.role == "clock"]
    clocks += [s.name for s in fields.values() if s.role == "effector"]
    clock = str(raw.get("clock") or (clocks[0] if clocks else ""))
    if clock and clock not in fields:
        raise ConfigError(f"{where}: clock {clock!r} is not a field of this map")
    if not clock:
        raise ConfigError(
            f"{where}: no clock: give a field the role clock or effector, or name one as 'clock'"
        )
    columns = {key: _texts(raw.get(key), f"{where}: {key}") for key in ("state", "action")}
    for key, names in columns.items():
        for column in names:
            if column.removesuffix(AT_START) not in fields:
                raise ConfigError(f"{where}: {key} names {column!r}, which is not a field")
    gripper = raw.get("gripper")
    max_gap_s = _number(raw.get("max_gap_s", MAX_GAP_S), f"{where}: max_gap_s")
    if not max_gap_s > 0:
        raise ConfigError(f"{where}: max_gap_s must be positive, found {raw['max_gap_s']!r}")
    command = raw.get("command") or {}
    if not isinstance(command, Mapping):
        raise ConfigError(f"{where}: command must be a mapping, found {command!r}")
    try:
        json.dumps(command)
    except (TypeError, ValueError) as err:
        raise ConfigError(f"{where}: command must be texts and numbers: {err}") from err
    return TopicMap(
        fields=fields,
        clock=clock,
        gripper=None if gripper is None else _gripper_spec(gripper, fields, where),
        state=columns["state"],
        action=columns["action"],
        max_gap_s=max_gap_s,
        command=dict(command),
    )


def read_topic_map(path: Path | str) -> TopicMap:
    """Read a topic map from a YAML file.

    Args:
        path: a file like `config/topics.yaml`.

    Raises:
        ConfigError: if the file is missing, is not YAML or is no topic map.
    """
    return topic_map_from_json(read_yaml(Path(path), "topic map"), str(path))
