"""Statistics of policies: values by hand, brute force, other libraries, coverage by simulation."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.policy_statistics import (
    SeedCount,
    contrast,
    deviations,
    gap_closed,
    holm,
    minimum_detectable_difference,
    modes,
    rank_correlation_exact,
    seed_counts,
    sign_flip_p,
    success_rate,
)

# Table II of the paper: AUROC and success of its seven metrics.
PAPER_AUROC = (0.761, 0.638, 0.280, 0.447, 0.712, 0.804, 0.440)
PAPER_SUCCESS = (91.1, 90.0, 77.8, 63.3, 58.9, 13.3, 3.3)


def outcomes(rows: list[list[int]]) -> dict[tuple[int, str], bool]:
    return {
        (seed, f"start-{k}"): bool(one)
        for seed, row in enumerate(rows)
        for k, one in enumerate(row)
    }


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


def test_sign_flip_p_by_hand_and_its_floor() -> None:
    # Of the 8 sign choices of (3, 2, 1), only all plus and all minus reach 6.
    assert sign_flip_p([3, 2, 1]) == 2 / 8
    assert contrast(outcomes([[1]] * 3), outcomes([[0]] * 3)).p_floor == 0.25
    assert sign_flip_p([0.0, 0.0]) == 1.0


def test_holm_by_hand_counts_planned_contrasts_without_a_p() -> None:
    found = holm({"a": 0.01, "b": 0.04, "c": 0.03, "d": None})
    assert found == {
        "a": pytest.approx(0.04),
        "b": pytest.approx(0.09),  # 2 x 0.04 is less than c's
        "c": pytest.approx(0.09),
    }
    with pytest.raises(ConfigError, match="1 planned"):
        holm({"a": 0.1, "b": 0.2}, n_planned=1)


def test_contrast_pairs_by_key_and_counts_what_has_no_partner() -> None:
    a, b = outcomes([[1, 1, 0], [1, 0, 1]]), outcomes([[0, 1, 0], [0, 0, 1]])
    backwards = dict(reversed(b.items()))
    del backwards[(1, "start-2")]
    found = contrast(a, backwards)
    assert found.estimate.value == pytest.approx((1 / 3 + 1 / 2) / 2)
    assert (found.estimate.n_rollouts, found.estimate.n_unpaired) == (5, 1)
    with pytest.raises(ConfigError, match="none"):
        contrast(a, {(9, "start-0"): True})


def test_equal_conditions_give_no_zero_width_and_p_one() -> None:
    found = contrast(outcomes([[1, 0]] * 10), outcomes([[1, 0]] * 10))
    assert found.estimate.is_degenerate
    low, high = found.estimate.interval or (0, 0)
    assert low == -high
    assert high > 0.5  # two starts bound it, not ten seeds
    assert found.p == 1.0


def test_bound_at_no_success_is_one_rollout_a_seed() -> None:
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


def test_deviations_of_the_papers_gripper_timing_are_the_populations() -> None:
    sample, population = deviations([0, 100 / 30, 1100 / 30])
    assert population == pytest.approx(16.6, abs=0.1)  # as the paper prints it
    assert sample == pytest.approx(population * 1.5**0.5)
    assert deviations([1.0]) == (None, 0.0)


def test_seeds_that_fail_and_work_are_shown_as_two_modes() -> None:
    rows = outcomes([[0] * 10, [1] * 9 + [0], [1, 0] * 5])
    assert seed_counts(rows) == [SeedCount(0, 0, 10), SeedCount(1, 9, 10), SeedCount(2, 5, 10)]
    found = modes(seed_counts(rows))
    assert (found.low, found.middle, found.high, found.is_bimodal) == (1, 1, 1, True)


def test_minimum_detectable_difference_has_its_power_in_simulation() -> None:
    difference = minimum_detectable_difference(1.0, 10)
    rng = np.random.default_rng(20260608)
    drawn = rng.normal(difference, 1.0, size=(4000, 10))
    assert np.mean(stats.ttest_1samp(drawn, 0, axis=1).pvalue < 0.05) == pytest.approx(
        0.8, abs=0.03
    )
    assert minimum_detectable_difference(0.0, 3) == 0.0
