"""Success rates and contrasts: by hand, and coverage by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from outcomes import outcomes

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.success import contrast, gap_closed, success_rate


def test_contrast_pairs_by_key_and_counts_unpaired_outcomes() -> None:
    a, b = outcomes([[1, 1, 0], [1, 0, 1]]), outcomes([[0, 1, 0], [0, 0, 1]])
    backwards = dict(reversed(b.items()))
    del backwards[(1, "start-2")]
    found = contrast(a, backwards)
    assert found.estimate.value == pytest.approx((1 / 3 + 1 / 2) / 2)
    assert (found.estimate.n_rollouts, found.estimate.n_unpaired) == (5, 1)
    with pytest.raises(ConfigError, match="none"):
        contrast(a, {(9, "start-0"): True})


def test_floor_of_p_is_the_smallest_possible_with_these_seeds() -> None:
    found = contrast(outcomes([[1]] * 3), outcomes([[0]] * 3))
    assert found.p == found.p_floor == 0.25


def test_equal_conditions_give_no_zero_width_and_p_one() -> None:
    found = contrast(outcomes([[1, 0]] * 10), outcomes([[1, 0]] * 10))
    assert found.estimate.is_degenerate
    low, high = found.estimate.interval or (0, 0)
    assert low == -high
    assert high > 0.5  # two starts bound it, not ten seeds
    assert found.p == 1.0


def test_bound_without_success_assumes_one_rollout_per_seed() -> None:
    found = success_rate(outcomes([[0] * 30] * 3))
    assert found.interval == (0.0, pytest.approx(1 - 0.025 ** (1 / 3)))
    assert success_rate(outcomes([[1] * 5])).interval is None  # one seed tells of no other


def test_same_seed_gives_same_interval_and_order_of_keys_does_not_matter() -> None:
    rng = np.random.default_rng(20260608)
    rows = outcomes(rng.integers(0, 2, (5, 8)).tolist())
    assert success_rate(rows) == success_rate(dict(reversed(rows.items())))


@pytest.mark.parametrize(("n_seeds", "least"), [(3, 0.9), (10, 0.92)])
def test_interval_covers_the_truth_where_seeds_differ(n_seeds: int, least: float) -> None:
    rng = np.random.default_rng(20260608)
    n_studies, covered = 300, 0
    for _ in range(n_studies):
        rate = rng.beta(2, 2, n_seeds)  # mean 1/2
        drawn = (rng.random((20, n_seeds)) < rate).T.astype(int).tolist()
        low, high = success_rate(outcomes(drawn), n_draws=1000).interval or (1, 0)
        covered += low <= 0.5 <= high
    assert covered / n_studies >= least


def test_gap_closed_of_the_paper_and_where_there_is_no_gap() -> None:
    assert gap_closed(0.911, 0.033, 0.933) == pytest.approx(0.9756, abs=1e-4)
    assert gap_closed(0.5, 0.9, 0.9) is None
    assert gap_closed(0.5, 0.95, 0.9) is None
