"""Rank correlations: by hand, by brute force, and against scipy."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from curation_ros.core.statistics.rank_correlation import (
    rank_correlation,
    rank_correlation_exact,
)

# Table II of the paper: AUROC and success of its seven metrics.
PAPER_AUROC = (0.761, 0.638, 0.280, 0.447, 0.712, 0.804, 0.440)
PAPER_SUCCESS = (91.1, 90.0, 77.8, 63.3, 58.9, 13.3, 3.3)


def test_rank_correlation_is_spearmans_and_none_for_a_constant() -> None:
    scores, lengths = [1.0, 3.0, 2.0, 5.0], [10, 20, 30, 40]
    expected = stats.spearmanr(scores, lengths)
    assert rank_correlation(scores, lengths) == (
        pytest.approx(0.8),
        pytest.approx(expected.pvalue),
    )
    assert rank_correlation([1.0] * 4, lengths) is None
    assert rank_correlation(scores, [7] * 4) is None


def test_rho_of_the_papers_table_is_not_the_one_it_prints() -> None:
    found = rank_correlation_exact(PAPER_AUROC, PAPER_SUCCESS)
    assert found is not None
    assert found.rho == pytest.approx(1 - 6 * 52 / (7 * 48))  # +0.071; the paper has -0.14
    assert found.is_exact
    assert found.interval == (pytest.approx(-0.72, abs=0.01), pytest.approx(0.78, abs=0.01))


def test_rank_correlation_equals_brute_force_with_ties() -> None:
    x, y = [1.0, 2.0, 2.0, 4.0, 0.5], [3.0, 1.0, 4.0, 4.0, 0.0]
    found = rank_correlation_exact(x, y)
    all_rho = [stats.spearmanr(x, order).statistic for order in itertools.permutations(y)]
    rho = stats.spearmanr(x, y).statistic
    assert found is not None
    assert found.rho == pytest.approx(rho)
    assert found.p == pytest.approx(np.mean(np.abs(all_rho) >= abs(rho) - 1e-9))


def test_perfect_rank_correlation_has_an_interval_with_width() -> None:
    found = rank_correlation_exact([1, 2, 3, 4, 5], [2, 4, 6, 8, 9])
    assert found is not None
    assert found.p == pytest.approx(2 / 120)
    assert found.interval is not None
    assert found.interval[0] < 0.9
    assert found.interval[1] == 1.0


def test_rank_correlation_of_a_constant_is_none() -> None:
    assert rank_correlation_exact([1, 1, 1, 1], [1, 2, 3, 4]) is None
    assert rank_correlation_exact([1, 2], [1, 2]) is None
