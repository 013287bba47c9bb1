"""Length control: the one home of what is done about episodes of different length.

Defective demonstrations often run to the time limit. A scorer that averages over the whole
episode then measures length; truncating all to one prefix takes that away (seed paper, III-D).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode

#: mode -> what it does. The only list; a phase-normalised mode will stand here too.
MODES: dict[str, str] = {
    "none": "whole episodes",
    "shortest-reference": "the prefix as long as the shortest reference episode (the paper's T)",
    "fixed": "the prefix of `value` steps",
    "percentile": "the prefix as long as the `value`-th percentile of reference lengths",
}


class LengthControl:
    """Turns an episode into the one that scorers see; an episode shorter than that stays whole.

    T never comes from labels or from the episodes that are judged: only from a trusted reference
    or from the configuration.

    Attributes:
        steps_: T after `fit`, None for whole episodes.
    """

    def __init__(self, mode: str = "none", value: float | None = None) -> None:
        """Choose a mode.

        Args:
            mode: one of MODES.
            value: for `fixed` the number of steps, for `percentile` a number from 0 to 100.

        Raises:
            ConfigError: if the mode does not exist, or `value` does not suit it.
        """
        if mode not in MODES:
            raise ConfigError(f"length control {mode!r} is none of {', '.join(MODES)}")
        if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise ConfigError(f"length control {mode!r}: value {value!r} is no number")
        if mode in ("none", "shortest-reference") and value is not None:
            raise ConfigError(f"length control {mode!r} takes no value, found {value!r}")
        if mode == "fixed" and (value is None or value < 2 or not float(value).is_integer()):
            raise ConfigError(f"length control 'fixed' takes steps, at least 2, found {value!r}")
        if mode == "percentile" and (value is None or not 0 <= value <= 100):
            raise ConfigError(f"length control 'percentile' takes 0 to 100, found {value!r}")
        self.mode = mode
        self.value = value
        if mode == "none":
            self.steps_: int | None = None
        elif mode == "fixed":
            self.steps_ = int(value or 0)

    @property
    def needs_reference(self) -> bool:
        """Whether `fit` must see reference episodes."""
        return self.mode in ("shortest-reference", "percentile")

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn T from the lengths of trusted reference episodes.

        Raises:
            EpisodeError: if the mode needs a reference and there is none, or one is too short.
        """
        if not self.needs_reference:
            return self
        if not episodes:
            raise EpisodeError(f"length control {self.mode!r}: no reference")
        lengths = [len(e) for e in episodes]
        shortest = int(np.argmin(lengths))
        if lengths[shortest] < 2:
            raise EpisodeError(
                f"reference episode {episodes[shortest].id} has {lengths[shortest]} steps"
            )
        share = 0.0 if self.mode == "shortest-reference" else float(self.value or 0.0)
        self.steps_ = int(np.percentile(lengths, share))
        return self

    def apply(self, episode: Episode) -> Episode:
        """The part of an episode that scorers see; id, name, window and findings stay.

        Raises:
            NotFittedError: if the mode needs a reference and has seen none.
        """
        if not hasattr(self, "steps_"):
            raise NotFittedError(f"length control {self.mode!r} needs a reference: fit it first")
        if self.steps_ is None or len(episode) <= self.steps_:
            return episode
        return episode.steps(self.steps_)

    def describe(self) -> dict[str, Any]:
        """Configuration and fitted state as plain data."""
        return {
            "mode": self.mode,
            "value": self.value,
            "steps": getattr(self, "steps_", None),
        }
