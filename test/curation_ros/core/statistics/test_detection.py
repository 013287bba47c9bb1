"""AUROC, its intervals and what is kept: by hand, brute force, scikit-learn and simulation."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm
from sklearn.metrics import roc_auc_score

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.detection import (
    auroc,
    auroc_interval,
    auroc_interval_over_clusters,
    evaluate_kept,
    partial_auroc,
)

#: Of a coverage simulated with 2000 draws: two standard errors of 0.95.
COVERAGE_TOLERANCE = 0.01
Z95 = 1.959963984540054

scored = st.integers(2, 40).flatmap(
    lambda n: st.tuples(
        st.lists(st.integers(-5, 5).map(float), min_size=n, max_size=n),
        st.lists(st.booleans(), min_size=n, max_size=n).filter(lambda x: 0 < sum(x) < len(x)),
    )
)
numbers = st.tuples(st.integers(1, 200), st.integers(1, 200), st.floats(0, 1))


def variance(value: float, m: int, n: int) -> float:
    """Newcombe's method 4, written out again as in his paper."""
    star = (m + n) / 2 - 1
    return (
        value
        * (1 - value)
        * (1 + star * (1 - value) / (2 - value) + star * value / (1 + value))
        / (m * n)
    )


def de_long(scores: np.ndarray, good: np.ndarray) -> tuple[float, float]:
    """DeLong's interval, by its definition."""
    won = (scores[good][:, None] > scores[~good]) + 0.5 * (scores[good][:, None] == scores[~good])
    half = Z95 * math.sqrt(
        won.mean(axis=1).var(ddof=1) / good.sum() + won.mean(axis=0).var(ddof=1) / (~good).sum()
    )
    return won.mean() - half, won.mean() + half


# --- AUROC --------------------------------------------------------------------------------------


def test_auroc_by_hand_with_a_tie() -> None:
    # Good 3 and 2 against bad 2, 1, 0: 3 wins three times, 2 wins twice and ties once.
    assert auroc([3, 2, 2, 1, 0], [True, True, False, False, False]) == 5.5 / 6


@given(scored)
def test_auroc_is_that_of_scikit_learn(data: tuple[list[float], list[bool]]) -> None:
    scores, good = data
    assert auroc(scores, good) == pytest.approx(roc_auc_score(good, scores), abs=1e-12)


@given(scored)
def test_auroc_mirrors_when_labels_or_scores_are_flipped(
    data: tuple[list[float], list[bool]],
) -> None:
    scores, good = data
    mirrored = pytest.approx(1 - auroc(scores, good), abs=1e-12)
    assert auroc(scores, [not g for g in good]) == mirrored
    assert auroc([-s for s in scores], good) == mirrored


def test_constant_score_is_chance() -> None:
    assert auroc([1.0] * 7, [True] * 2 + [False] * 5) == 0.5


@pytest.mark.parametrize(
    ("scores", "good", "message"),
    [
        ([1.0, 2.0], [True, True], "2 of 2 are good"),
        ([1.0, 2.0], [False, False], "0 of 2 are good"),
        ([1.0, math.nan], [True, False], "not finite"),
        ([1.0, 2.0, 3.0], [True, False], "expected one of each"),
        ([], [], "0 of 0 are good"),
    ],
)
def test_wrong_input_raises(scores: list[float], good: list[bool], message: str) -> None:
    for figure in (auroc, partial_auroc):
        with pytest.raises(ConfigError, match=message):
            figure(scores, good)


# --- its interval -------------------------------------------------------------------------------


def test_lower_bound_at_one_by_hand() -> None:
    # m = n = 1: the mean of both numbers less 1 is 0, the variance v (1 - v). (1 - v)^2 =
    # z^2 v (1 - v) gives 1 - v = z^2 v, so v = 1 / (1 + z^2): Wilson's bound of one in one.
    assert auroc_interval(1.0, 1, 1) == (pytest.approx(1 / (1 + Z95**2), abs=1e-9), 1.0)
    # 16 good, 64 bad: no closed form, so the equation itself is the expectation.
    low, high = auroc_interval(1.0, 16, 64)
    assert high == 1.0
    assert (1 - low) ** 2 == pytest.approx(Z95**2 * variance(low, 16, 64), abs=1e-10)


