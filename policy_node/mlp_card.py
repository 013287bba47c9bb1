"""The card of an MLP: its observations, its commands and its training, as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any

from curation_ros.core.errors import ConfigError, PolicyError
from policy_node.action import ActionSpec, action_from_json
from policy_node.commands import GripperCommand, ScaledCommand
from policy_node.observation import (
    ObservationSpec,
    observation_from_columns,
    observation_from_json,
)
from policy_node.policy import FORMAT, PolicyCard
from policy_node.settings import TrainingSettings
from policy_node.variants import settings_from

#: What JSON must hold for each key, apart from texts, observation, action and settings.
_KINDS: dict[str, tuple[type, ...]] = {
    "seed": (int,),
    "seconds": (int, float),
    "columns": (list,),
    "episodes": (list,),
    "curve": (list,),
    "clipped": (dict,),
    "versions": (dict,),
}
_NESTED = ("observation", "action", "settings")


@dataclass(frozen=True)
class MlpCard(PolicyCard):
    """What an MLP was trained on, and how.

    Attributes:
        variant: name of the choice of observation and action.
        observation: its columns.
        action: its command fields.
        settings: of the training.
        clipped: command field -> share of its values in the training set that were beyond the
            scale.
        curve: (step, mean loss of the batches since the entry before).
        seconds: duration of the training.
    """

    variant: str
    observation: ObservationSpec
    action: ActionSpec
    settings: TrainingSettings
    clipped: Mapping[str, float]
    curve: tuple[tuple[int, float], ...]
    seconds: float

    @property
    def widths(self) -> tuple[int, ...]:
        """Widths of the layers, from the observation to the output."""
        return (self.observation.width, *self.settings.hidden, self.action.width)

    def to_json(self) -> dict[str, Any]:
        """Plain data that `mlp_card_from_json` reads back to an equal card."""
        raw = {
            **super().to_json(),
            "variant": self.variant,
            "observation": self.observation.to_json(),
            "columns": list(self.observation.columns),
            "action": self.action.to_json(),
            "settings": asdict(self.settings),
            "clipped": dict(self.clipped),
            "curve": self.curve,
            "seconds": self.seconds,
        }
        plain: dict[str, Any] = json.loads(json.dumps(raw, allow_nan=False))
        return plain


def mlp_card_from_json(raw: Mapping[str, Any], where: str) -> MlpCard:
    """Check plain data, of any format, and make a card of it; unknown keys are ignored.

    Args:
        raw: as `read_card` gives it.
        where: its source, for messages.

    Raises:
        PolicyError: naming the source, the key, what was found and what was expected.
    """
    if raw.get("format", FORMAT) == 1:
        return _from_format_1(raw, where)
    names = [f.name for f in fields(MlpCard)]
    values = {key: _checked(raw, key, where) for key in (*names, "columns")}
    observation = observation_from_json(raw["observation"], where)
    columns = values.pop("columns")
    if list(observation.columns) != columns:
        pairs = zip(columns, observation.columns, strict=False)
        odd = next(((a, b) for a, b in pairs if a != b), (len(columns), observation.width))
        raise PolicyError(f"{where}: columns: found {odd[0]!r}, expected {odd[1]!r}")
    try:
        settings = settings_from(raw["settings"], f"{where}: settings")
    except ConfigError as err:
        raise PolicyError(str(err)) from err
    values |= {
        "observation": observation,
        "action": action_from_json(raw["action"], where),
        "settings": settings,
    }
    return MlpCard(**_plain_values(values, where))


def _from_format_1(raw: Mapping[str, Any], where: str) -> MlpCard:
    """A card of LIBERO's MLPs before there were others: columns in m, one scale, two commands."""
    names = [f.name for f in fields(PolicyCard)]
    own = ("variant", "columns", "phase_labels", "widths", "curve", "seconds")
    numbers = ("action_scale", "std_floor", "lr", "weight_decay", "start_jitter_m")
    kinds = {
        **dict.fromkeys(numbers, (int, float)),
        "clipped_fraction": (int, float),
        **dict.fromkeys(("steps", "batch_size"), (int,)),
        **dict.fromkeys(("phase_labels", "widths"), (list,)),
    }
    keys = (*names, *own, *kinds)
    values = {key: _checked(raw, key, where, kinds.get(key)) for key in keys}
    observation = observation_from_columns(values["columns"], "m", where)
    phases = [list(field.labels) for field in observation.observed if field.labels]
    if phases != [values["phase_labels"]]:
        raise PolicyError(
            f"{where}: 'phase_labels' are {values['phase_labels']!r:.60}, the columns have "
            f"{phases[0] if phases else 'none'}"
        )
    widths = values["widths"]
    if len(widths) < 2 or (widths[0], widths[-1]) != (observation.width, 4):
        raise PolicyError(
            f"{where}: 'widths' are {widths}, expected {observation.width} first and 4 last"
        )
    settings = {key: raw[key] for key in ("steps", "batch_size", *numbers[1:])}
    scale = (float(values["action_scale"]),) * 3
    try:
        action = ActionSpec(
            (ScaledCommand("twist", "1", scale, (0.0,) * 3), GripperCommand("gripper"))
        )
        trained = settings_from({**settings, "hidden": widths[1:-1]}, where)
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err
    except ConfigError as err:
        raise PolicyError(str(err)) from err
    common = {key: values[key] for key in (*names, "variant", "curve", "seconds")}
    common |= {
        "observation": observation,
        "action": action,
        "settings": trained,
        "clipped": {"twist": values["clipped_fraction"]},
    }
    return MlpCard(**_plain_values(common, where))


def _checked(
    raw: Mapping[str, Any], key: str, where: str, kind: tuple[type, ...] | None = None
) -> Any:
    """The value of a key, of the kind that JSON must hold."""
    if key not in raw:
        raise PolicyError(f"{where}: the key {key!r} is missing")
    kind = kind or _KINDS.get(key, (str,))
    if key not in _NESTED and (not isinstance(raw[key], kind) or isinstance(raw[key], bool)):
        raise PolicyError(
            f"{where}: {key!r} is {raw[key]!r:.60}, "
            f"expected {' or '.join(k.__name__ for k in kind)}"
        )
    if key in ("columns", "phase_labels", "widths"):
        item = int if key == "widths" else str
        if not all(isinstance(value, item) for value in raw[key]):
            raise PolicyError(f"{where}: {key!r} must be a list of {item.__name__}")
    return raw[key]


def _plain_values(values: dict[str, Any], where: str) -> dict[str, Any]:
    """Check the lists and mappings that cards of any format have."""
    keys = {"id", "span", "n_steps"}
    if not all(isinstance(e, dict) and keys <= set(e) for e in values["episodes"]):
        raise PolicyError(f"{where}: 'episodes' must be a list of objects with id, span, n_steps")
    if not all(isinstance(point, list) and len(point) == 2 for point in values["curve"]):
        raise PolicyError(f"{where}: 'curve' must be a list of [step, loss]")
    if not all(isinstance(share, int | float) for share in values["clipped"].values()):
        raise PolicyError(f"{where}: 'clipped' must be a mapping of fields to shares")
    curve = tuple((int(step), float(loss)) for step, loss in values["curve"])
    return {**values, "episodes": tuple(values["episodes"]), "curve": curve}
