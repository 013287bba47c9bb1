from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.episode.gate import EpisodeGate
from curation_ros.core.episode.status import EpisodeEvent, owner_findings
from curation_ros.core.episode.stream import Sample
from curation_ros.core.types import NS_PER_S

TOPICS = ("pose", "joints", "twist")
STEP_NS = 50_000_000
START_NS, END_NS = 1_000 * STEP_NS, 1_020 * STEP_NS
MAX_GAP_S = 0.25
GAP_NS = int(MAX_GAP_S * NS_PER_S)
DRAIN_S = 3.0


def _gate() -> EpisodeGate:
    return EpisodeGate(TOPICS, max_gap_s=MAX_GAP_S, drain_timeout_s=DRAIN_S)


def _started(name: str = "a", start_ns: int = START_NS) -> EpisodeEvent:
    return EpisodeEvent(name, f"pick-{name}", "started", start_ns)


def _ended(
    name: str = "a",
    end_ns: int | None = END_NS,
    counts: Mapping[str, int] | None = None,
    **changes: Any,
) -> EpisodeEvent:
    start_ns = changes.pop("start_ns", START_NS)
    kind = changes.pop("kind", "ended")
    return EpisodeEvent(name, f"pick-{name}", kind, start_ns, end_ns, counts or {})


def _sample(stamp_ns: int, topic: str = "pose", seq: int = 0) -> Sample:
    return Sample(topic, stamp_ns, seq, b"")


def _pass(gate: EpisodeGate, stamp_ns: int, topics: tuple[str, ...] = TOPICS) -> None:
    for topic in topics:
        gate.push(_sample(stamp_ns, topic))


# --- which sample belongs -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stamp_ns", "belongs"),
    [(START_NS - 1, False), (START_NS, True), (END_NS, True), (END_NS + 1, False)],
)
def test_sample_belongs_iff_its_stamp_is_in_the_window(stamp_ns: int, belongs: bool) -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    assert gate.push(_sample(stamp_ns)) == ("a" if belongs else None)
    window = gate.window("a")
    assert window is not None
    assert window.counts().get("pose", 0) == belongs


def test_every_later_sample_belongs_until_the_end_is_known() -> None:
    gate = _gate()
    assert gate.push(_sample(START_NS)) is None
    gate.event(_started(), 0.0)
    assert gate.push(_sample(END_NS + 10 * STEP_NS)) == "a"
    gate.event(_ended(), 0.0)
    assert gate.push(_sample(END_NS + 11 * STEP_NS)) is None
    window = gate.window("a")
    assert window is not None
    assert window.counts() == {"pose": 1}  # START_NS was buffered; the one past the end is not in


def test_samples_before_started_wait_for_max_gap_of_stamp_time() -> None:
    gate = _gate()
    stamps = [START_NS + k * STEP_NS for k in range(-3, 9)]
    for stamp_ns in stamps:
        gate.push(_sample(stamp_ns))
        gate.push(_sample(stamp_ns, "joints"))
    early = gate.event(_started(), 0.0)
    kept = [s for s in stamps if s >= stamps[-1] - GAP_NS]
    assert min(kept) > START_NS
    assert [s.stamp_ns for s in early if s.topic == "pose"] == kept
    assert [s.stamp_ns for s in early if s.topic == "joints"] == kept


def test_buffered_samples_from_before_the_start_stay_out() -> None:
    gate = _gate()
    for k in range(-3, 3):
        gate.push(_sample(START_NS + k * STEP_NS, seq=k + 4))
    early = gate.event(_started(), 0.0)
    assert [(s.stamp_ns, s.seq) for s in early] == [
        (START_NS, 4),
        (START_NS + STEP_NS, 5),
        (START_NS + 2 * STEP_NS, 6),
    ]


def test_buffered_samples_count_as_arrived() -> None:
    gate = _gate()
    _pass(gate, START_NS)
    gate.event(_started(), 0.0)
    gate.event(_ended(counts=dict.fromkeys(TOPICS, 1)), 0.0)
    [closed] = gate.close_ready(0.0)
    assert closed.counts == dict.fromkeys(TOPICS, 1)


# --- when an episode closes ---------------------------------------------------------------------


