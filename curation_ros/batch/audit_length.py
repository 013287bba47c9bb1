"""The length control of an audit, which knows one mode more than the curator: with labels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.evidence.length_control import MODES, LengthControl

#: The paper's mode. It uses labels, so only audits have it.
SHORTEST_SUCCESS = "shortest-success"
#: Mode -> what an episode is cut to.
LENGTHS: dict[str, str] = {
    **MODES,
    "percentile": "the prefix as long as the `value`-th percentile of the lengths in the dataset",
    SHORTEST_SUCCESS: "the prefix as long as the shortest success: the paper's T, uses labels",
}
_NEEDS = {
    "phase-normalised": "phases",
    "shortest-reference": "reference",
    "percentile": "dataset",
    SHORTEST_SUCCESS: "labels",
}
#: Mode and value without a reference to learn T from.
_LABEL_FREE = ("percentile", 5.0)
_LEAST_STEPS = 2


@dataclass(frozen=True)
class AuditLength:
    """A length control as chosen for an audit.

    Attributes:
        mode: one of LENGTHS.
        value: its value, for modes that take one.
        control: the control that scorers are fitted with.
    """

    mode: str
    value: float | None
    control: LengthControl

    @property
    def needs(self) -> str:
        """What somebody must have for it."""
        return _NEEDS.get(self.mode, "nothing")


def choose_length(
    mode: str,
    value: float | None,
    *,
    lengths: Sequence[int],
    success_lengths: Sequence[int],
    has_reference: bool,
) -> AuditLength:
    """Choose the length control of an audit.

    Args:
        mode: one of LENGTHS. If it is empty, the control is `shortest-reference` with a
            reference and a percentile of the lengths without one.
        value: its value, for modes that take one.
        lengths: number of steps of every episode of the dataset.
        success_lengths: the same of the episodes that succeeded; these are labels.
        has_reference: whether there is a reference to learn from.

    Raises:
        ConfigError: if the mode does not exist, `value` does not fit it, or what it needs is
            missing.
    """
    if not mode:
        mode, value = ("shortest-reference", None) if has_reference else _LABEL_FREE
    if mode == SHORTEST_SUCCESS:
        if value is not None:
            raise ConfigError(f"length control {mode!r} takes no value, found {value!r}")
        if not success_lengths:
            raise ConfigError(f"length control {mode!r}: no episode of the dataset succeeded")
        return AuditLength(mode, value, _fixed(min(success_lengths)))
    control = LengthControl(mode, value)
    if mode == "percentile":
        steps = int(np.percentile(lengths, float(value or 0.0)))
        return AuditLength(mode, value, _fixed(steps))
    if control.needs_reference and not has_reference:
        raise ConfigError(f"length control {mode!r} needs --reference, which was not given")
    return AuditLength(mode, value, control)


def _fixed(steps: int) -> LengthControl:
    return LengthControl("fixed", max(_LEAST_STEPS, steps))
