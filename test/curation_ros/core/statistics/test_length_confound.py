"""Tests within strata: by hand, against scipy, and by simulation without an effect."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import spearmanr

from curation_ros.core.statistics.detection import auroc
from curation_ros.core.statistics.length_confound import (
    correlation_test_within,
    label_test_within,
    length_strata,
    separates,
)
from curation_ros.core.statistics.rank_correlation import rank_correlation


def test_length_separates_only_without_an_overlap() -> None:
    good = [True, True, False, False]
    assert separates([10, 20, 30, 40], good)
    assert separates([30, 40, 10, 20], good)
    assert not separates([10, 30, 30, 40], good)
    assert not separates([10, 35, 30, 40], good)


@given(st.lists(st.integers(1, 30), min_size=1, max_size=60))
def test_strata_of_length_are_in_order_and_never_part_equal_lengths(lengths: list[int]) -> None:
    strata = length_strata(lengths)
    order = np.argsort(lengths, kind="stable")
    assert (np.diff(strata[order]) >= 0).all()
    assert len({(n, s) for n, s in zip(lengths, strata.tolist(), strict=True)}) == len(
        set(lengths)
    )
    assert len(set(strata.tolist())) <= 5


def test_strata_of_distinct_lengths_are_fifths() -> None:
    assert np.bincount(length_strata(np.arange(100))).tolist() == [20] * 5


def test_labels_within_strata_by_hand() -> None:
    # Stratum 0: good 1 against bad 0, won. Stratum 1: good 5 against bad 6 and 7, lost twice.
    found = label_test_within(
        [1, 0, 5, 6, 7], [True, False, True, False, False], [0, 0, 1, 1, 1], n_permutations=999
    )
    assert found is not None
    assert found.value == 1 / 3
    assert found.n_compared == 5
    # All 6 orders: 0 or 1 pair won in the first stratum, 0 to 2 in the second, 1.5 by chance.
    wins = [a + b for a in (0, 1) for b in (0, 1, 2)]
    share = np.mean([abs(w - 1.5) >= 0.5 for w in wins])
    assert found.p == pytest.approx(share, abs=0.05)


def test_score_that_only_follows_length_detects_nothing_within_strata(
    rng: np.random.Generator,
) -> None:
    good = rng.random(300) < 0.5
    lengths = np.where(good, 250, 350) + rng.integers(0, 120, 300)
    strata = length_strata(lengths, 30)
    confounded = label_test_within(-lengths, good, strata)
    assert auroc(-lengths, good) > 0.8
    assert confounded is not None
    assert 0.4 < confounded.value < 0.65
    telling = label_test_within(good + 0.1 * rng.standard_normal(300), good, strata)
    assert telling is not None
    assert (telling.value, telling.p) == (1.0, 1e-4)


def test_labels_within_strata_are_none_where_no_stratum_holds_both_kinds() -> None:
    assert label_test_within([1, 2, 3, 4], [True, True, False, False], [0, 0, 1, 1]) is None


def test_length_within_labels_is_not_the_difference_between_labels(
    rng: np.random.Generator,
) -> None:
    good = np.arange(200) < 100
    lengths = np.where(good, 250.0, 500.0) + rng.integers(0, 20, 200)
    scores = good + 0.1 * rng.standard_normal(200)
    overall = rank_correlation(scores, lengths)
    within = correlation_test_within(scores, lengths, good)
    assert overall is not None
    assert within is not None
    assert overall[0] < -0.7
    assert abs(within.value) < 0.2
    assert within.p > 0.05
    following = correlation_test_within(-lengths, lengths, good)
    assert following is not None
    assert (following.value, following.p) == (pytest.approx(-1.0), 1e-4)


def test_correlation_within_one_stratum_is_spearmans(rng: np.random.Generator) -> None:
    scores, lengths = rng.standard_normal(30), rng.integers(0, 10, 30).astype(float)
    found = correlation_test_within(scores, lengths, np.zeros(30, dtype=int))
    expected = spearmanr(scores, lengths)
    assert found is not None
    assert found.value == pytest.approx(expected.statistic)
    assert found.p == pytest.approx(expected.pvalue, abs=0.03)


def test_correlation_within_labels_is_none_where_lengths_do_not_vary() -> None:
    good = np.array([True, True, False, False])
    assert correlation_test_within([1, 2, 3, 4], [5, 5, 9, 9], good) is None


def test_p_of_a_permutation_test_is_uniform_without_an_effect(rng: np.random.Generator) -> None:
    good = np.arange(40) < 12
    strata = np.arange(40) % 4
    ps = []
    for k in range(200):
        found = label_test_within(
            rng.standard_normal(40), good, strata, seed=k, n_permutations=199
        )
        assert found is not None
        ps.append(found.p)
    assert 0.01 < np.mean(np.array(ps) <= 0.05) < 0.10
    assert min(ps) >= 1 / 200


def test_permutations_depend_on_the_seed_alone(rng: np.random.Generator) -> None:
    scores, good = rng.standard_normal(40), np.arange(40) < 12
    strata = np.arange(40) % 2
    first = label_test_within(scores, good, strata, seed=1)
    assert label_test_within(scores, good, strata, seed=1) == first
    assert label_test_within(scores, good, strata, seed=2) != first