def test_closes_when_every_topic_has_passed_the_end() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, START_NS)
    gate.event(_ended(), 0.0)
    _pass(gate, END_NS + STEP_NS, TOPICS[:2])
    gate.push(_sample(END_NS - 1, "twist"))
    assert gate.close_ready(0.0) == []
    gate.push(_sample(END_NS, "twist"))
    [closed] = gate.close_ready(0.0)
    assert (closed.event.id, closed.missing) == ("a", ())
    assert closed.counts == {"pose": 1, "joints": 1, "twist": 3}
    assert gate.open_ids == ()
    assert gate.close_ready(0.0) == []


def test_topic_that_passed_the_end_before_it_was_known_is_not_awaited() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS + STEP_NS)
    gate.event(_ended(), 0.0)
    [closed] = gate.close_ready(0.0)
    assert (closed.counts, closed.missing) == (dict.fromkeys(TOPICS, 0), ())


def test_topic_that_reached_its_count_is_not_awaited() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS, TOPICS[:2])
    gate.event(_ended(counts={"twist": 2}), 0.0)
    gate.push(_sample(START_NS, "twist"))
    gate.push(_sample(START_NS, "twist", seq=2))  # published again: the same stamp counts once
    assert gate.close_ready(0.0) == []
    gate.push(_sample(START_NS + STEP_NS, "twist"))
    [closed] = gate.close_ready(0.0)
    assert (closed.counts["twist"], closed.missing) == (2, ())


def test_topic_of_which_nothing_was_counted_is_not_awaited() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS, TOPICS[:2])
    gate.event(_ended(counts={"twist": 0}), 0.0)
    [closed] = gate.close_ready(0.0)
    assert closed.missing == ()


def test_drain_timeout_closes_and_names_what_is_missing() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS, TOPICS[:1])
    gate.push(_sample(START_NS, "joints"))
    gate.event(_ended(counts={"joints": 5}), 100.0)
    assert gate.close_ready(100.0 + DRAIN_S - 1e-6) == []
    [closed] = gate.close_ready(100.0 + DRAIN_S)
    assert closed.missing == ("joints", "twist")
    assert closed.counts == {"pose": 1, "joints": 1}


def test_second_end_changes_neither_window_nor_deadline() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    gate.event(_ended(end_ns=END_NS + STEP_NS), DRAIN_S - 1)
    [closed] = gate.close_ready(DRAIN_S)
    assert closed.event.end_ns == END_NS


@pytest.mark.parametrize("end_ns", [None, END_NS])
def test_aborted_closes_at_once(end_ns: int | None) -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.push(_sample(START_NS))
    gate.event(_ended(end_ns=end_ns, kind="aborted"), 0.0)
    [closed] = gate.close_ready(0.0)
    assert (closed.event.event, closed.counts) == ("aborted", {"pose": 1})


def test_no_topic_is_awaited_by_a_gate_without_topics() -> None:
    gate = EpisodeGate((), max_gap_s=MAX_GAP_S)
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    assert [c.event.id for c in gate.close_ready(0.0)] == ["a"]


# --- latched and misplaced events ---------------------------------------------------------------


def test_repeated_started_gives_nothing_a_second_time() -> None:
    gate = _gate()
    gate.push(_sample(START_NS))
    assert len(gate.event(_started(), 0.0)) == 1
    assert gate.event(_started(), 0.0) == []
    assert gate.open_ids == ("a",)


def test_repeated_started_does_not_open_a_closed_episode_again() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    gate.close_ready(DRAIN_S)
    assert gate.event(_started(), DRAIN_S) == []
    assert gate.open_ids == ()


def test_episode_that_is_played_again_opens_again() -> None:
    gate = _gate()
    for _ in range(2):
        again = replace(_started(), source="replay")
        assert gate.event(again, 0.0) == []
        assert gate.event(again, 0.0) == []
        assert gate.open_ids == ("a",)
        for stamp_ns in (START_NS, END_NS):
            for topic in TOPICS:
                assert gate.push(_sample(stamp_ns, topic)) == "a"
        gate.event(_ended(), 0.0)
        [closed] = gate.close_ready(0.0)
        assert closed.counts == dict.fromkeys(TOPICS, 2)


def test_end_without_a_start_is_ignored() -> None:
    gate = _gate()
    gate.event(_ended(), 0.0)
    _pass(gate, END_NS)
    assert gate.open_ids == ()
    assert gate.close_ready(1e9) == []


# --- late samples -------------------------------------------------------------------------------


def test_late_sample_belongs_to_no_episode() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    gate.close_ready(DRAIN_S)
    for stamp_ns in (START_NS, END_NS):
        assert gate.push(_sample(stamp_ns)) is None


