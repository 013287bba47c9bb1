from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import scores_from_status

from curation_ros.core.decision.decision import VERDICTS
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.status import (
    ERROR,
    OK,
    VERDICT_LEVEL,
    WARN,
    EpisodeEvent,
    Status,
    decision_to_status,
    event_from_json,
    event_from_status,
    event_to_json,
    event_to_status,
    owner_findings,
    phase_to_status,
)
from curation_ros.core.errors import EpisodeError

START_NS = 1_781_000_000_000_000_000
EVENT = EpisodeEvent(
    id="0197a1b2-0000-7000-8000-000000000000",
    name="pick-1",
    event="ended",
    start_ns=START_NS,
    end_ns=START_NS + 12_345_678_901,
    counts={"eef_pose": 240, "command/twist": 239},
    source="replay",
    reason="recovered: tail\nunknown-loss: topic 'x' has 2 publishers",
)

_TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
_STAMP = st.integers(0, 2**63 - 1)
_EVENTS = st.builds(
    EpisodeEvent,
    id=_TEXT.filter(bool),
    name=_TEXT,
    event=st.sampled_from(["started", "ended", "aborted"]),
    start_ns=_STAMP,
    end_ns=st.none() | _STAMP,
    counts=st.dictionaries(_TEXT, st.integers(0, 10**6), max_size=3),
    source=st.sampled_from(["live", "replay"]),
    reason=_TEXT,
)


# --- events -------------------------------------------------------------------------------------


def test_event_has_the_keys_of_the_contract() -> None:
    status = event_to_status(EVENT)
    assert (status.level, status.name, status.message) == (OK, "pick-1", "ended")
    assert status.hardware_id == EVENT.id
    assert dict(status.values) == {
        "start_stamp": "1781000000000000000",
        "end_stamp": "1781000012345678901",
        "source": "replay",
        "count/command/twist": "239",
        "count/eef_pose": "240",
        "reason": EVENT.reason,
    }
    started = event_to_status(EpisodeEvent("i", "n", "started", 5))
    assert dict(started.values) == {"start_stamp": "5", "source": "live"}


def test_aborted_event_is_an_error_and_the_others_are_ok() -> None:
    levels = {
        k: event_to_status(replace(EVENT, event=k)).level for k in ("started", "ended", "aborted")
    }
    assert levels == {"started": OK, "ended": OK, "aborted": ERROR}


@given(_EVENTS)
def test_event_survives_status_and_json(event: EpisodeEvent) -> None:
    assert event_from_status(event_to_status(event)) == event
    assert event_from_json(json.loads(json.dumps(event_to_json(event)))) == event


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"message": "stopped"}, "'stopped'"),
        ({"message": ""}, "expected started, ended or aborted"),
        ({"hardware_id": ""}, "an episode id"),
        ({"values": {}}, "start_stamp"),
        ({"values": {"start_stamp": "soon"}}, "soon"),
        ({"values": {"start_stamp": "1.5"}}, "1.5"),
        ({"values": {"start_stamp": "1", "end_stamp": ""}}, "end_stamp"),
        ({"values": {"start_stamp": "1", "count/a": "many"}}, "many"),
        ({"values": {"start_stamp": "-1"}}, "stamp -1"),
        ({"values": {"start_stamp": "1", "end_stamp": str(2**63)}}, f"stamp {2**63}"),
    ],
)
def test_status_that_is_no_event_is_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(EpisodeError, match=said):
        event_from_status(replace(event_to_status(EVENT), **changes))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("id", ...), ("start_stamp", None), ("start_stamp", "x"), ("counts", None),
        ("counts", [1]), ("counts", {"a": "b"}), ("end_stamp", ...), ("event", "stopped"),
        ("event", 5), ("event", None), ("start_stamp", float("inf")), ("id", ""),
    ],
)  # fmt: skip
def test_json_that_is_no_event_is_refused(key: str, value: Any) -> None:
    raw = event_to_json(EVENT)
    if value is ...:
        del raw[key]
    else:
        raw[key] = value
    with pytest.raises(EpisodeError, match="episode record"):
        event_from_json(raw)