@pytest.mark.parametrize(("m", "n", "estimate"), [(16, 64, 0.638), (10, 8, 0.86875), (3, 4, 0.5)])
def test_bounds_are_the_outermost_values_within_z_standard_errors(
    m: int, n: int, estimate: float
) -> None:
    grid = np.linspace(0, 1, 1_000_001)
    inside = grid[(grid - estimate) ** 2 <= Z95**2 * variance(grid, m, n)]
    found = auroc_interval(estimate, m, n)
    assert found == pytest.approx((inside.min(), inside.max()), abs=2e-6)


def test_interval_of_the_papers_alignment_is_as_wide_as_de_long() -> None:
    # metrics.md, section 3: AUROC 0.638 of 16 against 64 has [0.48, 0.80] by DeLong.
    low, high = auroc_interval(0.638, 16, 64)
    assert (low, high) == (pytest.approx(0.48, abs=0.02), pytest.approx(0.80, abs=0.05))


@given(numbers)
def test_interval_holds_the_estimate_has_a_width_and_mirrors(
    given_numbers: tuple[int, int, float],
) -> None:
    m, n, estimate = given_numbers
    low, high = auroc_interval(estimate, m, n)
    assert 0 <= low <= estimate <= high <= 1
    assert high - low > 1e-3
    mirrored = auroc_interval(1 - estimate, n, m)
    assert mirrored == (pytest.approx(1 - high, abs=1e-9), pytest.approx(1 - low, abs=1e-9))


def test_more_episodes_narrow_the_interval_also_at_one() -> None:
    lows = [auroc_interval(1.0, n, 4 * n)[0] for n in (2, 4, 16, 64, 256)]
    assert lows == sorted(lows)
    assert lows[-1] > 0.99