# --- several episodes ---------------------------------------------------------------------------


def test_adjacent_episodes_share_no_sample() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_ended(), 0.0)
    gate.event(_started("b", END_NS + 1), 0.0)
    assert gate.push(_sample(END_NS)) == "a"
    assert gate.push(_sample(END_NS + 1)) == "b"
    assert gate.open_ids == ("a", "b")


def test_next_episode_begins_while_the_last_one_drains() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS, TOPICS[:2])
    gate.event(_ended(), 0.0)
    gate.event(_started("b", END_NS + STEP_NS), 0.0)
    _pass(gate, END_NS + STEP_NS, TOPICS[:2])
    assert gate.push(_sample(END_NS, "twist")) == "a"
    [closed] = gate.close_ready(0.0)
    assert closed.counts == dict.fromkeys(TOPICS, 1)
    assert gate.open_ids == ("b",)
    assert gate.push(_sample(END_NS + STEP_NS, "twist")) == "b"


def test_younger_of_overlapping_episodes_gets_the_sample() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    gate.event(_started("b", START_NS + STEP_NS), 0.0)
    assert gate.push(_sample(START_NS + STEP_NS)) == "b"
    assert gate.push(_sample(START_NS)) == "a"


def test_samples_that_came_before_the_last_end_was_known_also_reach_the_next_episode() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    assert gate.push(_sample(END_NS + STEP_NS)) == "a"  # its end is not known yet
    gate.event(_ended(), 0.0)
    early = gate.event(_started("b", END_NS + STEP_NS), 0.0)
    assert [s.stamp_ns for s in early] == [END_NS + STEP_NS]
    window = gate.window("a")
    assert window is not None
    assert window.counts() == {"pose": 0}


def test_gates_of_many_episodes_close_in_their_order() -> None:
    gate = _gate()
    names = [f"e{k}" for k in range(12)]
    for k, name in enumerate(names):
        start_ns = START_NS + 100 * k * STEP_NS
        gate.event(_started(name, start_ns), 0.0)
        gate.event(_ended(name, start_ns + STEP_NS, start_ns=start_ns), 0.0)
    assert [c.event.id for c in gate.close_ready(DRAIN_S)] == names


# --- stamps that go back ------------------------------------------------------------------------


def test_clock_may_go_back_between_episodes() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS)
    gate.event(_ended(), 0.0)
    assert len(gate.close_ready(0.0)) == 1
    back_ns = START_NS // 2
    for topic in TOPICS:
        gate.push(_sample(back_ns - STEP_NS, topic))
        gate.push(_sample(back_ns, topic))
    early = gate.event(_started("b", back_ns), 0.0)
    assert [(s.topic, s.stamp_ns) for s in early] == [(t, back_ns) for t in TOPICS]
    _pass(gate, back_ns + STEP_NS)
    gate.event(_ended("b", back_ns + STEP_NS, start_ns=back_ns), 0.0)
    [closed] = gate.close_ready(0.0)
    assert closed.counts == dict.fromkeys(TOPICS, 2)


def test_samples_of_one_episode_are_no_beginning_of_another() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS)
    gate.event(_ended(), 0.0)
    assert len(gate.close_ready(0.0)) == 1
    assert gate.event(_started("b", END_NS - STEP_NS), 0.0) == []  # the clock went back a little
    gate.event(_ended("b", None, kind="aborted"), 0.0)
    _pass(gate, END_NS + STEP_NS)
    gate.close_ready(0.0)
    early = gate.event(_started("c", END_NS - STEP_NS), 0.0)
    assert early == []


def test_samples_between_two_episodes_may_be_the_beginning_of_the_next() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    _pass(gate, END_NS)
    gate.event(_ended(), 0.0)
    gate.close_ready(0.0)
    _pass(gate, END_NS + STEP_NS)
    assert len(gate.event(_started("b", END_NS), 0.0)) == len(TOPICS)
    gate.event(_ended("b", END_NS + STEP_NS), 0.0)
    gate.close_ready(0.0)
    assert gate.event(_started("c", END_NS), 0.0) == []


def test_leftovers_of_a_clock_that_went_back_close_no_gate() -> None:
    gate = _gate()
    _pass(gate, END_NS)  # before the clock went back; still buffered when the episode starts
    back_ns = START_NS // 2
    gate.event(_started("b", back_ns), 0.0)
    _pass(gate, back_ns)
    gate.event(_ended("b", back_ns + STEP_NS, start_ns=back_ns), 0.0)
    assert gate.close_ready(0.0) == []
    _pass(gate, back_ns + STEP_NS)
    [closed] = gate.close_ready(0.0)
    assert closed.counts == dict.fromkeys(TOPICS, 2)