def test_event_of_an_older_writer_has_no_reason() -> None:
    raw = event_to_json(EVENT)
    del raw["reason"]
    assert event_from_json(raw).reason == ""


# --- what the owner knows beside ----------------------------------------------------------------


def test_lines_of_the_reason_that_name_a_finding_are_findings() -> None:
    whole = (0, 12_345_678_901)
    assert owner_findings(EVENT) == [
        Finding("recovered", "tail", whole),
        Finding("unknown-loss", "topic 'x' has 2 publishers", whole),
    ]
    assert owner_findings(replace(EVENT, reason="all went well")) == []
    assert owner_findings(replace(EVENT, reason="")) == []


def test_aborted_episode_always_has_the_finding() -> None:
    aborted = replace(EVENT, event="aborted")
    found = owner_findings(replace(aborted, reason="no command within 5 s"))
    assert [(f.id, f.message) for f in found] == [("aborted", "no command within 5 s")]
    found = owner_findings(replace(aborted, reason="aborted: the recorder was stopped"))
    assert [(f.id, f.message) for f in found] == [("aborted", "the recorder was stopped")]
    [found_none] = owner_findings(replace(aborted, reason="", end_ns=None))
    assert (found_none.id, found_none.span) == ("aborted", (0, 0))


def test_owner_findings_are_the_same_after_every_way_an_event_can_travel() -> None:
    aborted = replace(EVENT, event="aborted")
    for event in (EVENT, aborted):
        expected = owner_findings(event)
        assert owner_findings(event_from_status(event_to_status(event))) == expected
        assert owner_findings(event_from_json(event_to_json(event))) == expected


# --- phases and decisions -----------------------------------------------------------------------


def test_phase_has_index_and_progress() -> None:
    status = phase_to_status("i", "GRASP", 2, 1 / 3)
    assert (status.message, status.hardware_id, status.level) == ("GRASP", "i", OK)
    assert dict(status.values) == {"index": "2", "progress": "0.3333333333333333"}


def _decision(**changes: Any) -> Status:
    return decision_to_status(
        **{
            "episode_id": "i",
            "name": "pick-1",
            "verdict": "keep",
            "reason": "good",
            "span": (0, 7),
            "revision": 2,
            "scores": {"knn": -0.1, "length": None},
            **changes,
        }
    )


def test_decision_has_the_keys_of_the_contract() -> None:
    status = _decision()
    assert (status.name, status.message, status.hardware_id) == ("pick-1", "keep", "i")
    assert dict(status.values) == {
        "verdict": "keep",
        "reason": "good",
        "span_start": "0",
        "span_end": "7",
        "revision": "2",
        "score/knn": "-0.1",
        "score/length": "",
    }


def test_level_of_every_verdict() -> None:
    assert {v: _decision(verdict=v).level for v in VERDICTS} == {
        "keep": OK,
        "salvage": WARN,
        "review": WARN,
        "discard": ERROR,
    }
    assert set(VERDICT_LEVEL) == set(VERDICTS)
    assert (OK, WARN, ERROR) == (0, 1, 2)


@given(st.dictionaries(_TEXT, st.none() | st.floats(allow_nan=False, allow_infinity=False)))
def test_scores_survive_to_the_last_bit(scores: dict[str, float | None]) -> None:
    read = scores_from_status(_decision(scores=scores))
    assert {k: None if v is None else v.hex() for k, v in read.items()} == {
        k: None if v is None else float(v).hex() for k, v in scores.items()
    }


def test_numpy_scores_are_written_as_plain_numbers() -> None:
    import numpy as np

    status = _decision(scores={"a": np.float64(0.5), "b": np.float32(0.5), "c": math.pi})
    assert [status.values[f"score/{k}"] for k in "abc"] == ["0.5", "0.5", repr(math.pi)]
