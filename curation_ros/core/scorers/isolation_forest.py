"""How easily random splits isolate an episode from the reference."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.features import check_width, moving_action, reference_features
from curation_ros.core.scorers.scorer import Abstain, Scorer

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode
    from curation_ros.core.stream import Floats

_EULER_GAMMA = 0.5772156649015329


def _features(episode: Episode) -> Floats:
    """(5 A,) mean, standard deviation, maximum, minimum and root mean square of each action."""
    action = moving_action(episode)
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


class IsolationForest(Scorer):
    """Isolation forest on per-dimension statistics of the action (the paper's, fitted on clean).

    scikit-learn grows the trees; `fit` keeps them as flat arrays, so that one episode is scored
    in well under a millisecond, and the fitted state can be hashed. The score is scikit-learn's
    `score_samples`: between -1 (isolated at once) and 0.

    Attributes:
        feature_: (trees, nodes) feature that a node splits on, -1 in a leaf.
        threshold_: (trees, nodes) go left where the feature is at most this.
        left_, right_: (trees, nodes) children; a leaf is its own child.
        depth_: (trees, nodes) expected depth of a point that ends in this leaf.
        normaliser_: number that the summed depth is divided by.
        levels_: depth of the deepest tree.
        n_features_: width of the features.

    Source: Liu, Ting, Zhou, ICDM 2008. Differences: none; scores are negated to point upwards.
    """

    needs = "reference"
    resolution = 0.01

    def __init__(self, *, n_trees: int = 100, max_samples: int = 256, seed: int = 0) -> None:
        """Store the size of the forest, the episodes drawn for a tree, and the seed."""
        self.n_trees = n_trees
        self.max_samples = max_samples
        self.seed = seed

    def check_params(self) -> None:
        """Check the ranges."""
        if self.n_trees < 1 or self.max_samples < 2:
            raise ConfigError(
                "IsolationForest: expected n_trees >= 1 and max_samples >= 2, found "
                f"{self.n_trees} and {self.max_samples}"
            )

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Grow the trees; at least two reference episodes."""
        # Importing scikit-learn takes seconds: only who fits a forest waits for it.
        from sklearn import ensemble

        self.check_params()
        try:
            rows = [_features(e) for e in episodes]
        except Abstain as reason:
            raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
        table = reference_features(rows, episodes, least=2)
        n_samples = min(self.max_samples, len(table))
        forest = ensemble.IsolationForest(
            n_estimators=self.n_trees, max_samples=n_samples, random_state=self.seed
        ).fit(table)
        trees = [estimator.tree_ for estimator in forest.estimators_]
        shape = (len(trees), max(t.node_count for t in trees))
        self.feature_ = np.full(shape, -1, dtype=np.int64)
        self.threshold_ = np.zeros(shape)
        self.left_ = np.zeros(shape, dtype=np.int64)
        self.right_ = np.zeros(shape, dtype=np.int64)
        self.depth_ = np.zeros(shape)
        for k, tree in enumerate(trees):
            nodes = np.arange(tree.node_count)
            leaf = tree.children_left < 0
            self.feature_[k, nodes] = np.where(leaf, -1, tree.feature)
            self.threshold_[k, nodes] = tree.threshold
            self.left_[k, nodes] = np.where(leaf, nodes, tree.children_left)
            self.right_[k, nodes] = np.where(leaf, nodes, tree.children_right)
            depth = np.zeros(tree.node_count)
            for node in nodes[~leaf]:  # children come after their parent
                depth[[tree.children_left[node], tree.children_right[node]]] = depth[node] + 1
            self.depth_[k, nodes] = depth + _mean_search_length(
                tree.n_node_samples.astype(np.float64)
            )
        self.levels_ = max(int(t.max_depth) for t in trees)
        self.normaliser_ = len(trees) * float(_mean_search_length(np.array(float(n_samples))))
        self.n_features_ = table.shape[1]
        return self

    def score(self, episode: Episode) -> float:
        """Between -1 and 0; an episode that nothing tells from the reference is near -0.4."""
        self._check_fitted()
        row = _features(episode)
        check_width(len(row), self.n_features_, "features of the action")
        row = row.astype(np.float32).astype(np.float64)  # scikit-learn's trees compare float32
        trees = np.arange(len(self.feature_))
        node = np.zeros(len(trees), dtype=np.int64)
        for _ in range(self.levels_):
            left = row[self.feature_[trees, node]] <= self.threshold_[trees, node]
            node = np.where(left, self.left_[trees, node], self.right_[trees, node])
        return -float(2.0 ** (-self.depth_[trees, node].sum() / self.normaliser_))
