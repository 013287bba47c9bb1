"""Similarity of the motion to the mean motion of other episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.features import (
    check_width,
    finite_state,
    moving_action,
    reference_features,
)
from curation_ros.core.scorers.pool import PoolScorer, outside
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats


def _cosine(a: Floats, b: Floats) -> float:
    norms = float(np.linalg.norm(a) * np.linalg.norm(b))
    if not norms > 0:
        raise Abstain("the state is zero throughout")
    return float(np.clip(np.dot(a, b) / norms, -1.0, 1.0))


def _moving_state(episode: Episode) -> Floats:
    moving_action(episode)  # abstains on a frozen episode: there is no motion to compare
    return finite_state(episode)


class TrajectoryAlignment(Scorer):
    """Cosine of the angle between an episode's states and the reference's mean (the paper's).

    'Mean state trajectory' has two readings. `of='time-mean'` compares the means over time of the
    states (S numbers), as the paper's code does. `of='flattened'` compares whole trajectories
    (T times S numbers) step by step, over the steps that both have.

    Attributes:
        mean_: (1, S), or (T, S) with `of='flattened'`, where T is the length of the shortest
            reference episode.
    """

    needs = "reference"
    resolution = 0.001
    choices: ClassVar = {"of": ("time-mean", "flattened")}

    def __init__(self, *, of: str = "time-mean") -> None:
        """Store the parameters.

        Args:
            of: what is compared, the mean over time of the states or all states in a row.
        """
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

    def look(self, episode: Episode) -> Look:
        """1 for the same direction, 0 for a right angle, -1 for the opposite."""
        self._check_fitted()
        states = self._trajectory(episode)
        check_width(states.shape[1], self.mean_.shape[1], "columns of the state")
        n_steps = min(len(states), len(self.mean_))
        return Look(_cosine(states[:n_steps].ravel(), self.mean_[:n_steps].ravel()))

    def _trajectory(self, episode: Episode) -> Floats:
        states = _moving_state(episode)
        return states.mean(axis=0, keepdims=True) if self.of == "time-mean" else states


class LabelFreeTrajectoryAlignment(PoolScorer):
    """Cosine of the angle between an episode's states and the mean of those from other starts.

    `of='time-mean'` is as in `trajectory_alignment`. `of='flattened'` compares the states at
    `n_points` evenly spaced steps, so that the memory per episode does not depend on its length.

    Attributes:
        mean_: (folds + 1, F) means outside each fold; the last one is that of all episodes.
    """

    resolution = 0.001
    choices: ClassVar = {"of": ("time-mean", "flattened")}

    def __init__(
        self,
        *,
        of: str = "time-mean",
        n_points: int = 50,
        same_start: float = 1e-3,
        min_others: int = 5,
    ) -> None:
        """Store the parameters.

        Args:
            of: what is compared, the mean over time of the states or some of them in a row.
            n_points: number of steps that are compared with `of: flattened`.
            same_start: starts that differ by at most this in each number count as one start.
            min_others: smallest number of episodes from other starts to compare with.
        """
        self.of = of
        self.n_points = n_points
        self.same_start = same_start
        self.min_others = min_others

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        if self.n_points < 2:
            raise ConfigError(
                f"LabelFreeTrajectoryAlignment: expected n_points >= 2, found {self.n_points}"
            )

    def _features(self, episode: Episode) -> Floats:
        states = _moving_state(episode)
        if self.of == "time-mean":
            return np.asarray(states.mean(axis=0))
        steps = np.rint(np.linspace(0, len(states) - 1, self.n_points)).astype(np.int64)
        resampled: Floats = states[steps].ravel()
        return resampled

    def _learn(self, features: Floats, fold: npt.NDArray[np.int64]) -> None:
        self.mean_ = np.array(
            [features[m].mean(axis=0) if m.any() else 0 * features[0] for m in outside(fold)]
        )

    def _score_features(self, features: Floats, model: int) -> float:
        """1 for the same direction, 0 for a right angle, -1 for the opposite."""
        return _cosine(features, self.mean_[model])
