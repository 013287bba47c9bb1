from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from episodes import (
    CLOSE_AT,
    GRASP_STEPS,
    TASK_STEPS,
    copied,
    make_episode,
    make_reference,
    shifted,
    topic_map,
    with_fields,
)
from hypothesis import given
from hypothesis import strategies as st
from streams import samples_of

from curation_ros.bags import CdrDecoder
from curation_ros.core.decision.decision import untrustworthy
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import FINDINGS, Finding
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence import checks
from curation_ros.core.evidence.checks import Baseline, check_episode

OPEN_AT = TASK_STEPS - 3
PERIOD_S = 0.05


@pytest.fixture
def baseline(rng: np.random.Generator) -> Baseline:
    return Baseline().fit(make_reference(rng, 6))


def _ids(episode: Episode, baseline: Baseline | None = None) -> list[str]:
    return [f.id for f in check_episode(episode, baseline)]


def _only(episode: Episode, finding_id: str, baseline: Baseline | None = None) -> Finding:
    [found] = [f for f in check_episode(episode, baseline) if f.id == finding_id]
    return found


def _set(episode: Episode, name: str, rows: slice | int, values: Any) -> Episode:
    field = episode.fields[name].copy()
    field[rows] = values
    return with_fields(episode, **{name: field})


def _hold(episode: Episode, first: int, last: int, *names: str) -> Episode:
    """Fields keep the value of row `first` until row `last`, inclusive."""
    for name in names or tuple(episode.fields):
        episode = _set(episode, name, slice(first, last + 1), episode.fields[name][first])
    return episode


def _rest(episode: Episode, first: int, last: int, *names: str) -> Episode:
    """Fields keep the value of row `first` until row `last`, and go on from there."""
    for name in names or tuple(episode.fields):
        values = episode.fields[name].copy()
        if name not in ("phase", "gripper"):
            values[last + 1 :] += values[first] - values[last]
        values[first : last + 1] = values[first]
        episode = with_fields(episode, **{name: values})
    return episode


def _padded(episode: Episode, n: int, *, zeros: bool = False) -> Episode:
    """The episode with n more rows: copies of the last one, or zeros."""
    period = int(episode.stamps_ns[1] - episode.stamps_ns[0])
    more = episode.stamps_ns[-1] + period * np.arange(1, n + 1)
    fields = {
        name: np.concatenate([v, np.repeat(v[-1:], n, axis=0) * (0.0 if zeros else 1.0)])
        for name, v in episode.fields.items()
    }
    stamps = np.concatenate([episode.stamps_ns, more])
    return replace(episode, stamps_ns=stamps, end_ns=int(stamps[-1]), fields=fields)


def _restamped(episode: Episode, periods_s: Any) -> Episode:
    offsets = np.concatenate([[0], np.cumsum(np.round(np.asarray(periods_s) * 1e9))])
    stamps = episode.stamps_ns[0] + offsets.astype(np.int64)
    return replace(episode, stamps_ns=stamps, end_ns=int(stamps[-1]))


def _bare(**changes: Any) -> TopicMap:
    """The map of the package without phases."""
    raw = topic_map().to_json()
    del raw["fields"]["phase"]
    raw["state"] = ["eef_position"]
    raw.update(changes)
    return topic_map_from_json(raw)


def _without_phase(episode: Episode) -> Episode:
    fields = {k: v for k, v in episode.fields.items() if k != "phase"}
    return replace(episode, fields=fields, topic_map=_bare())


# --- clean and early ----------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_clean_episode_has_no_finding(seed: int, baseline: Baseline) -> None:
    rng = np.random.default_rng(seed)
    episode = make_episode(rng, TASK_STEPS + int(rng.integers(-30, 60)))
    assert _ids(episode) == []
    assert _ids(episode, baseline) == []


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
    episode = _padded(make_episode(open_at=140), 30)
    assert check_episode(shifted(episode, 10**15), baseline) == check_episode(episode, baseline)
    assert check_episode(copied(episode), baseline) == check_episode(episode, baseline)


