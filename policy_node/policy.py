"""A trained policy: NumPy on safetensors, with a card that says what it was trained on."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors.numpy
from safetensors import SafetensorError

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats
from policy_node.action import N_OUTPUTS, ActionSpec
from policy_node.observation import ObservationSpec

Weights = npt.NDArray[np.float32]

CARD = "card.json"
WEIGHTS = "policy.safetensors"
FORMAT = 1

# What JSON must hold for each key of a card beside the text ones.
_NUMBERS = (
    "action_scale",
    "std_floor",
    "lr",
    "weight_decay",
    "start_jitter_m",
    "clipped_fraction",
    "seconds",
)
_COUNTS = ("seed", "steps", "batch_size")
_LISTS = ("columns", "phase_labels", "widths", "episodes", "curve")


@dataclass(frozen=True)
class Card:
    """What a policy is and where it comes from; written as JSON beside the weights.

    Attributes:
        id: UUID, version 7.
        created_at: UTC, ISO 8601.
        variant, columns, phase_labels: of its observations.
        action_scale: command that is an output of 1.
        widths: of the layers, from the observation to the output.
        topic_map_hash: of the episodes that it was trained on.
        selection_name, selection_hash: manifest of these episodes; empty without one.
        episodes: `id`, `span` (nanoseconds from the start stamp, or null for all) and `n_steps`
            of each, sorted by id.
        seed, steps, batch_size, lr, weight_decay, std_floor, start_jitter_m: of the training.
        clipped_fraction: of the twist values of the training set, how many were beyond the scale.
        curve: [step, mean loss of the batches since the entry before].
        seconds: that the training took.
        versions: of python, numpy, torch and curation_ros.
    """

    id: str
    created_at: str
    variant: str
    columns: tuple[str, ...]
    phase_labels: tuple[str, ...]
    action_scale: float
    widths: tuple[int, ...]
    topic_map_hash: str
    selection_name: str
    selection_hash: str
    episodes: tuple[Mapping[str, Any], ...]
    seed: int
    steps: int
    batch_size: int
    lr: float
    weight_decay: float
    std_floor: float
    start_jitter_m: float
    clipped_fraction: float
    curve: tuple[tuple[int, float], ...]
    seconds: float
    versions: Mapping[str, str]

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal card."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self), allow_nan=False))
        return plain

    @staticmethod
    def from_json(raw: object, where: str) -> Card:
        """Check plain data and make a card of it; keys that it does not know are left alone.

        Raises:
            PolicyError: naming the source, the key, what was found and what was expected.
        """
        if not isinstance(raw, Mapping):
            raise PolicyError(f"{where}: expected a JSON object, found {raw!r:.60}")
        values: dict[str, Any] = {}
        for spec in fields(Card):
            key = spec.name
            if key not in raw:
                raise PolicyError(f"{where}: the key {key!r} is missing")
            kind: tuple[type, ...] = (str,)
            if key in _NUMBERS:
                kind = (int, float)
            elif key in _COUNTS:
                kind = (int,)
            elif key in _LISTS:
                kind = (list,)
            elif key == "versions":
                kind = (dict,)
            if not isinstance(raw[key], kind) or isinstance(raw[key], bool):
                raise PolicyError(
                    f"{where}: {key!r} is {raw[key]!r:.60}, "
                    f"expected {' or '.join(k.__name__ for k in kind)}"
                )
            values[key] = tuple(raw[key]) if key in _LISTS else raw[key]
        for key, item in (("columns", str), ("phase_labels", str), ("widths", int)):
            if not all(isinstance(value, item) for value in values[key]):
                raise PolicyError(f"{where}: {key!r} must be a list of {item.__name__}")
        keys = {"id", "span", "n_steps"}
        if not all(isinstance(e, dict) and keys <= set(e) for e in values["episodes"]):
            raise PolicyError(
                f"{where}: 'episodes' must be a list of objects with id, span, n_steps"
            )
        if not all(isinstance(point, list) and len(point) == 2 for point in values["curve"]):
            raise PolicyError(f"{where}: 'curve' must be a list of [step, loss]")
        values["curve"] = tuple((int(step), float(loss)) for step, loss in values["curve"])
        return Card(**values)


class Policy:
    """Turns an observation into a command; the same bits for the same input, always.

    Observations are standardised in float64, as for training; the float32 weights are multiplied
    in float64 in a fixed order, so that neither threads nor the BLAS at hand change a bit.

    Args:
        card: what it is.
        weights: (out, in) weights and (out,) biases of each layer, as torch has them.
        obs_mean: (D,) mean of each column, 0 in the one-hot.
        obs_std: (D,) standard deviation of each column, 1 in the one-hot.
        where: its source, for messages.

    Attributes:
        card: what it is.
        spec: its observations.
        action: its commands.
        arrays: weights and normalisation by name, as saved. Read only.

    Raises:
        PolicyError: if the card and the arrays do not fit together, or this version has other
            observations under the same name.
    """

    def __init__(
        self,
        card: Card,
        weights: Sequence[tuple[Weights, Weights]],
        obs_mean: Floats,
        obs_std: Floats,
        where: str = "policy",
    ) -> None:
        self.card = card
        self.spec = _spec_of(card, where)
        self.action = ActionSpec(card.action_scale)
        shapes: dict[str, tuple[int, ...]] = {
            "obs_mean": (self.spec.width,),
            "obs_std": (self.spec.width,),
        }
        arrays: dict[str, npt.NDArray[Any]] = {"obs_mean": obs_mean, "obs_std": obs_std}
        for k, (rows, bias) in enumerate(weights):
            arrays[f"layer{k}.weight"], arrays[f"layer{k}.bias"] = rows, bias
        for k, (n_in, n_out) in enumerate(itertools.pairwise(card.widths)):
            shapes[f"layer{k}.weight"], shapes[f"layer{k}.bias"] = (n_out, n_in), (n_out,)
        _check_arrays(arrays, shapes, where)
        if not (obs_std > 0.0).all():
            raise PolicyError(f"{where}: obs_std has a value that is not positive")
        self.arrays = arrays
        self._obs_mean, self._obs_std = obs_mean.copy(), obs_std.copy()
        self._layers = [
            (np.ascontiguousarray(rows.T, dtype=np.float64), bias.astype(np.float64))
            for rows, bias in weights
        ]

    @property
    def id(self) -> str:
        """UUID of the policy."""
        return self.card.id

    def act(self, obs: npt.ArrayLike) -> tuple[Floats, float]:
        """The command that answers an observation.

        Args:
            obs: (D,) as `spec` makes it.

        Returns:
            (3,) twist, unitless in [-1, 1], and the gripper: -1 opens, +1 closes, 0 holds.

        Raises:
            PolicyError: if the observation has another shape or is not finite.
        """
        return self.action.command(self.output(obs))

    def output(self, obs: npt.ArrayLike) -> Floats:
        """(4,) what the network says, in [-1, 1]; raises as `act` does."""
        row = np.asarray(obs, dtype=np.float64)
        if row.shape != self._obs_mean.shape:
            raise PolicyError(
                f"policy {self.id}: an observation has shape {self._obs_mean.shape}, "
                f"found {row.shape}"
            )
        # Through float32, because that is what it was trained on.
        x = standardise(row, self._obs_mean, self._obs_std).astype(np.float64)
        last = len(self._layers) - 1
        for k, (columns, bias) in enumerate(self._layers):
            x = np.einsum("i,ij->j", x, columns) + bias
            x = np.tanh(x) if k == last else np.maximum(x, 0.0)
        if not np.isfinite(x).all():
            raise PolicyError(f"policy {self.id}: no finite answer to the observation {row}")
        return x

    def check(self, topic_map: TopicMap) -> None:
        """Refuse to drive a robot whose topics mean something else than those of the training.

        Topics may have other names; fields, widths, units, phases and the gripper's sign may not
        differ.

        Raises:
            PolicyError: naming what was found and what was expected.
        """
        where = f"policy {self.id}"
        self.spec.check(topic_map, where)
        self.action.check(topic_map, where)

    def save(self, folder: Path | str) -> Path:
        """Write weights and card; the folder appears whole or not at all.

        Args:
            folder: must not exist; its parents are made.

        Returns:
            The folder.

        Raises:
            PolicyError: if it exists or cannot be written.
        """
        folder = Path(folder)
        partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
        data = safetensors.numpy.save(
            {name: np.ascontiguousarray(array) for name, array in self.arrays.items()}
        )
        card = {
            "format": FORMAT,
            "weights_sha256": hashlib.sha256(data).hexdigest(),
            **self.card.to_json(),
        }
        if folder.exists():
            raise PolicyError(f"policy {folder} exists")
        try:
            partial.mkdir(parents=True)
            (partial / WEIGHTS).write_bytes(data)
            (partial / CARD).write_text(json.dumps(card, indent=1, allow_nan=False) + "\n")
            partial.rename(folder)
        except OSError as err:
            shutil.rmtree(partial, ignore_errors=True)
            raise PolicyError(f"policy {folder}: {err.strerror}") from err
        return folder

    @classmethod
    def load(cls, folder: Path | str) -> Policy:
        """Read what `save` wrote.

        Raises:
            PolicyError: if a file is missing, damaged, of another format or of another policy, or
                made for other observations; the message names file, found and expected.
        """
        folder = Path(folder)
        card_file, weights_file = folder / CARD, folder / WEIGHTS
        try:
            raw = json.loads(_read(card_file))
        except ValueError as err:
            raise PolicyError(f"{card_file} is not JSON: {str(err).splitlines()[0]}") from err
        if isinstance(raw, dict) and raw.get("format", FORMAT) != FORMAT:
            raise PolicyError(f"{card_file}: 'format' is {raw['format']!r}, expected {FORMAT}")
        card = Card.from_json(raw, str(card_file))
        for key in ("format", "weights_sha256"):
            if key not in raw:
                raise PolicyError(f"{card_file}: the key {key!r} is missing")
        _spec_of(card, str(card_file))
        data = _read(weights_file)
        digest, expected = hashlib.sha256(data).hexdigest(), raw["weights_sha256"]
        if digest != expected:
            raise PolicyError(
                f"{weights_file}: SHA-256 {digest[:12]}, expected {str(expected)[:12]} as in "
                f"{CARD}: it is damaged or of another policy"
            )
        try:
            arrays = safetensors.numpy.load(data)
        except (SafetensorError, ValueError) as err:
            text = str(err).splitlines()[0]
            raise PolicyError(f"{weights_file} is not a safetensors file: {text}") from err
        names = [f"layer{k}" for k in range(len(card.widths) - 1)]
        wanted = {"obs_mean", "obs_std", *(f"{n}.{part}" for n in names for part in _PARTS)}
        if set(arrays) != wanted:
            odd = sorted(set(arrays) ^ wanted)[0]
            state = "not expected" if odd in arrays else "missing"
            raise PolicyError(f"{weights_file}: array {odd!r} is {state}")
        weights = [(arrays[f"{n}.weight"], arrays[f"{n}.bias"]) for n in names]
        return cls(card, weights, arrays["obs_mean"], arrays["obs_std"], str(weights_file))


_PARTS = ("weight", "bias")


def standardise(obs: Floats, mean: Floats, std: Floats) -> Weights:
    """Observations as the network takes them; the same in training and in the loop.

    Args:
        obs: (..., D) float64.
        mean: (D,).
        std: (D,).

    Returns:
        (..., D) float32: the difference is taken in float64, for positions in m differ late.
    """
    scaled: Weights = ((obs - mean) / std).astype(np.float32)
    return scaled


def _spec_of(card: Card, where: str) -> ObservationSpec:
    """The observations of a card, if this version of the program has the same ones."""
    try:
        spec = ObservationSpec(card.variant, card.phase_labels)
        ActionSpec(card.action_scale)
    except PolicyError as err:
        raise PolicyError(f"{where}: {err}") from err
    if card.columns != spec.columns:
        pairs = zip(card.columns, spec.columns, strict=False)
        odd = [f"found {a!r}, expected {b!r}" for a, b in pairs if a != b]
        what = odd[0] if odd else f"found {len(card.columns)}, expected {spec.width}"
        raise PolicyError(f"{where}: columns of variant {card.variant!r}: {what}")
    ends = (card.widths[0], card.widths[-1]) if len(card.widths) > 1 else card.widths
    if ends != (spec.width, N_OUTPUTS):
        raise PolicyError(
            f"{where}: 'widths' are {list(card.widths)}, expected {spec.width} first and "
            f"{N_OUTPUTS} last"
        )
    return spec


def _check_arrays(
    arrays: Mapping[str, npt.NDArray[Any]], shapes: Mapping[str, tuple[int, ...]], where: str
) -> None:
    if set(arrays) != set(shapes):
        raise PolicyError(f"{where}: {len(arrays)} arrays, expected {len(shapes)}")
    for name, shape in shapes.items():
        array = arrays[name]
        dtype = np.float64 if name.startswith("obs_") else np.float32
        if array.shape != shape or array.dtype != dtype:
            raise PolicyError(
                f"{where}: array {name!r} is {array.dtype} {array.shape}, "
                f"expected {np.dtype(dtype)} {shape}"
            )
        if not np.isfinite(array).all():
            raise PolicyError(f"{where}: array {name!r} has values that are not finite")


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as err:
        raise PolicyError(f"{file}: {err.strerror}") from err
