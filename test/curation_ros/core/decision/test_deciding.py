"""From an examination to a decision: faults, failed tasks, salvage, and what goes with it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from curation_ros.core.decision.deciding import decide
from curation_ros.core.decision.decision import NOTED
from curation_ros.core.decision.examination import Examination, Part, Scores
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.decision.rules.threshold import Threshold
from curation_ros.core.episode.findings import FINDINGS, Finding


def examined(
    scores: Scores, *, findings: tuple[Finding, ...] = (), part: Part | None = None
) -> Examination:
    return Examination("e", "pick-1", 10, (0, 90), scores, findings=findings, part=part)


def at_zero() -> FittedRule:
    """A rule that keeps scores from 0."""
    return FittedRule(Threshold(scorer="s", threshold=0.0), fitted_on={"what": "nothing"})


def test_decision_covers_the_whole_episode_and_carries_what_it_was_given() -> None:
    examination = Examination(
        "e", "pick-1", 10, (0, 90), {"s": 1.0, "t": None}, {"t": "why"}, evidence={"x": [1, 2]}
    )
    rule = replace(at_zero(), scoring_hash="f00", state_hash="abc")
    got = decide(examination, rule)
    assert (got.verdict, got.span) == ("keep", (0, 90))
    assert (got.episode, got.name, got.revision, got.by) == ("e", "pick-1", 1, "curator")
    assert (got.scores, got.abstained) == ({"s": 1.0, "t": None}, {"t": "why"})
    assert got.state_hash == "abc"
    assert got.evidence == {
        "x": [1, 2],
        "basis": "final",
        "fitted_on": {"what": "nothing"},
        "scoring": "f00",
        "content": "",
        "threshold": 0.0,
        "decided_by": "s",
    }


def test_without_a_rule_it_is_review_no_reference() -> None:
    got = decide(examined({"s": 1.0}), FittedRule(None))
    assert (got.verdict, got.reason) == ("review", "no reference")


@pytest.mark.parametrize("finding_id", sorted(FINDINGS))
def test_faulty_recording_is_never_kept_in_silence(finding_id: str) -> None:
    finding = Finding(finding_id, "what was found", (0, 10))
    rule = at_zero()
    stops = finding.kind == "recording" and finding_id not in NOTED
    for score in (1.0, -1.0):
        got = decide(examined({"s": score}, findings=(finding,)), rule)
        assert got.findings == (finding,)
        if stops:
            assert got.verdict == "review"
            assert got.reason == f"{finding_id}: what was found"
        elif finding.kind == "task" and score > 0:
            assert got.verdict == "review"
            assert got.reason == f"{finding_id}: what was found; but s 1.00 at or above 0.00, " + (
                "as configured"
            )
        else:
            assert got.verdict == ("keep" if score > 0 else "discard")


@pytest.mark.parametrize(
    ("score", "verdict", "span"), [(1.0, "salvage", (10, 60)), (-1.0, "review", (0, 90))]
)
def test_sound_part_is_salvaged_where_the_rule_keeps_it(
    score: float, verdict: str, span: tuple[int, int]
) -> None:
    fault = Finding("padded-tail", "the last 3 steps repeat", (70, 90))
    part = Part((10, 60), "padded-tail: the last 3 steps repeat", {"s": score})
    rule = at_zero()
    got = decide(examined({"s": 1.0}, findings=(fault,), part=part), rule)
    assert (got.verdict, got.span) == (verdict, span)
    assert "padded-tail: the last 3 steps repeat" in got.reason
    assert (
        decide(examined({"s": 1.0}, findings=(fault,), part=part), FittedRule(None)).verdict
        == "review"
    )


def test_empty_episode_is_decided_without_an_error() -> None:
    got = decide(Examination("e", "n", 0, (0, 0), {"s": None}), at_zero())
    assert (got.verdict, got.span) == ("review", (0, 0))