def test_findings_come_in_the_order_of_the_list() -> None:
    episode = _set(make_episode(open_at=140), "phase", slice(0, 5), 1.0)
    episode = _set(_padded(episode, 30), "eef_position", 150, 5.0)
    ids = _ids(episode)
    assert ids == ["clipped-start", "padded-tail", "jump", "opened-early"]  # no pose is trusted
    assert ids == sorted(ids, key=list(FINDINGS).index)
    assert [f.kind for f in check_episode(episode)] == ["recording"] * 2 + ["motion", "task"]


# --- the baseline -------------------------------------------------------------------------------


def test_baseline_is_plain_numbers_in_any_order(rng: np.random.Generator) -> None:
    reference = make_reference(rng, 6)
    fitted = Baseline().fit(reference).fitted()
    assert fitted == Baseline().fit(reversed(reference)).fitted()
    assert fitted["n_"] == 6
    np.testing.assert_allclose(fitted["rate_hz_"], (20.0, 20.0))
    assert fitted["duration_s_"] == pytest.approx((TASK_STEPS - 7) * PERIOD_S)
    assert (fitted["first_phase_"], fitted["last_phase_"], fitted["open_phase_"]) == (0, 5, 5)
    assert (fitted["starts_open_"], fitted["closes_"], fitted["opens_"]) == (1, 1, 1)
    assert fitted["still_s_"] == {"eef_pose": 0.0, "joint_states": 0.0}
    assert fitted["held_s_"] == pytest.approx(min(first_opening_s(e) for e in reference), abs=1e-9)
    plain = (int, float, tuple, dict)
    assert all(isinstance(v, plain) for v in fitted.values())


def first_opening_s(episode: Episode) -> float:
    command = episode.fields["gripper"][:, 0]
    closed = np.flatnonzero(command > 0)
    return float(closed[-1] + 1 - closed[0]) * PERIOD_S


def test_baseline_of_nothing_judges_as_none_does() -> None:
    nothing = Baseline().fit([])
    for options in ({}, {"open_at": 140}, {"open_at": None}, {"close_at": None}):
        episode = make_episode(**options)
        assert check_episode(episode, nothing) == check_episode(episode)


def test_second_fit_forgets_the_first(rng: np.random.Generator) -> None:
    reference = make_reference(rng, 6)
    again = Baseline().fit(reference).fit(reference[:3])
    assert again.fitted() == Baseline().fit(reference[:3]).fitted()


def test_spread_of_too_few_references_is_not_judged(rng: np.random.Generator) -> None:
    slow = _restamped(make_episode(rng), np.full(TASK_STEPS - 1, 0.1))
    assert _ids(slow, Baseline().fit(make_reference(rng, 2))) == []
    assert _ids(slow, Baseline().fit(make_reference(rng, 3))) == ["rate"]


def test_too_short_reference_is_refused_by_name(rng: np.random.Generator) -> None:
    short = make_episode(rng, 4, close_at=1)
    with pytest.raises(EpisodeError, match=f"{short.id}: 4 steps"):
        Baseline().fit([make_episode(rng), short])


# --- recording ----------------------------------------------------------------------------------


@pytest.mark.parametrize("n_steps", [0, 1, 4])
def test_few_steps_are_too_short_and_nothing_else(n_steps: int, baseline: Baseline) -> None:
    episode = make_episode(n_steps=n_steps, close_at=None)
    for found in (check_episode(episode), check_episode(episode, baseline)):
        assert [f.id for f in found] == ["too-short"]
        assert str(n_steps) in found[0].message


def test_a_quarter_of_the_shortest_reference_is_too_short(baseline: Baseline) -> None:
    limit = int(0.25 * baseline.duration_s_ / PERIOD_S)
    whole = make_episode()
    assert _ids(whole.steps(limit), baseline) == ["too-short"]
    assert "too-short" not in _ids(whole.steps(limit + 2), baseline)
    assert "too-short" not in _ids(whole.steps(5))


@pytest.mark.parametrize("phase", [1, 3])
def test_start_in_a_later_phase_is_clipped(phase: int, baseline: Baseline) -> None:
    whole = make_episode()
    first = int(np.argmax(whole.fields["phase"][:, 0] == phase))
    clipped = whole.steps(TASK_STEPS, first)
    for known in (None, baseline):
        found = _only(clipped, "clipped-start", known)
        assert found.message.startswith("it begins in phase ")
        assert found.span == clipped.span(0, 0)
    assert "clipped-start" not in _ids(whole.steps(TASK_STEPS, first - 1)) or phase == 3


