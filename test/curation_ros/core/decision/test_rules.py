"""Rules: thresholds, shares, numbers, groups; what each says, and what it never does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.rules import RULES, Gap, NoRule, Rule, Threshold, TopFraction, TopK
from curation_ros.core.decision.selection import Candidate, select, tie_key
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

FINITE = st.floats(-1e6, 1e6)
SCORES = st.dictionaries(st.uuids().map(str), st.integers(-4, 4).map(float), min_size=4)


# --- threshold ----------------------------------------------------------------------------------


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
    assert all(rule.judge({"s": x}, {}, {})[0] == "keep" for x in scores)


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
        Threshold(scorer="s").judge({"s": 1.0}, {}, {})


def test_given_threshold_needs_nothing_and_is_inclusive() -> None:
    rule = Threshold(scorer="s", threshold=0.5)
    assert rule.needs == "nothing"
    assert rule.judge({"s": 0.5}, {}, {}) == ("keep", "s 0.50 at or above 0.50, as configured")
    assert rule.judge({"s": 0.49}, {}, {}) == ("discard", "s 0.49 below 0.50, as configured")


def test_reason_shows_enough_digits_and_prefers_the_scorers_words() -> None:
    rule = Threshold(scorer="smoothness").fit([-2.75] * 6, resolution=0.05)
    assert rule.judge({"smoothness": -3.21}, {}, {}) == (
        "discard",
        "smoothness -3.21 below -2.80, fitted on 6 references",
    )
    close = Threshold(scorer="s", threshold=0.5).judge({"s": 0.49999}, {}, {})[1]
    assert close == "s 0.49999 below 0.50000, as configured"
    words = {"smoothness": "the arm shook", "other": "no"}
    assert rule.judge({"smoothness": -9.0}, {}, words)[1] == "the arm shook"
    assert "at or above" in rule.judge({"smoothness": -1.0}, {}, words)[1]


def test_abstained_scorer_leads_to_review_with_its_reason() -> None:
    rule = Threshold(scorer="s", threshold=0.5)
    assert rule.judge({"s": None}, {"s": "no fingers"}, {}) == (
        "review",
        "s cannot tell: no fingers",
    )
    assert rule.judge({}, {}, {})[0] == "review"


@pytest.mark.parametrize(
    "bad", [{"threshold": math.nan}, {"threshold": math.inf}, {"false_alarm": 0.0}]
)
def test_bad_rule_parameters_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        Threshold(scorer="s", **bad)


def test_rule_none_reviews_always() -> None:
    assert RULES["none"] is NoRule
    assert NoRule(scorer="s").judge({"s": 1.0}, {}, {})[0] == "review"


# --- over a dataset -----------------------------------------------------------------------------


def verdicts(rule: Rule, scores: dict[str, float]) -> dict[str, str]:
    return {i: rule.judge({"s": x}, {}, {}, i)[0] for i, x in scores.items()}


def in_two_groups(n_low: int = 16, n_high: int = 8) -> dict[str, float]:
    rng = np.random.default_rng(3)
    low, high = rng.normal(0.4, 0.02, n_low), rng.normal(0.9, 0.02, n_high)
    return {f"e{k:02d}": float(x) for k, x in enumerate([*low, *high])}


@pytest.mark.parametrize("name", sorted(RULES))
def test_rules_say_what_they_need_and_describe_themselves(name: str) -> None:
    rule = RULES[name](scorer="s")
    assert rule.needs in ("nothing", "reference", "dataset")
    assert rule.describe()
    assert rule.params()["scorer"] == "s"
    if rule.needs == "dataset":
        with pytest.raises(NotFittedError):
            rule.judge({"s": 1.0}, {}, {}, "e")
        with pytest.raises(EpisodeError, match="scored episodes; there are 2"):
            rule.fit_dataset({"a": 1.0, "b": 2.0})


def test_best_share_by_hand() -> None:
    scores = {"a": 4.0, "b": 3.0, "c": 2.0, "d": 1.0}
    rule = TopFraction(scorer="s").fit_dataset(scores)
    assert verdicts(rule, scores) == {"a": "keep", "b": "keep", "c": "keep", "d": "discard"}
    assert rule.cut == 2.0
    assert rule.judge({"s": 2.0}, {}, {}, "c")[1] == "s 2.00 is among the best 3 of 4"
    assert rule.judge({"s": 1.0}, {}, {"s": "it shook"}, "d")[1] == (
        "it shook; s 1.00 is not among the best 3 of 4 (cut 2.00)"
    )


def test_more_than_there_are_keeps_all() -> None:
    scores = {"a": 4.0, "b": 3.0, "c": 2.0, "d": 1.0}
    assert set(verdicts(TopK(scorer="s", value=9).fit_dataset(scores), scores).values()) == {
        "keep"
    }


def test_equal_scores_at_the_cut_are_drawn_by_lot_and_it_says_so() -> None:
    scores = dict.fromkeys("abcdef", 1.0)
    rule = TopK(scorer="s", value=2).fit_dataset(scores)
    kept = [i for i, v in verdicts(rule, scores).items() if v == "keep"]
    assert sorted(kept) == sorted(sorted(scores, key=lambda i: tie_key(0, i))[:2])
    reason = rule.judge({"s": 1.0}, {}, {}, kept[0])[1]
    assert reason == "s 1.00 is the cut of the best 2 of 6, which 6 episodes share: kept by lot"
    by_name = TopK(scorer="s", value=2).fit_dataset(scores, tie=lambda i: i)
    assert {i for i, v in verdicts(by_name, scores).items() if v == "keep"} == {"a", "b"}


@given(SCORES, st.sampled_from([0.1, 0.5, 0.75, 1.0]))
def test_decisions_of_a_share_are_the_selection_by_that_share(
    scores: dict[str, float], share: float
) -> None:
    rule = TopFraction(scorer="s", value=share).fit_dataset(scores)
    kept = {i for i, v in verdicts(rule, scores).items() if v == "keep"}
    candidates = [Candidate(i, "", x) for i, x in scores.items()]
    chosen = select(candidates, "top-fraction", share)
    assert kept == {e.episode for e in chosen.entries}


@given(SCORES, st.randoms(use_true_random=False))
def test_order_of_the_dataset_changes_nothing(scores: dict[str, float], shuffle: object) -> None:
    items = list(scores.items())
    shuffle.shuffle(items)  # type: ignore[attr-defined]
    for name in ("top-fraction", "top-k"):
        one, other = (RULES[name](scorer="s").fit_dataset(d) for d in (scores, dict(items)))
        assert one.fitted() == other.fitted()


@pytest.mark.parametrize(
    ("rule", "value"), [(TopFraction, 0.0), (TopFraction, 1.5), (TopK, 0), (TopK, 2.5)]
)
def test_bad_value_is_refused(rule: type[TopFraction | TopK], value: float) -> None:
    with pytest.raises(ConfigError):
        rule(scorer="s", value=value)


# --- groups -------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["mixture", "largest-gap"])
def test_two_groups_are_kept_and_discarded(method: str) -> None:
    scores = in_two_groups()
    rule = Gap(scorer="s", method=method).fit_dataset(scores, resolution=0.01)
    got = verdicts(rule, scores)
    assert {i for i, v in got.items() if v == "keep"} == {f"e{k:02d}" for k in range(16, 24)}
    assert set(got.values()) == {"keep", "discard"}
    assert rule.judge({"s": 0.9}, {}, {}, "x")[1].startswith(
        "s 0.90 is in the upper group, 8 of 24"
    )
    assert 0.45 < (rule.cut or 0) < 0.85


def test_score_between_the_groups_is_for_review() -> None:
    rng = np.random.default_rng(0)
    x = [*rng.normal(0.0, 1.0, 40), *rng.normal(7.0, 1.0, 40)]
    rule = Gap(scorer="s").fit_dataset({f"{k}": float(v) for k, v in enumerate(x)})
    low, high = rule.doubt_
    assert low < high
    assert rule.judge({"s": (low + high) / 2}, {}, {}, "")[0] == "review"
    assert "between the two groups" in rule.judge({"s": (low + high) / 2}, {}, {}, "")[1]
    assert rule.judge({"s": high}, {}, {}, "")[0] == "keep"
    assert rule.judge({"s": low}, {}, {}, "")[0] == "discard"


@pytest.mark.parametrize("method", ["mixture", "largest-gap"])
@pytest.mark.parametrize("kind", ["normal", "equal", "few"])
def test_one_group_is_for_review_with_the_reason(method: str, kind: str) -> None:
    rng = np.random.default_rng(1)
    values = {"normal": rng.normal(size=60), "equal": np.ones(60), "few": np.array([0.0] * 8)}
    scores = {f"{k}": float(v) for k, v in enumerate(values[kind])}
    rule = Gap(scorer="s", method=method).fit_dataset(scores, resolution=0.01)
    verdict, reason = rule.judge({"s": scores["0"]}, {}, {}, "0")
    assert verdict == "review"
    assert "no two groups" in reason


def test_unknown_method_is_refused() -> None:
    with pytest.raises(ConfigError, match="largest-gap"):
        Gap(scorer="s", method="otsu")
