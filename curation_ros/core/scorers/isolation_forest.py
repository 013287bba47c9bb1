"""How easily random splits isolate an episode from others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.features import check_width, moving_action, reference_features
from curation_ros.core.scorers.pool import PoolScorer, outside
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats

_EULER_GAMMA = 0.5772156649015329


class Forest(NamedTuple):
    """Isolation trees as flat arrays, to be scored without scikit-learn and hashed by content.

    The arrays hold the nodes of all trees, one tree after another. Children are indices into them.

    Attributes:
        root: (trees,) index of the first node of each tree.
        feature: (nodes,) feature that a node splits on; 0 in a leaf.
        threshold: (nodes,) a point goes left if its feature is at most this.
        left, right: (nodes,) children; a leaf is its own child.
        depth: (nodes,) expected depth of a point that ends in this leaf.
        levels: depth of the deepest tree.
        normaliser: number that the sum of depths is divided by.
    """

    root: npt.NDArray[np.int64]
    feature: npt.NDArray[np.int64]
    threshold: Floats
    left: npt.NDArray[np.int64]
    right: npt.NDArray[np.int64]
    depth: Floats
    levels: int
    normaliser: float

    def score(self, row: Floats) -> float:
        """scikit-learn's `score_samples` of one (F,) row: between -1 (isolated at once) and 0."""
        row = row.astype(np.float32).astype(np.float64)  # scikit-learn's trees compare float32
        node = self.root
        for _ in range(self.levels):
            left = row.take(self.feature.take(node)) <= self.threshold.take(node)
            node = np.where(left, self.left.take(node), self.right.take(node))
        return -float(2.0 ** (-self.depth.take(node).sum() / self.normaliser))


def _features(episode: Episode, of: str) -> Floats:
    """(5 A,) mean, standard deviation, maximum, minimum and root mean square per dimension."""
    action = moving_action(episode)
    if of == "magnitudes":
        action = np.abs(action)
    return np.concatenate(
        [
            action.mean(axis=0),
            action.std(axis=0),
            action.max(axis=0),
            action.min(axis=0),
            np.sqrt(np.mean(action**2, axis=0)),
        ]
    )


def _mean_search_length(n: Floats) -> Floats:
    """Mean depth of an unsuccessful search among n points: c(n) of Liu et al., equation 1."""
    rest = np.maximum(n - 1.0, 1.0)
    long = 2.0 * (np.log(rest) + _EULER_GAMMA) - 2.0 * rest / np.maximum(n, 1.0)
    return np.where(n > 2, long, np.where(n == 2, 1.0, 0.0))


def _grow(table: Floats, n_trees: int, max_samples: int, seed: int) -> Forest:
    """Grow a forest on (n, F) features, n >= 2."""
    # Importing scikit-learn takes seconds, which only a fit of a forest waits for.
    from sklearn import ensemble

    n_samples = min(max_samples, len(table))
    forest = ensemble.IsolationForest(
        n_estimators=n_trees, max_samples=n_samples, random_state=seed
    ).fit(table)
    trees = [estimator.tree_ for estimator in forest.estimators_]
    root = np.concatenate([[0], np.cumsum([t.node_count for t in trees[:-1]], dtype=np.int64)])
    parts: list[tuple[Floats, ...]] = []
    for tree, begin in zip(trees, root, strict=True):
        nodes = np.arange(tree.node_count)
        leaf = tree.children_left < 0
        depth = _mean_search_length(tree.n_node_samples.astype(np.float64))
        level, n_above = nodes[:1], 0
        while len(level):
            depth[level] += n_above
            inner = level[~leaf[level]]
            level = np.concatenate([tree.children_left[inner], tree.children_right[inner]])
            n_above += 1
        children = [np.where(leaf, nodes, c) for c in (tree.children_left, tree.children_right)]
        feature = np.where(leaf, 0, tree.feature)
        parts.append((feature, tree.threshold, begin + children[0], begin + children[1], depth))
    feature, threshold, left, right, depth = map(np.concatenate, zip(*parts, strict=True))
    return Forest(
        root=root,
        feature=feature.astype(np.int64),
        threshold=threshold,
        left=left.astype(np.int64),
        right=right.astype(np.int64),
        depth=depth,
        levels=max(int(t.max_depth) for t in trees),
        normaliser=len(trees) * float(_mean_search_length(np.array(float(n_samples)))),
    )