def test_phase_in_which_a_reference_starts_is_no_clipped_start(rng: np.random.Generator) -> None:
    later = [e.steps(len(e), CLOSE_AT - 10) for e in make_reference(rng, 6)]
    episode = make_episode(rng)
    episode = episode.steps(TASK_STEPS, CLOSE_AT - 10)
    assert _ids(episode) == ["clipped-start"]
    assert _ids(episode, Baseline().fit(later)) == []


def test_start_with_a_closed_gripper_is_clipped_where_it_only_opens() -> None:
    whole = _without_phase(make_episode())
    held = whole.steps(TASK_STEPS, CLOSE_AT + 10)
    assert _ids(held) == ["clipped-start"]
    # It may begin closed and grasp later: then its beginning is no middle.
    begins_closed = _set(whole, "gripper", slice(0, 20), 1.0)
    assert _ids(begins_closed) == []


def test_start_with_a_closed_gripper_is_clipped_where_no_reference_has_one(
    rng: np.random.Generator,
) -> None:
    references = [_without_phase(e) for e in make_reference(rng, 6)]
    begins_closed = _set(_without_phase(make_episode(rng)), "gripper", slice(0, 20), 1.0)
    baseline = Baseline().fit(references)
    assert "clipped-start" in _ids(begins_closed, baseline)
    references[0] = _set(references[0], "gripper", slice(0, 20), 1.0)
    assert "clipped-start" not in _ids(begins_closed, Baseline().fit(references))


def _run_up(episode: Episode, n: int, first: float = 0.1) -> Episode:
    """The arm starts from rest: the motion of the first steps is scaled down."""
    moved = np.diff(episode.fields["eef_position"], axis=0, prepend=0.0)
    moved[1 : n + 1] *= np.linspace(first, 1.0, n)[:, None]
    return with_fields(episode, eef_position=np.cumsum(moved, axis=0))


def test_start_at_full_speed_is_clipped_where_references_start_from_rest(
    rng: np.random.Generator,
) -> None:
    baseline = Baseline().fit([_run_up(e, 20) for e in make_reference(rng, 6)])
    episode = _run_up(make_episode(rng), 20)
    assert _ids(episode, baseline) == []
    clipped = episode.steps(TASK_STEPS, 25)
    found = _only(clipped, "clipped-start", baseline)
    assert "in the first step" in found.message
    assert _ids(clipped) == []  # nothing tells without a reference
    # Fast already in the first step, but still getting faster: it starts from rest.
    assert _ids(_run_up(make_episode(rng), 4, 0.55), baseline) == []
    assert _ids(_run_up(make_episode(rng), 4, 0.95), baseline) == ["clipped-start"]
    slower = CLOSE_AT + 2  # at rest, over the object: but closed and in a later phase
    by_speed = _without_phase(episode.steps(TASK_STEPS, slower))
    assert "gripper" in _only(by_speed, "clipped-start", baseline).message


@pytest.mark.parametrize("name", ["eef_position", "joint_position"])
def test_topic_that_repeats_while_the_arm_moves_is_frozen(name: str, baseline: Baseline) -> None:
    topic = topic_map().fields[name].topic
    names = [n for n, spec in topic_map().fields.items() if spec.topic == topic]
    frozen = _hold(make_episode(), 40, 70, *names)
    for known in (None, baseline):
        found = _only(frozen, "frozen", known)
        assert found.message == f"topic {topic!r}: its values repeat for 1.50 s"
        assert found.span == frozen.span(40, 70)
        assert found.kind == "recording"
    shorter = _hold(make_episode(), 40, 49, *names)  # 0.45 s
    assert _ids(shorter) == _ids(shorter, baseline) == []


def test_topic_that_never_changes_is_frozen() -> None:
    frozen = _hold(make_episode(), 0, TASK_STEPS - 1, "joint_position", "finger_position")
    assert _only(frozen, "frozen").message == "topic 'joint_states': its values never change"


