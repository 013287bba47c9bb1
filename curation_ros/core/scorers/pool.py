"""Scorers fitted on the unlabelled dataset itself, without every episode of the same start."""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.scorers.features import check_width, start_state
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats

#: Number of models in addition to that of all episodes. More would cost time and memory.
MAX_FOLDS = 20


class PoolScorer(Scorer):
    """A label-free twin: compares an episode with the other episodes of its dataset.

    Datasets are recorded in repetitions of one start. A repetition is nearly a copy, so every
    episode looks typical among its own repetitions. Starts closer than `same_start` form a group,
    and groups are spread over at most MAX_FOLDS folds. An episode is compared with what was
    learned outside the fold of its start. An episode from a start that the dataset lacks is
    compared with all.

    Invariant: a score depends on the rows of the other folds alone. It depends neither on the
    order of the dataset, nor on ids, nor on another recording from the same start.

    Without labels nothing shows which mode of the data is the good one. The score follows the
    majority, so it is inverted if most episodes are defective.

    Attributes:
        starts_: (n, S) starts of the episodes, sorted.
        fold_: (n,) fold of each episode.
        n_others_: (folds + 1,) number of episodes outside each fold; the last counts all.
        n_features_: width of the features.
    """

    needs = "dataset"
    same_start: float
    min_others: int

    @abstractmethod
    def _features(self, episode: Episode) -> Floats:
        """(F,) features that the episode is compared by.

        Raises:
            Abstain: if it cannot be read.
        """

    @abstractmethod
    def _learn(self, features: Floats, fold: npt.NDArray[np.int64]) -> None:
        """Learn a model outside each fold and one of all episodes, from (n, F) features."""

    @abstractmethod
    def _score_features(self, features: Floats, model: int) -> float:
        """Score (F,) features by one of the models."""

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        if not (np.isfinite(self.same_start) and self.same_start >= 0 and self.min_others >= 2):
            raise ConfigError(
                f"{type(self).__name__}: expected same_start >= 0 and min_others >= 2, found "
                f"{self.same_start} and {self.min_others}"
            )

    def summary(self, episode: Episode) -> Floats:
        """What `fit_summaries` needs of one episode, so that no episode must stay in memory.

        Returns:
            (1 + S + F,) the width of the start, the start, the features.

        Raises:
            Abstain: if the episode cannot be used.
        """
        self.check_params()
        features = self._features(episode)
        start = start_state(episode)
        return np.concatenate([[len(start)], start, features])

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn from all episodes of the dataset; those that cannot be used are skipped.

        Raises:
            EpisodeError: if fewer than `min_others` are left, or two have the same id.
        """
        self.check_params()
        ids, rows = [], []
        for episode in episodes:
            try:
                row = self.summary(episode)
            except Abstain:  # its look will abstain as well, with the reason
                continue
            ids.append(episode.id)
            rows.append(row)
        return self.fit_summaries(ids, rows)

    def fit_summaries(self, ids: Sequence[str], rows: Sequence[Floats]) -> Self:
        """Learn from what `summary` returned for the episodes of the dataset.

        Rows whose width differs from that of most rows (another robot) are skipped.

        Args:
            ids: one per episode, for messages.
            rows: one per episode, in any order.

        Raises:
            EpisodeError: if fewer than `min_others` are left, or two have the same id.
        """
        self.check_params()
        twice = [i for i, n in Counter(ids).items() if n > 1]
        if twice:
            raise EpisodeError(f"the dataset has episode {min(twice)} twice")
        shapes = Counter((len(row), int(row[0])) for row in rows)
        usual = max(shapes, key=lambda s: (shapes[s], s), default=(0, 0))
        used = [row for row in rows if (len(row), int(row[0])) == usual]
        if len(used) < self.min_others:
            raise EpisodeError(
                f"the dataset has {len(used)} episodes that can be used, at least "
                f"{self.min_others} are needed"
            )
        # Sorted by content, so that the order of the dataset does not change the last bits.
        table = np.array(used)
        table = table[np.lexsort(table.T[::-1])]
        n_start = usual[1]
        self.starts_ = table[:, 1 : 1 + n_start]
        features = table[:, 1 + n_start :]
        self.n_features_ = features.shape[1]
        self.fold_ = _folds(_groups(self.starts_, self.same_start), self.starts_)
        others = [int(np.sum(self.fold_ != k)) for k in range(int(self.fold_.max()) + 1)]
        self.n_others_ = np.array([*others, len(table)])
        self._learn(features, self.fold_)
        return self

    def look(self, episode: Episode) -> Look:
        """Score one episode by the episodes of the dataset from other starts."""
        self._check_fitted()
        features = self._features(episode)
        check_width(len(features), self.n_features_, "features", of="dataset")
        start = start_state(episode)
        check_width(len(start), self.starts_.shape[1], "numbers of the start", of="dataset")
        same = np.abs(self.starts_ - start).max(axis=1) <= self.same_start
        folds = np.unique(self.fold_[same])
        if len(folds) > 1:
            raise Abstain("its start lies between starts of the dataset that count as different")
        model = int(folds[0]) if len(folds) else len(self.n_others_) - 1
        if self.n_others_[model] < self.min_others:
            raise Abstain(
                f"the dataset has only {self.n_others_[model]} episodes of other starts, "
                f"at least {self.min_others} are needed"
            )
        return Look(self._score_features(features, model))

    def _check_fitted(self) -> None:
        if not self.fitted():
            raise NotFittedError(
                f"{type(self).__name__} needs a dataset: fit it on all its episodes first"
            )


def outside(fold: npt.NDArray[np.int64]) -> list[npt.NDArray[np.bool_]]:
    """(n,) masks of the episodes that each model learns from: outside each fold, then all."""
    masks = [fold != k for k in range(int(fold.max()) + 1)]
    return [*masks, np.ones(len(fold), dtype=bool)]


def _groups(starts: Floats, same_start: float) -> npt.NDArray[np.int64]:
    """(n,) group of each start. A group is a chain of starts, each near to the next one."""
    group = np.full(len(starts), -1, dtype=np.int64)
    n_groups = 0
    for seed in range(len(starts)):
        if group[seed] >= 0:
            continue
        reached = [seed]
        group[seed] = n_groups
        while reached:
            free = np.flatnonzero(group < 0)
            distance = np.abs(starts[free] - starts[reached.pop()]).max(axis=1, initial=0.0)
            near = free[distance <= same_start]
            group[near] = n_groups
            reached.extend(near.tolist())
        n_groups += 1
    return group


def _folds(group: npt.NDArray[np.int64], starts: Floats) -> npt.NDArray[np.int64]:
    """(n,) fold of each start, by the rank of a hash: all folds have equally many groups."""
    _, first = np.unique(group, return_index=True)  # the smallest start of each group
    hashes = [hashlib.sha256(starts[k].astype("<f8").tobytes()).digest() for k in first]
    rank = np.empty(len(hashes), dtype=np.int64)
    rank[sorted(range(len(hashes)), key=hashes.__getitem__)] = np.arange(len(hashes))
    folds: npt.NDArray[np.int64] = (rank % MAX_FOLDS)[group]
    return folds
