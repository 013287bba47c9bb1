"""Scorers of the carried object: values by hand, explanations, and when they abstain."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from decided import decide_on
from episodes import make_episode, make_reference, with_fields
from scenes import LIFT, LIFT_AT, N_STEPS, RELEASE_AT, TRANSPORT, TRANSPORT_AT, scene, without

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS, Abstain, Look
from curation_ros.core.scorers.grip_consistency import GripConsistency
from curation_ros.core.scorers.object_coupling import ObjectCoupling
from curation_ros.core.scorers.phase_events import PhaseEvents
from curation_ros.dataset.episodes import read_episode

NAMES = ("object_coupling", "grip_consistency", "phase_events")
N_CARRY = LIFT + TRANSPORT
SAMPLE = Path(__file__).resolve().parents[4] / "bags" / "sample"


@pytest.mark.parametrize("name", NAMES)
def test_good_demonstration_scores_one_without_an_explanation(name: str) -> None:
    scorer = SCORERS[name]()
    for episode in (scene(), scene(tilt_rad=0.5), make_episode(), read_episode(SAMPLE)):
        assert scorer.look(episode) == Look(1.0)


@pytest.mark.parametrize("name", NAMES)
def test_earlier_opening_scores_less(name: str) -> None:
    scorer = SCORERS[name]()
    steps = [*range(LIFT_AT + 9, TRANSPORT_AT - 4, 6)]
    scores = [scorer.score(scene(opened_at=k)) for k in steps]
    assert scores == sorted(scores)
    assert len(set(scores)) == len(scores)
    assert scores[-1] < 1.0


@pytest.mark.parametrize("name", NAMES)
def test_what_follows_the_release_changes_no_score(name: str) -> None:
    scorer = SCORERS[name]()
    for opened_at in (LIFT_AT + 20, RELEASE_AT):
        short, long = (scene(opened_at=opened_at, hover=n) for n in (0, 250))
        assert scorer.look(short) == scorer.look(long)


@pytest.mark.parametrize("name", NAMES)
def test_length_control_changes_no_score(name: str) -> None:
    how = {"rule": "none", "rule_scorer": name, "length": "fixed", "length_value": 60}
    curation = Curation.fit(CurationSettings(scorers=(name,), **how))  # type: ignore[arg-type]
    for episode in (scene(), scene(opened_at=LIFT_AT + 20)):
        assert curation.examine(episode).scores[name] == SCORERS[name]().score(episode)


def test_object_coupling_by_hand() -> None:
    # At the 30th step it hangs 87 mm above where it stood, and cannot fall farther.
    episode, scorer = scene(opened_at=LIFT_AT + 30), ObjectCoupling()
    assert scorer.score(episode) == 30 / N_CARRY
    assert scorer.look(episode).steps == (LIFT_AT + 30, LIFT_AT + 32)
    assert scorer.look(episode).explanation == (
        "bowl_position left the effector at 4.25 s, in LIFT, opened; at 4.35 s it was 0.096 m "
        "farther away"
    )
    behind = scene(is_taken=False, tremor_m=1e-5)
    assert scorer.score(behind) == 0.0
    explanation = scorer.look(behind).explanation
    assert explanation is not None
    assert explanation.startswith("bowl_position was not taken along: left behind at ")


def test_grip_consistency_by_hand() -> None:
    episode, scorer = scene(opened_at=LIFT_AT + 30), GripConsistency()
    assert scorer.score(episode) == 32 / N_CARRY  # the fingers follow two steps later
    assert scorer.look(episode).steps == (LIFT_AT + 32, LIFT_AT + 33)
    assert scorer.look(episode).explanation == (
        "the fingers had let go at 4.35 s, in LIFT, as finger_position shows"
    )
    empty = np.where(episode.fields["finger_position"] == 0.0025, 0.0005, 0.04) * [1, -1]
    nothing = with_fields(scene(), finger_position=empty[:N_STEPS])
    explanation = scorer.look(nothing).explanation
    assert explanation is not None
    assert explanation.startswith("the fingers held nothing at ")


def test_phase_events_by_hand() -> None:
    episode, scorer = scene(opened_at=LIFT_AT + 30), PhaseEvents()
    # TRANSPORT begins open because LIFT was left open: that is no second event.
    expected = -0.1 * np.log((np.exp(-(30 / LIFT) / 0.1) + np.exp(-1 / 0.1)) / 2)
    assert scorer.score(episode) == pytest.approx(expected, abs=1e-12)
    assert scorer.look(episode).steps == (LIFT_AT + 30, LIFT_AT + 30)
    explanation = "the gripper was opened at 4.25 s, after 60% of LIFT"
    assert scorer.look(episode).explanation == explanation
    # Softer: nearer to the mean of both.
    assert PhaseEvents(softness=100.0).score(episode) == pytest.approx((0.6 + 1) / 2, abs=1e-3)
    # Harder: the worst alone, up to softness times the logarithm of two.
    assert PhaseEvents(softness=1e-3).score(episode) == pytest.approx(0.6, abs=1e-3)


def test_phase_events_of_a_lift_with_an_open_gripper() -> None:
    made = scene()
    command = made.fields["gripper"].copy()
    command[:TRANSPORT_AT] = -1.0  # closed only after it
    expected = -0.1 * np.log((1 + np.exp(-10)) / 2)
    late = without(made, "object")
    fingers = np.where(command < 0, 0.04, 0.0025) * [1, -1]
    late = with_fields(late, gripper=command, finger_position=fingers)
    assert PhaseEvents().score(late) == pytest.approx(expected, abs=1e-12)


def test_phase_events_are_monotonic_in_each_phase() -> None:
    def score(lift: int, transport: int) -> float:
        made = scene()
        command = made.fields["gripper"].copy()
        command[LIFT_AT + lift : TRANSPORT_AT] = -1.0
        command[TRANSPORT_AT] = 1.0
        command[TRANSPORT_AT + transport : RELEASE_AT] = -1.0
        return PhaseEvents().score(with_fields(made, gripper=command))

    for lift in (5, 20, 45):
        scores = [score(lift, transport) for transport in range(1, TRANSPORT, 6)]
        assert scores == sorted(scores)
    for transport in (5, 20, 45):
        scores = [score(lift, transport) for lift in range(0, LIFT, 6)]
        assert scores == sorted(scores)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("object_coupling", "it ends in TRANSPORT, bowl_position still held"),
        ("grip_consistency", "it ends in TRANSPORT"),
        ("phase_events", "it ends in TRANSPORT: how far that had come is not known"),
    ],
)
def test_episode_that_ends_in_mid_carry_abstains(name: str, reason: str) -> None:
    with pytest.raises(Abstain) as caught:
        SCORERS[name]().score(scene(tail=TRANSPORT_AT + 20))
    assert str(caught.value) == reason


@pytest.mark.parametrize("name", NAMES)
def test_loss_before_the_end_is_scored_although_the_episode_breaks_off(name: str) -> None:
    lost = scene(opened_at=LIFT_AT + 20, tail=TRANSPORT_AT + 20)
    assert SCORERS[name]().score(lost) < 0.6


def test_what_a_graph_lacks_is_said() -> None:
    with pytest.raises(Abstain, match="declares no object with a position"):
        ObjectCoupling().score(without(scene(), "object"))
    with pytest.raises(Abstain, match="has no phase in which something is carried"):
        PhaseEvents().score(without(scene(), "phase"))
    with pytest.raises(Abstain, match="declares no gripper"):
        PhaseEvents().score(without(scene(), "gripper"))
    phase = np.where(scene().fields["phase"] == 4.0, 5.0, scene().fields["phase"])
    with pytest.raises(Abstain, match="never came to TRANSPORT"):
        PhaseEvents().score(with_fields(scene(), phase=phase))
    assert ObjectCoupling().score(without(scene(), "gripper")) == 1.0
    with pytest.raises(Abstain, match="no field 'torque'"):
        GripConsistency(on="effort", effort="torque").score(scene())


def test_parameters_that_make_no_sense_are_refused() -> None:
    for scorer in (
        GripConsistency(on="effort"),
        GripConsistency(effort="effort"),
        GripConsistency(on="hands"),
        PhaseEvents(softness=0.0),
        PhaseEvents(softness=float("nan")),
    ):
        with pytest.raises(ConfigError):
            scorer.score(scene())


@pytest.mark.parametrize("name", NAMES)
def test_rule_fitted_on_carries_keeps_them_and_discards_drops(name: str) -> None:
    rng = np.random.default_rng(2)
    curation = Curation.fit(
        CurationSettings(scorers=(name,), rule="threshold", rule_scorer=name), make_reference(rng)
    )
    assert decide_on(curation, make_episode(rng)).verdict == "keep"
    dropped = decide_on(curation, make_episode(rng, open_at=140))
    assert dropped.verdict == "discard"
    assert "at 7." in dropped.reason  # the time, in the reason
    assert "in LIFT" in dropped.reason or "of LIFT" in dropped.reason