def test_everything_constant_is_frozen() -> None:
    episode = _hold(make_episode(), 0, TASK_STEPS - 1)
    assert {f.message for f in check_episode(episode) if f.id == "frozen"} == {
        "topic 'eef_pose': its values never change",
        "topic 'joint_states': its values never change",
    }


def test_arm_at_rest_with_coarse_encoders_is_not_frozen(rng: np.random.Generator) -> None:
    """It waits for 2 s in mid-way with all values equal, while the hand trembles a little."""

    def resting(episode: Episode) -> Episode:
        return _rest(episode, 30, 70, "eef_position", "joint_position", "finger_position")

    episode = resting(make_episode(rng))
    trembling = _set(episode, "twist", slice(30, 71), 0.001 * rng.standard_normal((41, 3)))
    assert _ids(trembling) == []
    pushed = _set(episode, "twist", slice(30, 71), 0.2 * rng.standard_normal((41, 3)))
    assert _ids(pushed) == ["frozen", "frozen"]
    # No trusted episode repeats a value: then it is no rest, whatever the commands say ...
    silent = make_reference(rng, 6)
    assert _ids(trembling, Baseline().fit(silent)) == ["frozen", "frozen"]
    # ... and where they do, it is one.
    assert _ids(trembling, Baseline().fit([resting(e) for e in silent])) == []


def test_constant_observation_of_another_kind_is_not_frozen() -> None:
    raw = topic_map().to_json()
    raw["fields"]["weight"] = {
        "topic": "weight",
        "type": "geometry_msgs/msg/WrenchStamped",
        "role": "observation",
        "values": ["wrench.force.z"],
    }
    episode = with_fields(make_episode(), weight=np.full((TASK_STEPS, 1), 9.81))
    assert _ids(replace(episode, topic_map=topic_map_from_json(raw))) == []


@pytest.mark.parametrize("topic", ["joint_states", "eef_pose"])
def test_silence_of_a_topic_is_not_frozen_and_no_jump_either(
    topic: str, rng: np.random.Generator, baseline: Baseline
) -> None:
    """The builder holds what it saw last, and has a finding of its own for that."""
    made = make_episode(rng)
    raw = made.topic_map.to_json() | {"clock": "twist"}  # so that both can be held
    builder = EpisodeBuilder(
        topic_map_from_json(raw), CdrDecoder(), episode_id="id", name="", start_ns=made.start_ns
    )
    for sample in samples_of(made):
        if sample.topic != topic or not 120 < sample.seq <= 150:
            builder.push(sample)
    episode = builder.finish(made.end_ns, {})
    assert [f.id for f in episode.findings] == ["gap"]
    assert _ids(episode) == _ids(episode, baseline) == []
    assert "frozen" in _ids(replace(episode, findings=()))


def test_missing_topic_is_not_frozen() -> None:
    nothing = np.full((TASK_STEPS, 7), np.nan)
    episode = with_fields(make_episode(), joint_position=nothing, finger_position=nothing[:, :2])
    assert _ids(episode) == []


@pytest.mark.parametrize("zeros", [False, True], ids=["copies", "zeros"])
def test_padding_at_the_end_is_found(zeros: bool, baseline: Baseline) -> None:
    whole = make_episode()
    padded = _padded(whole, 40, zeros=zeros)
    for known in (None, baseline):
        found = _only(padded, "padded-tail", known)
        first = len(whole) - (0 if zeros else 1)
        assert found.span == padded.span(first, len(padded) - 1)
        assert ("zeros" in found.message) == zeros
        assert "frozen" not in _ids(padded, known)


def test_few_equal_rows_at_the_end_are_no_padding() -> None:
    assert _ids(_padded(make_episode(), 8)) == []
    assert _ids(_padded(make_episode(), 9)) == ["padded-tail"]
    assert "padded-tail" not in _ids(_padded(make_episode(), 4, zeros=True))
    assert _ids(_padded(make_episode(), 5, zeros=True)) == ["padded-tail"]


def test_rest_at_the_end_is_no_padding_where_the_robot_rested_before() -> None:
    """Coarse encoders, no tremor: rows repeat whenever the robot waits."""
    waited = _rest(make_episode(), 20, 40)
    assert _ids(_padded(waited, 50)) == []
    assert _ids(_padded(waited, 70)) == ["padded-tail"]


