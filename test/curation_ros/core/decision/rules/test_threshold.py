"""Rule `threshold`: what it fits, how it compares, what it says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from cases import case, explained
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.rules import Case
from curation_ros.core.decision.rules.threshold import Threshold
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

FINITE = st.floats(-1e6, 1e6)


def test_threshold_of_saturated_references_lies_a_resolution_below_the_lowest() -> None:
    rule = Threshold(scorer="gripper_timing").fit(
        [0.987, 1.0, 1.0, 1.0, 1.0, 1.0], resolution=0.05
    )
    assert rule.threshold_ == pytest.approx(0.937)


def test_threshold_of_spread_references_by_hand() -> None:
    # median 3, MAD 1; t(.99, 4) = 3.74695, times sqrt(1.2) = 4.10458, times 1.4826 = 6.08545.
    rule = Threshold(scorer="s").fit([1, 2, 3, 4, 5], resolution=0.1)
    assert rule.threshold_ == pytest.approx(3 - 6.08545, abs=1e-4)


@given(st.lists(FINITE, min_size=3, max_size=12), st.floats(0, 10))
def test_fitted_threshold_is_finite_and_keeps_every_reference(
    scores: list[float], resolution: float
) -> None:
    rule = Threshold(scorer="s").fit(scores, resolution=resolution)
    assert math.isfinite(rule.threshold_)
    assert rule.threshold_ <= min(scores) - resolution
    assert all(rule.verdict(case(x))[0] == "keep" for x in scores)


@given(st.permutations([1.0, 2.0, 2.0, 5.0, 7.5]))
def test_threshold_does_not_depend_on_the_order_of_references(scores: list[float]) -> None:
    fitted = Threshold(scorer="s").fit(scores).threshold_
    assert fitted == Threshold(scorer="s").fit(sorted(scores)).threshold_


@pytest.mark.parametrize(("n", "limit"), [(3, 0.06), (6, 0.04), (20, 0.02)])
def test_false_alarms_are_what_the_docstring_says(n: int, limit: float) -> None:
    rng = np.random.default_rng(0)
    hits = [
        rng.standard_normal() < Threshold(scorer="s").fit(rng.standard_normal(n)).threshold_
        for _ in range(3000)
    ]
    assert np.mean(hits) < limit + 0.01


def test_threshold_needs_three_finite_references() -> None:
    with pytest.raises(EpisodeError, match="needs 3 reference episodes, there are 2"):
        Threshold(scorer="s").fit([1.0, 1.0])
    with pytest.raises(EpisodeError, match="not finite"):
        Threshold(scorer="s").fit([1.0, 1.0, float("nan")])
    with pytest.raises(NotFittedError):
        Threshold(scorer="s").verdict(case(1.0))


def test_given_threshold_needs_nothing_and_is_inclusive() -> None:
    rule = Threshold(scorer="s", threshold=0.5)
    assert rule.needs == "nothing"
    assert Threshold(scorer="s").needs == "reference"
    assert rule.verdict(case(0.5)) == ("keep", "s 0.50 at or above 0.50, as configured")
    assert rule.verdict(case(0.49)) == ("discard", "s 0.49 below 0.50, as configured")


def test_reason_shows_enough_digits_and_prefers_the_explanation() -> None:
    rule = Threshold(scorer="s").fit([-2.75] * 6, resolution=0.05)
    assert rule.verdict(case(-3.21)) == ("discard", "s -3.21 below -2.80, fitted on 6 references")
    close = Threshold(scorer="s", threshold=0.5).verdict(case(0.49999))[1]
    assert close == "s 0.49999 below 0.50000, as configured"
    assert rule.verdict(explained(-9.0, "the arm shook"))[1] == "the arm shook"
    assert "at or above" in rule.verdict(explained(-1.0, "the arm shook"))[1]


def test_abstained_scorer_leads_to_review_with_its_reason() -> None:
    rule = Threshold(scorer="s", threshold=0.5)
    assert rule.verdict(case(None, why="no fingers")) == ("review", "s cannot tell: no fingers")
    assert rule.verdict(Case("e", {})) == ("review", "s cannot tell: it was not asked")


@pytest.mark.parametrize(
    ("bad", "said"),
    [
        ({"threshold": math.nan}, "threshold is nan, expected a finite number"),
        ({"threshold": math.inf}, "threshold is inf, expected a finite number"),
        ({"false_alarm": 0.0}, "false_alarm is 0.0, expected a number above 0 and below 0.5"),
        ({"false_alarm": 0.5}, "false_alarm is 0.5"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(bad: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=f"rule 'threshold': {said}"):
        Threshold(scorer="s", **bad).check_params()
