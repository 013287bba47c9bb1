"""Decisions: rules, reasons, order of authority, and the line in the log."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from episodes import make_episode
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decisions import (
    NOTED,
    RULES,
    VERDICTS,
    Decision,
    NoRule,
    Threshold,
    decide,
    in_force,
    override,
    untrustworthy,
)
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.findings import FINDINGS, Finding

FINITE = st.floats(-1e6, 1e6)


def decision(revision: int = 1, by: str = "curator", episode: str = "e") -> Decision:
    return Decision(episode, "pick-1", "keep", "r", (0, 5), revision=revision, by=by)


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


# --- decide -------------------------------------------------------------------------------------


def test_decision_covers_the_whole_episode_and_carries_what_it_was_given() -> None:
    episode = make_episode()
    got = decide(
        episode,
        {"s": 1.0, "t": None},
        Threshold(scorer="s", threshold=0.0),
        abstained={"t": "why"},
        evidence={"x": [1, 2]},
        revision=3,
        state_hash="abc",
    )
    assert got.verdict == "keep"
    assert got.span == (0, episode.end_ns - episode.start_ns)
    assert len(episode.within(got.span)) == len(episode)
    assert (got.episode, got.name, got.revision, got.by) == (episode.id, "pick-1", 3, "curator")
    assert (got.scores, got.abstained) == ({"s": 1.0, "t": None}, {"t": "why"})
    assert (got.evidence, got.state_hash) == ({"x": [1, 2]}, "abc")


def test_without_a_rule_it_is_review_no_reference() -> None:
    got = decide(make_episode(), {"s": 1.0}, None)
    assert (got.verdict, got.reason) == ("review", "no reference")


@pytest.mark.parametrize("finding_id", sorted(FINDINGS))
def test_faulty_recording_is_never_kept_in_silence(finding_id: str) -> None:
    finding = Finding(finding_id, "what was found", (0, 10))
    episode = make_episode(findings=[finding])
    for score in (1.0, -1.0):
        got = decide(episode, {"s": score}, Threshold(scorer="s", threshold=0.0))
        assert got.findings == (finding,)
        if finding_id in NOTED:
            assert got.verdict == ("keep" if score > 0 else "discard")
        else:
            assert got.verdict == "review"
            assert got.reason == f"{finding_id}: what was found"


def test_only_faults_of_the_recording_are_untrustworthy() -> None:
    assert set(NOTED) <= {k for k, (kind, _) in FINDINGS.items() if kind == "recording"}
    noted = Finding("no-bag", "m", (0, 0))
    gap = Finding("gap", "m", (0, 0))
    assert untrustworthy([noted, gap]) == [gap]


def test_empty_episode_is_decided_without_an_error() -> None:
    got = decide(make_episode(n_steps=0), {"s": None}, Threshold(scorer="s", threshold=0.0))
    assert (got.verdict, got.span) == ("review", (0, 0))


# --- authority ----------------------------------------------------------------------------------


def test_person_outranks_the_curator_and_the_latest_revision_counts() -> None:
    log = [decision(1), decision(2, by="anna"), decision(3)]
    assert in_force(log)["e"].by == "anna"
    assert in_force([decision(1), decision(2)])["e"].revision == 2
    assert in_force([decision(2, by="anna"), decision(4, by="ben")])["e"].by == "ben"
    assert set(in_force([decision(episode="a"), decision(episode="b")])) == {"a", "b"}


def test_override_is_the_next_revision_on_the_same_evidence() -> None:
    before = Decision("e", "n", "keep", "r", (0, 9), scores={"s": 1.0}, evidence={"x": 1})
    after = override(before, "salvage", "dropped late", by="anna", span=(0, 4))
    assert (after.revision, after.verdict, after.span, after.by) == (2, "salvage", (0, 4), "anna")
    assert (after.scores, after.evidence) == (before.scores, before.evidence)
    with pytest.raises(EpisodeError, match="no person"):
        override(before, "keep", "r", by="curator")


# --- JSON ---------------------------------------------------------------------------------------


@given(
    st.sampled_from(VERDICTS),
    st.dictionaries(st.text(min_size=1), st.none() | FINITE, max_size=4),
    st.text(),
    st.tuples(st.integers(0, 10**12), st.integers(0, 10**12)).map(sorted),
)
def test_decision_survives_its_line(
    verdict: str, scores: dict[str, float | None], text: str, span: list[int]
) -> None:
    before = Decision(
        episode="e",
        name=text,
        verdict=verdict,  # type: ignore[arg-type]
        reason=text,
        span=(span[0], span[1]),
        scores=scores,
        abstained={k: text for k, v in scores.items() if v is None},
        findings=(Finding("gap", text, (1, 2)),),
        evidence={"a": [1, None, {"b": text}]},
        revision=7,
        by="anna",
        state_hash="f00",
    )
    line = before.to_line()
    assert "\n" not in line
    assert Decision.from_line(line) == before
    assert Decision.from_json(json.loads(line)) == before


@pytest.mark.parametrize("score", [math.nan, math.inf, -math.inf])
def test_score_that_is_not_finite_is_refused(score: float) -> None:
    with pytest.raises(EpisodeError, match="abstained is None"):
        Decision("e", "n", "keep", "r", (0, 1), scores={"s": score})


@pytest.mark.parametrize(
    "change",
    [
        {"verdict": "maybe"},
        {"span": [5, 1]},
        {"span": [5]},
        {"span": None},
        {"scores": {"s": "high"}},
        {"scores": None},
        {"findings": [{"id": "gap"}]},
        {"revision": "two"},
    ],
)
def test_bad_line_is_refused(change: dict[str, object]) -> None:
    raw = {**decision().to_json(), **change}
    with pytest.raises(EpisodeError, match="decision"):
        Decision.from_json(raw)


def test_missing_key_and_broken_line_are_refused_and_unknown_keys_are_not() -> None:
    raw = decision().to_json()
    assert Decision.from_json({**raw, "written_at": "later"}) == decision()
    for key in raw:
        with pytest.raises(EpisodeError):
            Decision.from_json({k: v for k, v in raw.items() if k != key})
    for line in ("", "{", "[]", "null", '{"episode": "e"'):
        with pytest.raises(EpisodeError):
            Decision.from_line(line)
