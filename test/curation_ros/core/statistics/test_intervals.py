"""Intervals: values worked by hand, limits, symmetry, coverage."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import bdtr

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.intervals import clopper_pearson, wilson

Interval = Callable[..., tuple[float, float]]
BOTH = pytest.mark.parametrize("interval", [wilson, clopper_pearson])


def test_wilson_of_28_in_30_by_hand() -> None:
    # z = 1.959964, z^2/n = 0.128049; centre (0.933333 + 0.064024) / 1.128049 = 0.884144;
    # half 1.959964 / 1.128049 * sqrt(0.0622222/30 + 3.841459/3600) = 0.097379.
    low, high = wilson(28, 30)
    assert low == pytest.approx(0.884144 - 0.097379, abs=2e-6)
    assert high == pytest.approx(0.884144 + 0.097379, abs=2e-6)
    assert (round(low, 3), round(high, 3)) == (0.787, 0.982)


def test_clopper_pearson_of_all_and_none_by_hand() -> None:
    assert clopper_pearson(30, 30) == (pytest.approx(0.025 ** (1 / 30)), 1.0)
    assert clopper_pearson(0, 10) == (0.0, pytest.approx(1 - 0.025**0.1))


def test_clopper_pearson_bounds_put_half_the_error_in_each_tail() -> None:
    low, high = clopper_pearson(28, 30)
    assert 1 - bdtr(27, 30, low) == pytest.approx(0.025)
    assert bdtr(28, 30, high) == pytest.approx(0.025)


@BOTH
@given(n=st.integers(1, 400), share=st.floats(0, 1), confidence=st.floats(0.5, 0.999))
def test_interval_holds_the_estimate_and_mirrors(
    interval: Interval, n: int, share: float, confidence: float
) -> None:
    k = round(share * n)
    low, high = interval(k, n, confidence)
    assert 0 <= low <= k / n <= high <= 1
    mirrored = interval(n - k, n, confidence)
    assert mirrored == (pytest.approx(1 - high, abs=1e-9), pytest.approx(1 - low, abs=1e-9))


@BOTH
def test_more_trials_or_less_confidence_narrow_it(interval: Interval) -> None:
    def width(k: int, n: int, confidence: float = 0.95) -> float:
        low, high = interval(k, n, confidence)
        return high - low

    assert width(90, 100) < width(27, 30)
    assert width(27, 30, 0.8) < width(27, 30)


def test_clopper_pearson_has_at_least_its_nominal_coverage() -> None:
    n = 30
    for p in (0.03, 0.5, 0.9, 0.97):
        covered = sum(
            math.comb(n, k) * p**k * (1 - p) ** (n - k)
            for k in range(n + 1)
            if clopper_pearson(k, n)[0] <= p <= clopper_pearson(k, n)[1]
        )
        assert covered >= 0.95


@BOTH
@pytest.mark.parametrize(
    "bad", [(1, 0), (-1, 3), (4, 3), (1.5, 3), (1, 3, 0.0), (1, 3, 1.0), (1, 3, math.nan)]
)
def test_bad_input_raises(interval: Interval, bad: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        interval(*bad)
