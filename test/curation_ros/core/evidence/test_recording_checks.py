"""Faults of the recording that the arrays show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from checking import (
    holding,
    ids_of,
    only,
    restamped,
    resting,
    with_padding,
    with_rows,
    without_phase,
)
from episodes import (
    CLOSE_AT,
    TASK_STEPS,
    make_episode,
    make_reference,
    topic_map,
    with_fields,
)
from streams import samples_of

from curation_ros.bags import CdrDecoder
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode

PERIOD_S = 0.05


@pytest.fixture
def baseline(rng: np.random.Generator) -> Baseline:
    return Baseline().fit(make_reference(rng, 6))


@pytest.mark.parametrize("n_steps", [0, 1, 4])
def test_few_steps_are_too_short_and_nothing_else(n_steps: int, baseline: Baseline) -> None:
    episode = make_episode(n_steps=n_steps, close_at=None)
    for found in (check_episode(episode), check_episode(episode, baseline)):
        assert [f.id for f in found] == ["too-short"]
        assert str(n_steps) in found[0].message


def test_a_quarter_of_the_shortest_reference_is_too_short(baseline: Baseline) -> None:
    limit = int(0.25 * baseline.duration_s_ / PERIOD_S)
    whole = make_episode()
    assert ids_of(whole.steps(limit), baseline) == ["too-short"]
    assert "too-short" not in ids_of(whole.steps(limit + 2), baseline)
    assert "too-short" not in ids_of(whole.steps(5))


@pytest.mark.parametrize("phase", [1, 3])
def test_start_in_a_later_phase_is_clipped(phase: int, baseline: Baseline) -> None:
    whole = make_episode()
    first = int(np.argmax(whole.fields["phase"][:, 0] == phase))
    clipped = whole.steps(TASK_STEPS, first)
    for known in (None, baseline):
        found = only(clipped, "clipped-start", known)
        assert found.message.startswith("it begins in phase ")
        assert found.span == clipped.span(0, 0)
    assert "clipped-start" not in ids_of(whole.steps(TASK_STEPS, first - 1)) or phase == 3


def test_phase_in_which_a_reference_starts_is_no_clipped_start(rng: np.random.Generator) -> None:
    later = [e.steps(len(e), CLOSE_AT - 10) for e in make_reference(rng, 6)]
    episode = make_episode(rng)
    episode = episode.steps(TASK_STEPS, CLOSE_AT - 10)
    assert ids_of(episode) == ["clipped-start"]
    assert ids_of(episode, Baseline().fit(later)) == []


def test_start_with_a_closed_gripper_is_clipped_where_it_only_opens() -> None:
    whole = without_phase(make_episode())
    held = whole.steps(TASK_STEPS, CLOSE_AT + 10)
    assert ids_of(held) == ["clipped-start"]
    # It may begin closed and grasp later: then its beginning is no middle.
    begins_closed = with_rows(whole, "gripper", slice(0, 20), 1.0)
    assert ids_of(begins_closed) == []


def test_start_with_a_closed_gripper_is_clipped_where_no_reference_has_one(
    rng: np.random.Generator,
) -> None:
    references = [without_phase(e) for e in make_reference(rng, 6)]
    begins_closed = with_rows(without_phase(make_episode(rng)), "gripper", slice(0, 20), 1.0)
    baseline = Baseline().fit(references)
    assert "clipped-start" in ids_of(begins_closed, baseline)
    references[0] = with_rows(references[0], "gripper", slice(0, 20), 1.0)
    assert "clipped-start" not in ids_of(begins_closed, Baseline().fit(references))


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
    assert ids_of(episode, baseline) == []
    clipped = episode.steps(TASK_STEPS, 25)
    found = only(clipped, "clipped-start", baseline)
    assert "in the first step" in found.message
    assert ids_of(clipped) == []  # nothing tells without a reference
    # Fast already in the first step, but still getting faster: it starts from rest.
    assert ids_of(_run_up(make_episode(rng), 4, 0.55), baseline) == []
    assert ids_of(_run_up(make_episode(rng), 4, 0.95), baseline) == ["clipped-start"]
    slower = CLOSE_AT + 2  # at rest, over the object: but closed and in a later phase
    by_speed = without_phase(episode.steps(TASK_STEPS, slower))
    assert "gripper" in only(by_speed, "clipped-start", baseline).message


@pytest.mark.parametrize("name", ["eef_position", "joint_position"])
def test_topic_that_repeats_while_the_arm_moves_is_frozen(name: str, baseline: Baseline) -> None:
    topic = topic_map().fields[name].topic
    names = [n for n, spec in topic_map().fields.items() if spec.topic == topic]
    frozen = holding(make_episode(), 40, 70, *names)
    for known in (None, baseline):
        found = only(frozen, "frozen", known)
        assert found.message == f"topic {topic!r}: its values repeat for 1.50 s"
        assert found.span == frozen.span(40, 70)
        assert found.kind == "recording"
    shorter = holding(make_episode(), 40, 49, *names)  # 0.45 s
    assert ids_of(shorter) == ids_of(shorter, baseline) == []


def test_topic_that_never_changes_is_frozen() -> None:
    frozen = holding(make_episode(), 0, TASK_STEPS - 1, "joint_position", "finger_position")
    assert only(frozen, "frozen").message == "topic 'joint_states': its values never change"


def test_everything_constant_is_frozen() -> None:
    episode = holding(make_episode(), 0, TASK_STEPS - 1)
    assert {f.message for f in check_episode(episode) if f.id == "frozen"} == {
        "topic 'eef_pose': its values never change",
        "topic 'joint_states': its values never change",
    }


def test_arm_at_rest_with_coarse_encoders_is_not_frozen(rng: np.random.Generator) -> None:
    """It waits for 2 s in mid-way with all values equal, while the hand trembles a little."""

    def at_rest(episode: Episode) -> Episode:
        return resting(episode, 30, 70, "eef_position", "joint_position", "finger_position")

    episode = at_rest(make_episode(rng))
    trembling = with_rows(episode, "twist", slice(30, 71), 0.001 * rng.standard_normal((41, 3)))
    assert ids_of(trembling) == []
    pushed = with_rows(episode, "twist", slice(30, 71), 0.2 * rng.standard_normal((41, 3)))
    assert ids_of(pushed) == ["frozen", "frozen"]
    # If no trusted episode repeats a value, this is no rest, whatever the commands are ...
    silent = make_reference(rng, 6)
    assert ids_of(trembling, Baseline().fit(silent)) == ["frozen", "frozen"]
    # ... and if they do, it is one.
    assert ids_of(trembling, Baseline().fit([at_rest(e) for e in silent])) == []


def test_constant_observation_of_another_kind_is_not_frozen() -> None:
    raw = topic_map().to_json()
    raw["fields"]["weight"] = {
        "topic": "weight",
        "type": "geometry_msgs/msg/WrenchStamped",
        "role": "observation",
        "values": ["wrench.force.z"],
    }
    episode = with_fields(make_episode(), weight=np.full((TASK_STEPS, 1), 9.81))
    assert ids_of(replace(episode, topic_map=topic_map_from_json(raw))) == []


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
    assert ids_of(episode) == ids_of(episode, baseline) == []
    assert "frozen" in ids_of(replace(episode, findings=()))


def test_missing_topic_is_not_frozen() -> None:
    nothing = np.full((TASK_STEPS, 7), np.nan)
    episode = with_fields(make_episode(), joint_position=nothing, finger_position=nothing[:, :2])
    assert ids_of(episode) == []


@pytest.mark.parametrize("zeros", [False, True], ids=["copies", "zeros"])
def test_padding_at_the_end_is_found(zeros: bool, baseline: Baseline) -> None:
    whole = make_episode()
    padded = with_padding(whole, 40, zeros=zeros)
    for known in (None, baseline):
        found = only(padded, "padded-tail", known)
        first = len(whole) - (0 if zeros else 1)
        assert found.span == padded.span(first, len(padded) - 1)
        assert ("zeros" in found.message) == zeros
        assert "frozen" not in ids_of(padded, known)


def test_few_equal_rows_at_the_end_are_no_padding() -> None:
    assert ids_of(with_padding(make_episode(), 8)) == []
    assert ids_of(with_padding(make_episode(), 9)) == ["padded-tail"]
    assert "padded-tail" not in ids_of(with_padding(make_episode(), 4, zeros=True))
    assert ids_of(with_padding(make_episode(), 5, zeros=True)) == ["padded-tail"]


def test_rest_at_the_end_is_no_padding_where_the_robot_rested_before() -> None:
    """Coarse encoders, no tremor: rows repeat whenever the robot waits."""
    waited = resting(make_episode(), 20, 40)
    assert ids_of(with_padding(waited, 50)) == []
    assert ids_of(with_padding(waited, 70)) == ["padded-tail"]


def test_end_with_one_value_changing_is_no_padding() -> None:
    padded = with_padding(make_episode(), 40)
    alive = with_rows(
        padded, "joint_position", slice(TASK_STEPS, None), np.arange(280.0).reshape(40, 7)
    )
    assert "padded-tail" not in ids_of(alive)


def test_rate_of_another_robot_is_found(baseline: Baseline) -> None:
    for rate_hz, expected in ((20.0, []), (22.0, []), (24.0, ["rate"]), (10.0, ["rate"])):
        episode = make_episode(rate_hz=rate_hz)
        assert ids_of(episode, baseline) == expected, rate_hz
        assert ids_of(episode) == []
    found = only(make_episode(rate_hz=10.0), "rate", baseline)
    assert found.message == "the clock runs at 10.00 Hz, in the references at 20.00 to 20.00"


def test_irregular_clock_is_found_without_a_reference(rng: np.random.Generator) -> None:
    n = TASK_STEPS - 1
    jitter = PERIOD_S * (1.0 + rng.uniform(-0.4, 0.4, n))
    assert ids_of(restamped(make_episode(rng), jitter)) == []
    lossy = PERIOD_S * (1.0 + (rng.random(n) < 0.1))
    assert ids_of(restamped(make_episode(rng), lossy)) == []
    bursts = np.where(np.arange(n) % 3 == 0, 0.11, 0.02)
    found = only(restamped(make_episode(rng), bursts), "rate")
    assert "of 239 periods" in found.message
