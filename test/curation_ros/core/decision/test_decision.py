"""Decisions: reasons, salvage, order of authority, and the line in the log."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.decision import (
    NOTED,
    VERDICTS,
    Decision,
    in_force,
    override,
    untrustworthy,
)
from curation_ros.core.episode.findings import FINDINGS, Finding
from curation_ros.core.errors import EpisodeError

FINITE = st.floats(-1e6, 1e6)


def decision(revision: int = 1, by: str = "curator", episode: str = "e") -> Decision:
    return Decision(episode, "pick-1", "keep", "r", (0, 5), revision=revision, by=by)


def test_only_faults_of_the_recording_are_untrustworthy() -> None:
    assert set(NOTED) <= {k for k, (kind, _) in FINDINGS.items() if kind == "recording"}
    noted = Finding("no-bag", "m", (0, 0))
    gap = Finding("gap", "m", (0, 0))
    assert untrustworthy([noted, gap]) == [gap]


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
    with pytest.raises(EpisodeError, match="expected the name of a person"):
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
    line = json.dumps(before.to_json(), allow_nan=False)
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


def test_missing_key_and_other_json_are_refused_and_unknown_keys_are_not() -> None:
    raw = decision().to_json()
    assert Decision.from_json({**raw, "written_at": "later"}) == decision()
    for key in raw:
        with pytest.raises(EpisodeError):
            Decision.from_json({k: v for k, v in raw.items() if k != key})
    for other in ([], None, "keep", 3):
        with pytest.raises(EpisodeError):
            Decision.from_json(other)