def test_end_with_one_value_changing_is_no_padding() -> None:
    padded = _padded(make_episode(), 40)
    alive = _set(
        padded, "joint_position", slice(TASK_STEPS, None), np.arange(280.0).reshape(40, 7)
    )
    assert "padded-tail" not in _ids(alive)


def test_rate_of_another_robot_is_found(baseline: Baseline) -> None:
    for rate_hz, expected in ((20.0, []), (22.0, []), (24.0, ["rate"]), (10.0, ["rate"])):
        episode = make_episode(rate_hz=rate_hz)
        assert _ids(episode, baseline) == expected, rate_hz
        assert _ids(episode) == []
    found = _only(make_episode(rate_hz=10.0), "rate", baseline)
    assert found.message == "the clock runs at 10.00 Hz, in the references at 20.00 to 20.00"


def test_irregular_clock_is_found_without_a_reference(rng: np.random.Generator) -> None:
    n = TASK_STEPS - 1
    jitter = PERIOD_S * (1.0 + rng.uniform(-0.4, 0.4, n))
    assert _ids(_restamped(make_episode(rng), jitter)) == []
    lossy = PERIOD_S * (1.0 + (rng.random(n) < 0.1))
    assert _ids(_restamped(make_episode(rng), lossy)) == []
    bursts = np.where(np.arange(n) % 3 == 0, 0.11, 0.02)
    found = _only(_restamped(make_episode(rng), bursts), "rate")
    assert "of 239 periods" in found.message


# --- motion -------------------------------------------------------------------------------------


def test_teleporting_effector_jumps() -> None:
    whole = make_episode()
    moved = whole.fields["eef_position"].copy()
    fast_m = float(np.quantile(np.linalg.norm(np.diff(moved, axis=0), axis=1), 0.95))
    for factor, expected in ((6.0, []), (12.0, ["jump"])):
        jumped = moved.copy()
        jumped[120:, 1] += factor * fast_m
        episode = with_fields(whole, eef_position=jumped)
        assert _ids(episode) == expected
    found = _only(episode, "jump")
    assert found.kind == "motion"
    assert found.span == episode.span(119, 120)
    assert " m in one step, " in found.message


def test_values_that_come_back_after_a_fault_are_no_jump() -> None:
    """What is wrong is the recording, not the motion."""
    frozen = _hold(make_episode(), 40, 75, "eef_position")
    frozen = _hold(frozen, 40, 75, "eef_quat_xyzw")
    assert _ids(frozen) == ["frozen"]
    assert _ids(_padded(make_episode(), 30, zeros=True)) == ["padded-tail"]


def test_step_over_a_gap_is_no_jump() -> None:
    whole = make_episode()
    holed = replace(
        whole,
        stamps_ns=np.delete(whole.stamps_ns, slice(60, 100)),
        fields={k: np.delete(v, slice(60, 100), axis=0) for k, v in whole.fields.items()},
    )
    assert _ids(holed) == []


def _resting(episode: Episode, first: int, last: int) -> Episode:
    """The arm trembles on the spot."""
    rng = np.random.default_rng(5)
    n = last - first + 1
    here = episode.fields["eef_position"][first] + 1e-6 * rng.standard_normal((n, 3))
    return _set(episode, "eef_position", slice(first, last + 1), here)


def test_long_rest_in_mid_way_is_idle(baseline: Baseline) -> None:
    long, short = _resting(make_episode(), 10, 75), _resting(make_episode(), 10, 65)
    found = _only(long, "idle", baseline)
    assert found.kind == "motion"
    assert found.message == "the effector rests for 3.25 s"
    assert found.span == long.span(10, 75)
    assert "idle" not in _ids(short)


def test_rest_at_either_end_is_not_idle() -> None:
    assert "idle" not in _ids(_resting(make_episode(), 0, 80))
    assert "idle" not in _ids(_resting(make_episode(open_at=140), 145, TASK_STEPS - 1))


def test_rest_that_references_have_too_is_not_idle(rng: np.random.Generator) -> None:
    episode = _resting(make_episode(rng), 10, 75)
    thoughtful = [_resting(e, 10, 50) for e in make_reference(rng, 6)]
    assert "idle" in _ids(episode)
    assert "idle" not in _ids(episode, Baseline().fit(thoughtful))