class IsolationForest(Scorer):
    """Isolation forest on per-dimension statistics of the action (the paper's, fitted on clean).

    'Action magnitudes per dimension' has two readings. `of='signed'` takes the statistics of the
    actions as they are, `of='magnitudes'` those of their absolute values. scikit-learn grows the
    trees. They are kept as flat arrays, so that a score takes well under a millisecond and the
    fitted state can be hashed. The score is scikit-learn's `score_samples`, between -1 (isolated
    by the first split) and 0.

    Attributes:
        forest_: the trees.
        n_features_: width of the features.

    Source: Liu, Ting, Zhou, ICDM 2008. Differences: none; scores are negated to point upwards.
    """

    needs = "reference"
    resolution = 0.01
    choices: ClassVar = {"of": ("signed", "magnitudes")}

    def __init__(
        self,
        *,
        n_trees: int = 100,
        max_samples: int = 256,
        seed: int = 0,
        of: str = "signed",
    ) -> None:
        """Store the parameters.

        Args:
            n_trees: number of trees.
            max_samples: number of episodes that are drawn for a tree.
            seed: of the random splits.
            of: whether the statistics are those of signed actions or of their magnitudes.
        """
        self.n_trees = n_trees
        self.max_samples = max_samples
        self.seed = seed
        self.of = of

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        _check_sizes(self)

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Grow the trees from at least two reference episodes."""
        self.check_params()
        try:
            rows = [_features(e, self.of) for e in episodes]
        except Abstain as reason:
            raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
        table = reference_features(rows, episodes, least=2)
        self.forest_ = _grow(table, self.n_trees, self.max_samples, self.seed)
        self.n_features_ = table.shape[1]
        return self

    def look(self, episode: Episode) -> Look:
        """Between -1 and 0; near -0.4 for an episode like those of the reference."""
        self._check_fitted()
        row = _features(episode, self.of)
        check_width(len(row), self.n_features_, "features of the action")
        return Look(self.forest_.score(row))


class LabelFreeIsolationForest(PoolScorer):
    """Isolation forest grown on the dataset itself, without the episodes of the same start.

    Features and score are those of `isolation_forest`, with one forest per fold of starts.

    Attributes:
        forests_: the forest grown outside each fold; the last one is grown from all episodes. None
            if fewer than two episodes are left.
    """

    resolution = 0.01
    choices: ClassVar = {"of": ("signed", "magnitudes")}

    def __init__(
        self,
        *,
        n_trees: int = 100,
        max_samples: int = 256,
        seed: int = 0,
        of: str = "signed",
        same_start: float = 1e-3,
        min_others: int = 5,
    ) -> None:
        """Store the parameters.

        Args:
            n_trees: number of trees of each forest.
            max_samples: number of episodes that are drawn for a tree.
            seed: of the random splits.
            of: whether the statistics are those of signed actions or of their magnitudes.
            same_start: starts that differ by at most this in each number count as one start.
            min_others: smallest number of episodes from other starts to compare with.
        """
        self.n_trees = n_trees
        self.max_samples = max_samples
        self.seed = seed
        self.of = of
        self.same_start = same_start
        self.min_others = min_others

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        _check_sizes(self)

    def _features(self, episode: Episode) -> Floats:
        return _features(episode, self.of)

    def _learn(self, features: Floats, fold: npt.NDArray[np.int64]) -> None:
        self.forests_ = tuple(
            _grow(features[mask], self.n_trees, self.max_samples, self.seed)
            if mask.sum() >= 2
            else None
            for mask in outside(fold)
        )

    def _score_features(self, features: Floats, model: int) -> float:
        """Between -1 and 0; near -0.4 for an episode like the others."""
        forest = self.forests_[model]
        assert forest is not None  # min_others >= 2
        return forest.score(features)


def _check_sizes(scorer: IsolationForest | LabelFreeIsolationForest) -> None:
    if scorer.n_trees < 1 or scorer.max_samples < 2:
        raise ConfigError(
            f"{type(scorer).__name__}: expected n_trees >= 1 and max_samples >= 2, found "
            f"{scorer.n_trees} and {scorer.max_samples}"
        )
