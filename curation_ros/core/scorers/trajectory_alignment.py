"""Likeness of the motion to the reference's mean motion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers.features import (
    check_width,
    finite_state,
    moving_action,
    reference_features,
)
from curation_ros.core.scorers.scorer import Abstain, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode
    from curation_ros.core.stream import Floats


class TrajectoryAlignment(Scorer):
    """Cosine of the angle between an episode's states and the reference's mean (the paper's).

    'Mean state trajectory' can be read in two ways: `of='time-mean'` compares the mean over time
    of the states (S numbers), which is what the paper's code does; `of='flattened'` compares
    whole trajectories (T times S numbers) step by step, over the steps that both have.

    Attributes:
        mean_: (1, S), or (T, S) with `of='flattened'`, T the shortest reference episode.
    """

    needs = "reference"
    resolution = 0.001
    choices: ClassVar = {"of": ("time-mean", "flattened")}

    def __init__(self, *, of: str = "time-mean") -> None:
        """Store what is compared."""
        self.of = of

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn the mean of the reference."""
        self.check_params()
        try:
            states = [self._trajectory(e) for e in episodes]
        except Abstain as reason:
            raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
        n_steps = min((len(s) for s in states), default=0)
        rows = [s[:n_steps].ravel() for s in states]
        mean = reference_features(rows, episodes, least=1).mean(axis=0)
        self.mean_ = mean.reshape(n_steps, -1)
        return self

    def score(self, episode: Episode) -> float:
        """1 for the same direction, 0 for a right angle, -1 for the opposite."""
        self._check_fitted()
        states = self._trajectory(episode)
        check_width(states.shape[1], self.mean_.shape[1], "columns of the state")
        n_steps = min(len(states), len(self.mean_))
        a, b = states[:n_steps].ravel(), self.mean_[:n_steps].ravel()
        norms = float(np.linalg.norm(a) * np.linalg.norm(b))
        if not norms > 0:
            raise Abstain("the state is zero throughout")
        return float(np.clip(np.dot(a, b) / norms, -1.0, 1.0))

    def _trajectory(self, episode: Episode) -> Floats:
        moving_action(episode)  # a frozen episode is to be looked at, not to be compared
        states = finite_state(episode)
        return states.mean(axis=0, keepdims=True) if self.of == "time-mean" else states
