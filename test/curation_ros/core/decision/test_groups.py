"""Two groups of scores are told from one, and one is not taken for two."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from curation_ros.core.decision.groups import METHODS, MIN_SCORES, split_scores
from curation_ros.core.errors import ConfigError

pytestmark = pytest.mark.slow

Draw = Callable[[np.random.Generator, int], np.ndarray]
ONE_GROUP: dict[str, Draw] = {
    "normal": lambda rng, n: rng.normal(size=n),
    "uniform": lambda rng, n: rng.uniform(size=n),
    "skewed": lambda rng, n: rng.exponential(size=n),
    "heavy tails": lambda rng, n: rng.standard_t(3, size=n),
}


def groups(rng: np.random.Generator, distance: float) -> np.ndarray:
    return np.concatenate([rng.normal(size=64), rng.normal(distance, 1.0, 16)])


@pytest.mark.parametrize("kind", sorted(ONE_GROUP))
@pytest.mark.parametrize("n", [16, 80])
def test_one_group_is_rarely_taken_for_two(kind: str, n: int) -> None:
    rng = np.random.default_rng(5)
    found = [split_scores(ONE_GROUP[kind](rng, n)).cut is not None for _ in range(40)]
    assert sum(found) <= 4


def test_groups_six_deviations_apart_are_found() -> None:
    rng = np.random.default_rng(6)
    found = [split_scores(groups(rng, 6.0)) for _ in range(20)]
    assert all(f.cut is not None and 1.5 < f.cut < 5.5 for f in found)


@pytest.mark.parametrize("method", sorted(METHODS))
def test_cut_by_hand(method: str) -> None:
    scores = [0.0, 0.1, 0.2, 0.1, 0.0, 0.2, 1.0, 1.1, 1.2, 1.1]
    split = split_scores(scores, method=method)
    assert split.cut == pytest.approx(0.6)
    assert split.n_upper == 4


def test_saturated_upper_group_is_found() -> None:
    rng = np.random.default_rng(7)
    split = split_scores([*rng.uniform(0.4, 0.6, 64), *[1.0] * 16], resolution=0.05)
    assert split.n_upper == 16


@given(
    st.lists(st.floats(-100, 100), min_size=MIN_SCORES, max_size=24),
    st.randoms(use_true_random=False),
    st.sampled_from(sorted(METHODS)),
)
@settings(max_examples=25, deadline=None)
def test_order_does_not_matter_and_counts_agree(
    scores: list[float], shuffle: object, method: str
) -> None:
    split = split_scores(scores, resolution=0.01, method=method)
    other = list(scores)
    shuffle.shuffle(other)  # type: ignore[attr-defined]
    assert split_scores(other, resolution=0.01, method=method) == split
    if split.cut is not None:
        assert split.n_upper == sum(x > split.cut for x in scores)
        assert split.doubt[0] <= split.cut <= split.doubt[1]


@pytest.mark.parametrize("scores", [[], [1.0], [1.0] * 7])
def test_few_scores_are_one_group(scores: list[float]) -> None:
    assert "too few" in split_scores(scores).why


def test_what_makes_no_sense_is_refused() -> None:
    with pytest.raises(ConfigError, match="not finite"):
        split_scores([float("nan")] * 9)
    with pytest.raises(ConfigError, match="mixture"):
        split_scores([1.0] * 9, method="kmeans")
