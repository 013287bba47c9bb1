"""Length control: the one module that makes episodes of different length comparable.

Defective demonstrations often run to the time limit. A scorer that averages over the complete
episode then measures length. Cutting all episodes to one prefix removes that (seed paper, III-D).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode

#: Mode -> what it does. The only list.
MODES: dict[str, str] = {
    "none": "whole episodes",
    "shortest-reference": "the prefix as long as the shortest reference episode (the paper's T)",
    "fixed": "the prefix of `value` steps",
    "percentile": "the prefix as long as the `value`-th percentile of the lengths of the "
    "reference, or without one of the unlabelled dataset",
    "phase-normalised": "`value` steps of every phase (50 by default)",
}
PHASE_STEPS = 50
#: Shorter episodes have no motion: no scorer scores them, and they must not set T.
_LEAST_STEPS = 2


class LengthControl:
    """Cuts an episode to the T steps that scorers see. A shorter episode stays whole.

    T never comes from labels. It comes from the lengths of a trusted reference, from those of the
    whole unlabelled dataset, or from the configuration.

    Attributes:
        steps_: T after `fit`; None for whole episodes; steps per phase with `phase-normalised`.
    """

    def __init__(self, mode: str = "none", value: float | None = None) -> None:
        """Choose a mode.

        Args:
            mode: one of MODES.
            value: for `fixed` the number of steps, for `phase-normalised` the steps per phase,
                for `percentile` a number from 0 to 100.

        Raises:
            ConfigError: if the mode does not exist, or `value` does not fit it.
        """
        if mode not in MODES:
            raise ConfigError(f"length control {mode!r} is none of {', '.join(MODES)}")
        if value is not None and (isinstance(value, bool) or not isinstance(value, (int, float))):
            raise ConfigError(f"length control {mode!r}: value {value!r} is no number")
        if mode in ("none", "shortest-reference") and value is not None:
            raise ConfigError(f"length control {mode!r} takes no value, found {value!r}")
        if mode == "percentile" and (value is None or not 0 <= value <= 100):
            raise ConfigError(f"length control 'percentile' takes 0 to 100, found {value!r}")
        self.mode = mode
        self.value = value
        if mode == "none":
            self.steps_: int | None = None
        elif mode in ("fixed", "phase-normalised"):
            steps = PHASE_STEPS if value is None and mode == "phase-normalised" else value
            if steps is None or steps < _LEAST_STEPS or not float(steps).is_integer():
                raise ConfigError(
                    f"length control {mode!r} takes steps, at least {_LEAST_STEPS}, "
                    f"found {value!r}"
                )
            self.steps_ = int(steps)

    @property
    def needs_reference(self) -> bool:
        """Whether T must be learned, with `fit` or `fit_lengths`."""
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
        for episode in episodes:
            if len(episode) < _LEAST_STEPS:
                raise EpisodeError(f"reference episode {episode.id} has {len(episode)} steps")
        return self.fit_lengths([len(e) for e in episodes])

    def fit_lengths(self, lengths: Sequence[int]) -> Self:
        """Learn T from lengths alone: of a reference, or of all episodes of a dataset.

        Lengths below two steps are left out, as such an episode is never scored.

        Args:
            lengths: steps of each episode, in any order.

        Raises:
            EpisodeError: if the mode learns T and no length is left.
        """
        if not self.needs_reference:
            return self
        usable = [n for n in lengths if n >= _LEAST_STEPS]
        if not usable:
            raise EpisodeError(
                f"length control {self.mode!r}: none of {len(lengths)} episodes has "
                f"{_LEAST_STEPS} steps"
            )
        share = 0.0 if self.mode == "shortest-reference" else float(self.value or 0.0)
        self.steps_ = int(np.percentile(usable, share))
        return self

    def apply(self, episode: Episode) -> Episode:
        """The part of an episode that scorers see; id, name, window and findings stay.

        Raises:
            NotFittedError: if the mode learns T and was not fitted.
            EpisodeError: with `phase-normalised`, if the episode has no phases.
        """
        if not hasattr(self, "steps_"):
            raise NotFittedError(f"length control {self.mode!r} needs a reference: fit it first")
        if self.steps_ is None:
            return episode
        if self.mode == "phase-normalised":
            return _phase_normalised(episode, self.steps_)
        return episode if len(episode) <= self.steps_ else episode.steps(self.steps_)

    def describe(self) -> dict[str, Any]:
        """Configuration and fitted state as plain data."""
        return {
            "mode": self.mode,
            "value": self.value,
            "steps": getattr(self, "steps_", None),
        }


def _phase_normalised(episode: Episode, n_steps: int) -> Episode:
    """An episode of `n_steps` steps of each of its phases, in the order of the topic map.

    Each step is the nearest step of the recording; only stamps are interpolated. All visits of a
    phase count as one. Steps of unknown phase are left out, and so is a phase that the episode
    lacks. Stamps are exact to the nanosecond unless phases recur.
    """
    phase = episode.phase
    if phase is None:
        raise EpisodeError(
            f"episode {episode.id}: length control 'phase-normalised' needs phases, and the topic "
            "map has no field with role phase"
        )
    if len(episode) < _LEAST_STEPS:
        return episode
    steps, stamps = [], []
    for label in range(len(episode.phase_labels)):
        (found,) = np.nonzero(phase == label)
        if not len(found):
            continue
        position = np.linspace(0, len(found) - 1, n_steps)
        steps.append(found[np.rint(position).astype(np.int64)])
        # Relative to the start of the phase, as float64 holds an epoch to some 100 ns only.
        first = episode.stamps_ns[found[0]]
        since = episode.stamps_ns[found] - first
        stamps.append(first + np.rint(np.interp(position, range(len(found)), since)).astype(int))
    if not steps:
        raise EpisodeError(
            f"episode {episode.id}: length control 'phase-normalised' needs phases, and none of "
            f"its {len(episode)} steps has a known one"
        )
    index = np.concatenate(steps)
    # Phases that recur or have one step would make stamps repeat or go back.
    count = np.arange(len(index))
    stamps_ns = np.maximum.accumulate(np.concatenate(stamps) - count) + count
    stamps_ns = np.minimum(stamps_ns, episode.stamps_ns[-1] - count[::-1])
    return replace(
        episode,
        stamps_ns=stamps_ns.astype(np.int64),
        fields={name: values[index] for name, values in episode.fields.items()},
        sampled_hz=episode.rate_hz,
    )
