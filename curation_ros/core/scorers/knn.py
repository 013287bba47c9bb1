"""Distance to the nearest other episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.features import (
    check_width,
    finite_state,
    mean_std_rms,
    moving_action,
    reference_features,
)
from curation_ros.core.scorers.pool import PoolScorer, outside
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats


def _features(episode: Episode) -> Floats:
    return np.concatenate(
        [mean_std_rms(finite_state(episode)), mean_std_rms(moving_action(episode))]
    )


def _scaling(table: Floats, scale_floor: float, standardised: bool) -> tuple[Floats, Floats]:
    """(F,) mean and (F,) scale to standardise features by; 0 and 1 without standardisation."""
    if not standardised or not len(table):
        return np.zeros(table.shape[1]), np.ones(table.shape[1])
    return table.mean(axis=0), np.maximum(table.std(axis=0), scale_floor)


class NearestNeighbours(Scorer):
    """Negative mean distance to the k nearest reference episodes (the paper's 'kNN').

    Features are mean, standard deviation and root mean square of each column of state and action.
    The paper leaves open whether they are scaled. By default each is standardised by the
    reference; with `standardised=False` the columns with the largest numbers decide. An episode is
    never its own neighbour, by id. If there are fewer than k others, `few='use'` takes all of
    them, and `few='abstain'` gives no score.

    Attributes:
        ids_: ids of the reference episodes.
        mean_, scale_: (F,) mean and standard deviation of the features in the reference.
        table_: (n, F) standardised features of the reference.
        k_: number of neighbours for an episode that is not in the reference.
    """

    needs = "reference"
    resolution = 0.1
    choices: ClassVar = {"few": ("use", "abstain")}

    def __init__(
        self,
        *,
        k: int = 5,
        scale_floor: float = 2e-3,
        few: str = "use",
        standardised: bool = True,
    ) -> None:
        """Store the parameters.

        Args:
            k: number of neighbours to average over.
            scale_floor: smallest standard deviation that a feature is divided by, in its own
                unit. Without it, columns that are constant in the reference (as the height of an
                object at rest) would decide alone.
            few: what to do with fewer than k neighbours, `use` them or `abstain`.
            standardised: whether features are divided by their standard deviation.
        """
        self.k = k
        self.scale_floor = scale_floor
        self.few = few
        self.standardised = standardised

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        _check_ranges(self)

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn the features of the reference."""
        self.check_params()
        try:
            rows = [_features(e) for e in episodes]
        except Abstain as reason:
            raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
        table = reference_features(rows, episodes, least=1)
        self.ids_ = tuple(e.id for e in episodes)
        self.mean_, self.scale_ = _scaling(table, self.scale_floor, self.standardised)
        self.table_ = (table - self.mean_) / self.scale_
        self.k_ = min(self.k, len(table))
        return self

    def look(self, episode: Episode) -> Look:
        """0 within the reference, more negative further away; in standard deviations."""
        self._check_fitted()
        row = _features(episode)
        check_width(len(row), len(self.mean_), "features of state and action")
        others = self.table_[[i != episode.id for i in self.ids_]]
        if not len(others):
            raise Abstain("the reference holds no other episode")
        if len(others) < self.k and self.few == "abstain":
            raise Abstain(f"only {len(others)} of {self.k} neighbours")
        distance = np.linalg.norm(others - (row - self.mean_) / self.scale_, axis=1)
        return Look(-float(np.sort(distance)[: self.k].mean()))


class LabelFreeNearestNeighbours(PoolScorer):
    """Negative mean distance to the k nearest episodes of the dataset from other starts.

    Features are those of `knn`, standardised by the episodes outside the fold of the start. The k
    nearest of at least `min_others` episodes count, or all of them if there are fewer than k.

    Attributes:
        mean_, scale_: (folds + 1, F) means and standard deviations outside each fold; the last
            ones are those of all episodes.
        table_: (n, F) features of the dataset.
    """

    resolution = 0.1

    def __init__(
        self,
        *,
        k: int = 5,
        scale_floor: float = 2e-3,
        standardised: bool = True,
        same_start: float = 1e-3,
        min_others: int = 5,
    ) -> None:
        """Store the parameters.

        Args:
            k: number of neighbours to average over.
            scale_floor: smallest standard deviation that a feature is divided by.
            standardised: whether features are divided by their standard deviation.
            same_start: starts that differ by at most this in each number count as one start.
            min_others: smallest number of episodes from other starts to compare with.
        """
        self.k = k
        self.scale_floor = scale_floor
        self.standardised = standardised
        self.same_start = same_start
        self.min_others = min_others

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        _check_ranges(self)

    def _features(self, episode: Episode) -> Floats:
        return _features(episode)

    def _learn(self, features: Floats, fold: npt.NDArray[np.int64]) -> None:
        scalings = [
            _scaling(features[mask], self.scale_floor, self.standardised) for mask in outside(fold)
        ]
        self.mean_ = np.array([mean for mean, _ in scalings])
        self.scale_ = np.array([scale for _, scale in scalings])
        self.table_ = features

    def _score_features(self, features: Floats, model: int) -> float:
        """0 within the others, more negative further away; in standard deviations."""
        # In the difference of two standardised rows the mean cancels and only the scale is left.
        apart = self.table_ - features
        apart /= self.scale_[model]
        squared = np.einsum("ij,ij->i", apart, apart)
        squared[self.fold_ == model] = np.inf  # no episode, for the last model: it has no fold
        k = min(self.k, int(self.n_others_[model]))
        return -float(np.sqrt(np.sort(np.partition(squared, k - 1)[:k])).mean())


def _check_ranges(scorer: NearestNeighbours | LabelFreeNearestNeighbours) -> None:
    if scorer.k < 1 or not scorer.scale_floor > 0:
        raise ConfigError(
            f"{type(scorer).__name__}: expected k >= 1 and scale_floor > 0, found {scorer.k} and "
            f"{scorer.scale_floor}"
        )
