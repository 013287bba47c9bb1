"""Findings of clean episodes, of their motion and their task."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from checking import (
    bare_map,
    holding,
    ids_of,
    only,
    with_padding,
    with_rows,
    without_phase,
)
from episodes import (
    CLOSE_AT,
    GRASP_STEPS,
    TASK_STEPS,
    copied,
    make_episode,
    make_reference,
    shifted,
    with_fields,
)
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.decision import untrustworthy
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import FINDINGS
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.evidence import checks
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode

OPEN_AT = TASK_STEPS - 3
PERIOD_S = 0.05


@pytest.fixture
def baseline(rng: np.random.Generator) -> Baseline:
    return Baseline().fit(make_reference(rng, 6))


# --- clean and early ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_clean_episode_has_no_finding(seed: int, baseline: Baseline) -> None:
    rng = np.random.default_rng(seed)
    episode = make_episode(rng, TASK_STEPS + int(rng.integers(-30, 60)))
    assert ids_of(episode) == []
    assert ids_of(episode, baseline) == []


@pytest.mark.parametrize("seed", range(20))
def test_early_release_is_a_failed_task_and_no_fault_of_the_recording(
    seed: int, baseline: Baseline
) -> None:
    """It hovers for long at the end: the arm holds still, and yet is measured with noise."""
    rng = np.random.default_rng(seed)
    open_at = int(rng.integers(CLOSE_AT + GRASP_STEPS, CLOSE_AT + GRASP_STEPS + 50))
    episode = make_episode(rng, TASK_STEPS + 260, task_steps=TASK_STEPS, open_at=open_at)
    for found in (check_episode(episode), check_episode(episode, baseline)):
        assert [f.id for f in found[1:]] == ["opened-early"]
        # Opened as it begins to lift, it was never taken along.
        assert found[0].id in ("object-lost", "not-carried")
        assert {f.kind for f in found} == {"task"}
        assert found[1].span == episode.span(open_at, open_at)
        # It begins to leave within 0.15 s, and that is sure within 0.3 s.
        first, last = found[0].span
        assert 0 <= first - found[1].span[0] <= 0.15e9
        assert 0 < last - first <= 0.3e9
        assert untrustworthy(found) == []


def test_findings_do_not_depend_on_when_it_happened(baseline: Baseline) -> None:
    episode = with_padding(make_episode(open_at=140), 30)
    assert check_episode(shifted(episode, 10**15), baseline) == check_episode(episode, baseline)
    assert check_episode(copied(episode), baseline) == check_episode(episode, baseline)


def test_findings_come_in_the_order_of_the_list() -> None:
    episode = with_rows(make_episode(open_at=140), "phase", slice(0, 5), 1.0)
    episode = with_rows(with_padding(episode, 30), "eef_position", 150, 5.0)
    ids = ids_of(episode)
    assert ids == ["clipped-start", "padded-tail", "jump", "opened-early"]  # no pose is trusted
    assert ids == sorted(ids, key=list(FINDINGS).index)
    assert [f.kind for f in check_episode(episode)] == ["recording"] * 2 + ["motion", "task"]


# --- motion -------------------------------------------------------------------------------------


def test_teleporting_effector_jumps() -> None:
    whole = make_episode()
    moved = whole.fields["eef_position"].copy()
    fast_m = float(np.quantile(np.linalg.norm(np.diff(moved, axis=0), axis=1), 0.95))
    for factor, expected in ((6.0, []), (12.0, ["jump"])):
        jumped = moved.copy()
        jumped[120:, 1] += factor * fast_m
        episode = with_fields(whole, eef_position=jumped)
        assert ids_of(episode) == expected
    found = only(episode, "jump")
    assert found.kind == "motion"
    assert found.span == episode.span(119, 120)
    assert " m in one step, " in found.message


def test_values_that_come_back_after_a_fault_are_no_jump() -> None:
    """What is wrong is the recording, not the motion."""
    frozen = holding(make_episode(), 40, 75, "eef_position")
    frozen = holding(frozen, 40, 75, "eef_quat_xyzw")
    assert ids_of(frozen) == ["frozen"]
    assert ids_of(with_padding(make_episode(), 30, zeros=True)) == ["padded-tail"]


def test_step_over_a_gap_is_no_jump() -> None:
    whole = make_episode()
    holed = replace(
        whole,
        stamps_ns=np.delete(whole.stamps_ns, slice(60, 100)),
        fields={k: np.delete(v, slice(60, 100), axis=0) for k, v in whole.fields.items()},
    )
    assert ids_of(holed) == []


def _resting(episode: Episode, first: int, last: int) -> Episode:
    """The arm trembles on the spot."""
    rng = np.random.default_rng(5)
    n = last - first + 1
    here = episode.fields["eef_position"][first] + 1e-6 * rng.standard_normal((n, 3))
    return with_rows(episode, "eef_position", slice(first, last + 1), here)


def test_long_rest_in_mid_way_is_idle(baseline: Baseline) -> None:
    long, short = _resting(make_episode(), 10, 75), _resting(make_episode(), 10, 65)
    found = only(long, "idle", baseline)
    assert found.kind == "motion"
    assert found.message == "the effector rests for 3.25 s"
    assert found.span == long.span(10, 75)
    assert "idle" not in ids_of(short)


def test_rest_at_either_end_is_not_idle() -> None:
    assert "idle" not in ids_of(_resting(make_episode(), 0, 80))
    assert "idle" not in ids_of(_resting(make_episode(open_at=140), 145, TASK_STEPS - 1))


def test_rest_that_references_have_too_is_not_idle(rng: np.random.Generator) -> None:
    episode = _resting(make_episode(rng), 10, 75)
    thoughtful = [_resting(e, 10, 50) for e in make_reference(rng, 6)]
    assert "idle" in ids_of(episode)
    assert "idle" not in ids_of(episode, Baseline().fit(thoughtful))


# --- task ---------------------------------------------------------------------------------------


def test_gripper_that_never_closes_never_grasps(rng: np.random.Generator) -> None:
    pushed = make_episode(rng, close_at=None)
    assert ids_of(pushed) == ["never-grasped"]
    assert only(pushed, "never-grasped").kind == "task"
    assert ids_of(pushed, Baseline().fit(make_reference(rng, 6))) == ["never-grasped"]
    pushing = [make_episode(rng, close_at=None) for _ in range(3)]
    assert ids_of(pushed, Baseline().fit(pushing)) == []
    assert ids_of(make_episode(rng, close_at=TASK_STEPS - 20, open_at=None)) == []


def test_opening_before_the_last_phase_is_early() -> None:
    at_release, before = make_episode(open_at=OPEN_AT), make_episode(open_at=OPEN_AT - 1)
    assert ids_of(at_release) == []
    found = only(before, "opened-early")
    assert found.message == "the gripper opened in phase TRANSPORT, expected RELEASE"
    assert found.span == before.span(OPEN_AT - 1, OPEN_AT - 1)


def test_opening_in_a_phase_of_a_reference_is_not_early(rng: np.random.Generator) -> None:
    thrown = [make_episode(rng, open_at=OPEN_AT - 10) for _ in range(3)]
    assert ids_of(make_episode(rng, open_at=OPEN_AT - 5), Baseline().fit(thrown)) == []
    in_lift = make_episode(rng, open_at=CLOSE_AT + GRASP_STEPS + 5)
    assert ids_of(in_lift, Baseline().fit(thrown)) == ["grip-lost", "opened-early"]


def test_without_phases_the_time_held_tells_an_early_opening(rng: np.random.Generator) -> None:
    baseline = Baseline().fit([without_phase(e) for e in make_reference(rng, 6)])
    held = round(checks.HELD_SHARE * baseline.held_s_ / PERIOD_S)
    for steps, expected in ((held - 1, ["opened-early"]), (held + 1, [])):
        episode = without_phase(make_episode(rng, open_at=CLOSE_AT + steps))
        assert ids_of(episode, baseline) == expected
        assert ids_of(episode) == []


def test_last_phase_that_is_not_reached_is_unfinished(rng: np.random.Generator) -> None:
    whole = make_episode(rng, open_at=None)
    cut = whole.steps(OPEN_AT)
    assert ids_of(cut) == ["unfinished"]
    assert only(cut, "unfinished").message == (
        "it ends in phase TRANSPORT at most, expected RELEASE"
    )
    assert ids_of(whole.steps(OPEN_AT + 1)) == []
    handed_over = Baseline().fit([e.steps(len(e) - 3) for e in make_reference(rng, 3)])
    assert ids_of(cut, handed_over) == []


def test_unknown_phases_do_not_tell_whether_it_was_finished() -> None:
    whole = make_episode()
    assert ids_of(with_rows(whole.steps(OPEN_AT), "phase", slice(180, None), -1.0)) == []
    assert ids_of(with_rows(whole, "phase", slice(None), -1.0)) == []


def test_gripper_that_stays_closed_is_unfinished_where_references_open(
    rng: np.random.Generator, baseline: Baseline
) -> None:
    closed = make_episode(rng, open_at=None)
    assert ids_of(closed) == []
    assert ids_of(closed, baseline) == ["unfinished"]
    handing = Baseline().fit([make_episode(rng, open_at=None) for _ in range(3)])
    assert ids_of(closed, handing) == []


def test_robot_without_gripper_or_phases_is_judged_by_what_it_has() -> None:
    raw = bare_map().to_json()
    raw["fields"] = {k: raw["fields"][k] for k in ("eef_position", "joint_position", "twist")}
    raw = {k: v for k, v in raw.items() if k != "gripper"} | {"action": ["twist"]}
    map_ = topic_map_from_json(raw)
    whole = make_episode()
    fields = {k: v for k, v in whole.fields.items() if k in map_.fields}
    bare = replace(whole, fields=fields, topic_map=map_)
    assert ids_of(bare) == []
    frozen = holding(bare, 40, 70, "eef_position")
    assert ids_of(with_padding(frozen, 20)) == ["frozen", "padded-tail"]


# --- anything -----------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@given(data=st.data())
def test_no_arrays_break_the_checks(data: st.DataObject) -> None:
    """Whatever the values are: findings of the list, within the episode, or none."""
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    n = data.draw(st.integers(0, 40))
    episode = make_episode(rng, n, close_at=min(10, n // 2))
    for name in data.draw(st.sets(st.sampled_from(sorted(episode.fields)))):
        values = episode.fields[name].copy()
        bad = data.draw(st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 1e308, -1.0]))
        rows = rng.random(n) < data.draw(st.sampled_from([0.1, 0.5, 1.0]))
        values[rows] = bad
        episode = with_fields(episode, **{name: values})
    baseline = data.draw(st.sampled_from([None, _BASELINE]))
    for finding in check_episode(episode, baseline):
        assert finding.id in FINDINGS
        assert "\n" not in finding.message
        assert 0 <= finding.span[0] <= finding.span[1] <= episode.end_ns - episode.start_ns


_BASELINE = Baseline().fit(make_reference(np.random.default_rng(1), 4))


def test_kinds_are_three_and_ids_are_stable_words() -> None:
    assert {kind for kind, _ in FINDINGS.values()} == {"recording", "motion", "task"}
    for finding_id, (_, meaning) in FINDINGS.items():
        assert finding_id.replace("-", "").isalnum()
        assert finding_id == finding_id.lower()
        assert meaning.strip()
        assert "\n" not in meaning
    pairs = itertools.combinations([meaning for _, meaning in FINDINGS.values()], 2)
    assert all(a != b for a, b in pairs)
