"""Sign flips, Holm's method and detectable differences: by hand and by simulation."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.significance import (
    holm,
    minimum_detectable_difference,
    sign_flip_p,
)


def test_sign_flip_p_by_hand() -> None:
    # Of the 8 sign choices of (3, 2, 1), only all plus and all minus reach 6.
    assert sign_flip_p([3, 2, 1]) == 2 / 8
    assert sign_flip_p([1, 1, 1]) == 2 / 8  # the least that three seeds can give
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


def test_minimum_detectable_difference_has_its_power_in_simulation() -> None:
    difference = minimum_detectable_difference(1.0, 10)
    rng = np.random.default_rng(20260608)
    drawn = rng.normal(difference, 1.0, size=(4000, 10))
    assert np.mean(stats.ttest_1samp(drawn, 0, axis=1).pvalue < 0.05) == pytest.approx(
        0.8, abs=0.03
    )
    assert minimum_detectable_difference(0.0, 3) == 0.0