def test_sample_whose_stamp_went_back_inside_the_window_still_belongs() -> None:
    gate = _gate()
    gate.event(_started(), 0.0)
    assert gate.push(_sample(START_NS + 5 * STEP_NS)) == "a"
    assert gate.push(_sample(START_NS + 2 * STEP_NS)) == "a"


# --- any interleaving ---------------------------------------------------------------------------

_WINDOWS = {"a": (10, 19), "b": (20, 31)}
_LAST = 40
_PATIENCE_NS = 6  # as max_gap_s


@st.composite
def _streams(draw: st.DrawFn) -> tuple[list[Sample], dict[str, int]]:
    """An arrival order of all samples, and how many had arrived when each event was received."""
    stamps = {
        topic: [*sorted(draw(st.lists(st.integers(0, _LAST - 1), max_size=25))), _LAST]
        for topic in TOPICS
    }
    turns = [topic for topic in TOPICS for _ in stamps[topic]]
    left = {topic: list(values) for topic, values in stamps.items()}
    order = [_sample(left[t].pop(0), t, k) for k, t in enumerate(draw(st.permutations(turns)))]
    at: dict[str, int] = {}
    first = 0
    for name, (start, _) in _WINDOWS.items():
        # The buffer holds what is not older than max_gap: `started` may come that late.
        too_late = [k for k, s in enumerate(order) if s.stamp_ns > start + _PATIENCE_NS]
        latest = min(too_late, default=len(order))
        first = at[f"started {name}"] = draw(st.integers(min(first, latest), latest))
        first = at[f"ended {name}"] = draw(st.integers(first, len(order)))
        if first > latest:  # the next start may have to come before this end
            first = at[f"started {name}"]
    return order, at


@given(_streams())
def test_any_interleaving_of_topics_and_events_accepts_the_same_samples(
    drawn: tuple[list[Sample], dict[str, int]],
) -> None:
    order, at = drawn
    gate = EpisodeGate(TOPICS, max_gap_s=_PATIENCE_NS / NS_PER_S, drain_timeout_s=DRAIN_S)
    accepted: dict[str, set[Sample]] = {name: set() for name in _WINDOWS}
    closed = {}
    for k in range(len(order) + 1):
        for name, (start, end) in _WINDOWS.items():
            if at[f"started {name}"] == k:
                accepted[name].update(gate.event(_started(name, start), 0.0))
            if at[f"ended {name}"] == k:
                gate.event(_ended(name, end, start_ns=start), 0.0)
            closed |= {c.event.id: c for c in gate.close_ready(0.0)}
        if k < len(order):
            owner = gate.push(order[k])
            if owner is not None:
                accepted[owner].add(order[k])
            closed |= {c.event.id: c for c in gate.close_ready(0.0)}
    for name, (start, end) in _WINDOWS.items():
        # Of a stamp that was published again the first is enough; what came past an end that was
        # not known yet is left out by the builder.
        inside = {(s.topic, s.stamp_ns) for s in order if start <= s.stamp_ns <= end}
        taken = {(s.topic, s.stamp_ns) for s in accepted[name] if s.stamp_ns <= end}
        assert taken == inside
        assert closed[name].missing == ()
        for topic in TOPICS:
            distinct = [t for t, _ in inside if t == topic]
            assert closed[name].counts.get(topic, 0) == len(distinct)


def test_drain_timeout_notes_a_topic_that_its_owner_has_not_counted() -> None:
    gate = EpisodeGate(("a", "b", "c"), max_gap_s=0.25, drain_timeout_s=1.0)
    gate.event(EpisodeEvent("id", "name", "started", 0), 0.0)
    for topic, stamp_ns in (("a", 0), ("a", 100), ("b", 0), ("b", 99)):
        gate.push(Sample(topic, stamp_ns, 0, b""))
    gate.event(EpisodeEvent("id", "name", "ended", 0, 100), 0.0)
    assert gate.close_ready(0.9) == []
    (closed,) = gate.close_ready(1.1)
    # Topic c never spoke at all: that is the builder's finding.
    assert closed.missing == ("b", "c")
    assert [(f.id, f.message) for f in owner_findings(closed.event)] == [
        ("incomplete", "topic 'b' fell silent before the end of the episode")
    ]