@pytest.mark.parametrize("bad", [(1.1, 3, 3), (0.5, 0, 3), (0.5, 3, 0), (math.nan, 3, 3)])
def test_interval_of_nonsense_raises(bad: tuple[float, int, int]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        auroc_interval(*bad)


@pytest.mark.parametrize("true_auroc", [0.5, 0.638, 0.8, 0.95, 0.99])
@pytest.mark.parametrize("step", [0.0, 1.0], ids=["continuous", "tied"])
def test_interval_has_its_nominal_coverage(
    rng: np.random.Generator, true_auroc: float, step: float
) -> None:
    m, n, draws = 16, 64, 2000
    shift = math.sqrt(2) * norm.ppf(true_auroc)
    good = np.arange(m + n) < m
    scores = rng.standard_normal((draws, m + n)) + shift * good
    truth = true_auroc
    if step:  # scores of a few values: the share of ties counts half in what is estimated
        scores = np.round(scores / step) * step
        edges = np.arange(-12, 13) * step
        mass_good = np.diff(norm.cdf(np.append(edges, 13 * step) - step / 2 - shift))
        mass_bad = np.diff(norm.cdf(np.append(edges, 13 * step) - step / 2))
        below = np.cumsum(mass_bad) - mass_bad / 2
        truth = float(mass_good @ below)
    found, times = np.unique([auroc(row, good) for row in scores], return_counts=True)
    held = [low <= truth <= high for low, high in (auroc_interval(v, m, n) for v in found)]
    covered = int(times @ held)
    assert covered / draws >= 0.95 - COVERAGE_TOLERANCE


def test_interval_is_about_de_longs_in_the_interior(rng: np.random.Generator) -> None:
    good = np.arange(400) < 200
    for shift in (0.0, 0.5, 1.0):
        scores = rng.standard_normal(400) + shift * good
        ours = auroc_interval(auroc(scores, good), 200, 200)
        assert ours == pytest.approx(de_long(scores, good), abs=0.015)


def test_interval_over_starts_widens_when_episodes_of_a_start_are_alike(
    rng: np.random.Generator,
) -> None:
    # 16 starts of 5 episodes that are all the same: there are 16 observations, not 80.
    start = np.repeat(np.arange(16), 5)
    good = start < 6
    scores = (rng.standard_normal(16) + 0.8 * (np.arange(16) < 6))[start]
    alike = auroc_interval_over_clusters(scores, good, list(start))
    apart = auroc_interval(auroc(scores, good), int(good.sum()), int((~good).sum()))
    assert alike is not None
    assert alike[1] - alike[0] > 1.3 * (apart[1] - apart[0])


def test_interval_over_starts_is_that_of_a_plain_resampling(rng: np.random.Generator) -> None:
    start = np.repeat(np.arange(12), 3)
    good = np.tile([True, False, False], 12)
    scores = np.round(rng.standard_normal(36) + good, 1)
    found = auroc_interval_over_clusters(scores, good, list(start), seed=3, n_resamples=4000)
    drawn = []
    for _ in range(4000):
        chosen = np.concatenate([np.flatnonzero(start == s) for s in rng.integers(0, 12, 12)])
        drawn.append(auroc(scores[chosen], good[chosen]))
    assert found == pytest.approx(tuple(np.percentile(drawn, [2.5, 97.5])), abs=0.015)
    again = auroc_interval_over_clusters(scores, good, list(start), seed=3, n_resamples=4000)
    assert again == found


def test_interval_over_starts_is_none_without_information() -> None:
    scores, good = [2.0, 2.0, 1.0, 1.0], [True, True, False, False]
    assert auroc_interval_over_clusters(scores, good, ["a", "b", "c", "d"]) is None
    assert auroc_interval_over_clusters(scores, good, ["a", "a", "a", "a"]) is None
    assert auroc_interval_over_clusters(scores, good, ["a", "b", "a", "b"]) is None


# --- the top of the ranking ---------------------------------------------------------------------


def test_partial_auroc_is_a_half_at_chance_and_one_when_perfect() -> None:
    good = [True] * 5 + [False] * 20
    assert partial_auroc([1.0] * 25, good) == pytest.approx(0.5)
    assert partial_auroc([1.0] * 5 + [0.0] * 20, good) == pytest.approx(1.0)


def test_partial_auroc_by_hand() -> None:
    # One good episode below one of ten bad ones: the curve is 0 up to a false positive rate of
    # 0.1, then 1. Area up to 0.2: 0.1. McClish: (1 + (0.1 - 0.02) / (0.2 - 0.02)) / 2.
    scores = [9.0, 10.0, *range(9)]
    assert partial_auroc(scores, [True] + [False] * 10) == pytest.approx((1 + 0.08 / 0.18) / 2)


def test_what_is_kept_by_hand_with_a_tie_at_the_cut() -> None:
    # 3 | 2 2 2 | 1: of the three at the cut, two of them good, one is kept.
    found = evaluate_kept([3, 2, 2, 2, 1], [False, True, True, False, True], 2)
    assert found.precision == pytest.approx((0 + 2 / 3) / 2)
    assert found.clean_recall == pytest.approx(2 / 3 / 3)
    assert (found.tied_at_cut, found.purity_ceiling) == (3 / 5, 1.0)


@given(scored, st.integers(1, 40))
def test_what_is_kept_is_the_mean_over_every_order_of_the_ties(
    data: tuple[list[float], list[bool]], n_kept: int
) -> None:
    scores, good = data[0][:6], data[1][:6]
    n_kept = min(n_kept, len(scores))
    if not 0 < sum(good) < len(good):
        return
    orders = itertools.permutations(range(len(scores)))
    shares = [
        sum(good[k] for k in sorted(order, key=lambda k: -scores[k])[:n_kept]) / n_kept
        for order in orders
    ]
    found = evaluate_kept(scores, good, n_kept)
    assert found.precision == pytest.approx(np.mean(shares))
    assert (found.tied_at_cut == 0.0) or len(set(scores)) < len(scores)
    assert found.precision <= found.purity_ceiling + 1e-12


def test_constant_score_keeps_good_episodes_at_chance_level() -> None:
    found = evaluate_kept([1.0] * 80, [True] * 16 + [False] * 64, 60)
    assert found.precision == pytest.approx(0.2)
    assert found.clean_recall == pytest.approx(0.75)
    assert found.tied_at_cut == 1.0
    assert found.purity_ceiling == 16 / 60  # the paper's protocol: 44 of 60 are bad at best


def test_good_episodes_without_a_score_count_as_lost() -> None:
    found = evaluate_kept([2.0, 1.0], [True, False], 1, n_good=2)
    assert (found.precision, found.clean_recall) == (1.0, 0.5)


@pytest.mark.parametrize("n_kept", [0, 3])
def test_keeping_none_or_more_than_there_are_raises(n_kept: int) -> None:
    with pytest.raises(ConfigError, match="expected 1 to 2"):
        evaluate_kept([2.0, 1.0], [True, False], n_kept)
