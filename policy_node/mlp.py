"""The policy of behaviour cloning: an MLP in NumPy, trained by `policy_node.train`."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors.numpy
from safetensors import SafetensorError

from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats
from policy_node.mlp_card import MlpCard, mlp_card_from_json
from policy_node.policy import (
    CARD,
    Command,
    Values,
    check_observed,
    read_card,
    read_file,
    write_policy,
)

Weights = npt.NDArray[np.float32]

WEIGHTS = "policy.safetensors"
_PARTS = ("weight", "bias")


class MlpPolicy:
    """Answers each observation with one command; the same bits for the same input, always.

    Observations are standardised in float64, as for training; the float32 weights are multiplied
    in float64 in a fixed order, so that neither threads nor the BLAS at hand change a bit.

    Args:
        card: what it is.
        weights: (out, in) weights and (out,) biases of each layer, as torch has them.
        obs_mean: (D,) mean of each column, 0 in a one-hot.
        obs_std: (D,) standard deviation of each column, 1 in a one-hot.
        where: its source, for messages.

    Attributes:
        card: what it is.
        arrays: weights and normalisation by name, as saved. Read only.

    Raises:
        PolicyError: if the card and the arrays do not fit together.
    """

    def __init__(
        self,
        card: MlpCard,
        weights: Sequence[tuple[Weights, Weights]],
        obs_mean: Floats,
        obs_std: Floats,
        where: str = "policy",
    ) -> None:
        self.card = card
        self._observation, self._action = card.observation, card.action
        shapes: dict[str, tuple[int, ...]] = {
            "obs_mean": (self._observation.width,),
            "obs_std": (self._observation.width,),
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
        self.reset()

    @property
    def observed(self) -> tuple[str, ...]:
        """Fields of the topic map that `observe` needs."""
        return self._observation.fields

    @property
    def commanded(self) -> tuple[str, ...]:
        """Command fields that `act` answers with."""
        return self._action.fields

    def check(self, topic_map: TopicMap) -> None:
        """Refuse to drive a robot whose topics mean something else than those of the training.

        Topics may have other names. Fields, widths, units, phases and the gripper's meaning may
        not differ.

        Raises:
            PolicyError: naming what was found and what was expected.
        """
        where = f"policy {self.card.id}"
        self._observation.check(topic_map, where)
        self._action.check(topic_map, where)

    def reset(self) -> None:
        """Forget the first values of the episode and the last observation."""
        self._start: dict[str, Floats] | None = None
        self._row: Floats | None = None

    def observe(self, values: Values) -> None:
        """Take the observation of the next step; see `Policy.observe`."""
        spec = self._observation
        check_observed(values, spec.fields)
        start = self._start
        if start is None:
            # Copies: the caller may fill the same arrays again in the next step.
            start = {k: np.array(values[k], dtype=np.float64) for k in spec.start_fields}
        self._row = spec.from_step(values, start)
        self._start = start

    def act(self) -> Command:
        """The command that answers the last observation; see `Policy.act`."""
        if self._row is None:
            raise PolicyError(f"policy {self.card.id}: nothing was observed, no command")
        return self._action.command(self.output(self._row))

    def output(self, obs: npt.ArrayLike) -> Floats:
        """What the network answers, in [-1, 1].

        Args:
            obs: (D,) observation.

        Returns:
            (A,) outputs.

        Raises:
            PolicyError: if the observation has another shape, or the answer is not finite.
        """
        row = np.asarray(obs, dtype=np.float64)
        if row.shape != self._obs_mean.shape:
            raise PolicyError(
                f"policy {self.card.id}: an observation has shape {self._obs_mean.shape}, "
                f"found {row.shape}"
            )
        # Through float32, because that is what it was trained on.
        x = standardise(row, self._obs_mean, self._obs_std).astype(np.float64)
        last = len(self._layers) - 1
        for k, (columns, bias) in enumerate(self._layers):
            x = np.einsum("i,ij->j", x, columns) + bias
            x = np.tanh(x) if k == last else np.maximum(x, 0.0)
        if not np.isfinite(x).all():
            raise PolicyError(f"policy {self.card.id}: no finite answer to the observation {row}")
        return x

    def save(self, folder: Path | str) -> Path:
        """Write weights and card; see `Policy.save`."""
        data = safetensors.numpy.save(
            {name: np.ascontiguousarray(array) for name, array in self.arrays.items()}
        )
        card = {"weights_sha256": hashlib.sha256(data).hexdigest(), **self.card.to_json()}
        return write_policy(folder, card, {WEIGHTS: data})

    @classmethod
    def load(cls, folder: Path | str) -> MlpPolicy:
        """Read what `save` wrote, of format 1 and 2.

        Raises:
            PolicyError: if a file is missing, damaged, of another format or of another policy;
                the message names file, found and expected.
        """
        folder = Path(folder)
        card_file, weights_file = folder / CARD, folder / WEIGHTS
        raw = read_card(folder)
        card = mlp_card_from_json(raw, str(card_file))
        if "weights_sha256" not in raw:
            raise PolicyError(f"{card_file}: the key 'weights_sha256' is missing")
        data = read_file(weights_file)
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


def standardise(obs: Floats, mean: Floats, std: Floats) -> Weights:
    """Observations as the network takes them; alike in training and when driving.

    Args:
        obs: (..., D) float64.
        mean: (D,).
        std: (D,).

    Returns:
        (..., D) float32. The difference is taken in float64: positions in m differ late.
    """
    scaled: Weights = ((obs - mean) / std).astype(np.float32)
    return scaled


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