# --- task ---------------------------------------------------------------------------------------


def test_gripper_that_never_closes_never_grasps(rng: np.random.Generator) -> None:
    pushed = make_episode(rng, close_at=None)
    assert _ids(pushed) == ["never-grasped"]
    assert _only(pushed, "never-grasped").kind == "task"
    assert _ids(pushed, Baseline().fit(make_reference(rng, 6))) == ["never-grasped"]
    pushing = [make_episode(rng, close_at=None) for _ in range(3)]
    assert _ids(pushed, Baseline().fit(pushing)) == []
    assert _ids(make_episode(rng, close_at=TASK_STEPS - 20, open_at=None)) == []


def test_opening_before_the_last_phase_is_early() -> None:
    at_release, before = make_episode(open_at=OPEN_AT), make_episode(open_at=OPEN_AT - 1)
    assert _ids(at_release) == []
    found = _only(before, "opened-early")
    assert found.message == "the gripper opened in phase TRANSPORT, expected RELEASE"
    assert found.span == before.span(OPEN_AT - 1, OPEN_AT - 1)


def test_opening_in_a_phase_of_a_reference_is_not_early(rng: np.random.Generator) -> None:
    thrown = [make_episode(rng, open_at=OPEN_AT - 10) for _ in range(3)]
    assert _ids(make_episode(rng, open_at=OPEN_AT - 5), Baseline().fit(thrown)) == []
    in_lift = make_episode(rng, open_at=CLOSE_AT + GRASP_STEPS + 5)
    assert _ids(in_lift, Baseline().fit(thrown)) == ["grip-lost", "opened-early"]


def test_without_phases_the_time_held_tells_an_early_opening(rng: np.random.Generator) -> None:
    baseline = Baseline().fit([_without_phase(e) for e in make_reference(rng, 6)])
    held = round(checks.HELD_SHARE * baseline.held_s_ / PERIOD_S)
    for steps, expected in ((held - 1, ["opened-early"]), (held + 1, [])):
        episode = _without_phase(make_episode(rng, open_at=CLOSE_AT + steps))
        assert _ids(episode, baseline) == expected
        assert _ids(episode) == []


def test_last_phase_that_is_not_reached_is_unfinished(rng: np.random.Generator) -> None:
    whole = make_episode(rng, open_at=None)
    cut = whole.steps(OPEN_AT)
    assert _ids(cut) == ["unfinished"]
    assert _only(cut, "unfinished").message == (
        "it ends in phase TRANSPORT at most, expected RELEASE"
    )
    assert _ids(whole.steps(OPEN_AT + 1)) == []
    handed_over = Baseline().fit([e.steps(len(e) - 3) for e in make_reference(rng, 3)])
    assert _ids(cut, handed_over) == []


def test_unknown_phases_do_not_tell_whether_it_was_finished() -> None:
    whole = make_episode()
    assert _ids(_set(whole.steps(OPEN_AT), "phase", slice(180, None), -1.0)) == []
    assert _ids(_set(whole, "phase", slice(None), -1.0)) == []


def test_gripper_that_stays_closed_is_unfinished_where_references_open(
    rng: np.random.Generator, baseline: Baseline
) -> None:
    closed = make_episode(rng, open_at=None)
    assert _ids(closed) == []
    assert _ids(closed, baseline) == ["unfinished"]
    handing = Baseline().fit([make_episode(rng, open_at=None) for _ in range(3)])
    assert _ids(closed, handing) == []


def test_robot_without_gripper_or_phases_is_judged_by_what_it_has() -> None:
    raw = _bare().to_json()
    raw["fields"] = {k: raw["fields"][k] for k in ("eef_position", "joint_position", "twist")}
    raw = {k: v for k, v in raw.items() if k != "gripper"} | {"action": ["twist"]}
    map_ = topic_map_from_json(raw)
    whole = make_episode()
    fields = {k: v for k, v in whole.fields.items() if k in map_.fields}
    bare = replace(whole, fields=fields, topic_map=map_)
    assert _ids(bare) == []
    assert _ids(_padded(_hold(bare, 40, 70, "eef_position"), 20)) == ["frozen", "padded-tail"]


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
