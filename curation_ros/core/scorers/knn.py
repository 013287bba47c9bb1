"""Distance to the nearest reference episodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.features import (
    check_width,
    finite_state,
    mean_std_rms,
    moving_action,
    reference_features,
)
from curation_ros.core.scorers.scorer import Abstain, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode
    from curation_ros.core.stream import Floats


def _features(episode: Episode) -> Floats:
    return np.concatenate(
        [mean_std_rms(finite_state(episode)), mean_std_rms(moving_action(episode))]
    )


class NearestNeighbours(Scorer):
    """Negative mean distance to the k nearest reference episodes (the paper's 'kNN').

    Features: mean, standard deviation and root mean square of each column of state and action,
    each standardised by the reference. An episode is never its own neighbour, by id. Where fewer
    than k others are left, `few='use'` takes those there are (`describe` of the curation says how
    many the reference has) and `few='abstain'` does not score.

    Attributes:
        ids_: ids of the reference episodes.
        mean_, scale_: (F,) mean and standard deviation of the features in the reference.
        table_: (n, F) standardised features of the reference.
        k_: neighbours that an episode from outside the reference is compared with.
    """

    needs = "reference"
    resolution = 0.1
    choices: ClassVar = {"few": ("use", "abstain")}

    def __init__(self, *, k: int = 5, scale_floor: float = 2e-3, few: str = "use") -> None:
        """Store the parameters.

        Args:
            k: neighbours to average over.
            scale_floor: smallest standard deviation that a feature is divided by, in its own
                unit; without it, columns that are constant in the reference (a settled object's
                height) would decide alone.
            few: what to do with fewer than k neighbours, `use` or `abstain`.
        """
        self.k = k
        self.scale_floor = scale_floor
        self.few = few

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        if self.k < 1 or not self.scale_floor > 0:
            raise ConfigError(
                f"NearestNeighbours: expected k >= 1 and scale_floor > 0, found {self.k} and "
                f"{self.scale_floor}"
            )

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn the features of the reference."""
        self.check_params()
        try:
            rows = [_features(e) for e in episodes]
        except Abstain as reason:
            raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
        table = reference_features(rows, episodes, least=1)
        self.ids_ = tuple(e.id for e in episodes)
        self.mean_ = table.mean(axis=0)
        self.scale_ = np.maximum(table.std(axis=0), self.scale_floor)
        self.table_ = (table - self.mean_) / self.scale_
        self.k_ = min(self.k, len(table))
        return self

    def score(self, episode: Episode) -> float:
        """0 amid the reference, more negative further away; in standard deviations."""
        self._check_fitted()
        row = _features(episode)
        check_width(len(row), len(self.mean_), "features of state and action")
        others = self.table_[[i != episode.id for i in self.ids_]]
        if not len(others):
            raise Abstain("the reference holds no other episode")
        if len(others) < self.k and self.few == "abstain":
            raise Abstain(f"only {len(others)} of {self.k} neighbours")
        distance = np.linalg.norm(others - (row - self.mean_) / self.scale_, axis=1)
        return -float(np.sort(distance)[: self.k].mean())
