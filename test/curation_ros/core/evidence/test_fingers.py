"""What the fingers say about what was grasped."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from episodes import with_fields
from scenes import HELD_M, LIFT_AT, N_STEPS, OPEN_M, RELEASE_AT, TRANSPORT_AT, scene, without

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import FieldSpec
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.evidence.holds import Hold

N_CARRY = RELEASE_AT - LIFT_AT


def only_hold(episode: Episode, effort: str = "") -> Hold:
    [hold] = held_by_fingers(episode, effort=effort).holds
    return hold


def with_width(episode: Episode, width: np.ndarray) -> Episode:
    return with_fields(episode, finger_position=np.column_stack([width / 2, -width / 2]))


def widths(episode: Episode) -> np.ndarray:
    values = episode.fields["finger_position"]
    return values[:, 0] - values[:, 1]


def with_effort(episode: Episode, effort: np.ndarray) -> Episode:
    """The episode with efforts of two fingers, as of a robot that publishes them."""
    fingers = episode.topic_map.fields["finger_position"]
    spec = FieldSpec("effort", fingers.topic, fingers.type, "observation", ("a", "b"), "N")
    topic_map = replace(episode.topic_map, fields={**episode.topic_map.fields, "effort": spec})
    columns = np.column_stack([-effort, effort])
    return replace(episode, topic_map=topic_map, fields={**episode.fields, "effort": columns})


def efforts(episode: Episode) -> np.ndarray:
    """10 N while closing and 4 N while holding, the other way round while opening."""
    closed = widths(episode) < 0.01
    moving = np.zeros(len(closed))
    moving[1:] = np.diff(widths(episode)) * -125.0
    return np.where(closed, 4.0, 0.0) + np.where(moving != 0, moving - 4.0 * closed, 0.0)


# --- gap ----------------------------------------------------------------------------------------


def test_held_to_the_end() -> None:
    hold = only_hold(scene())
    assert (hold.object, hold.state, hold.phase) == ("finger_position", "carried", "TRANSPORT")
    assert (hold.first, hold.last, hold.n_carried) == (LIFT_AT, RELEASE_AT - 1, N_CARRY)
    assert (hold.departed, hold.noticed, hold.opened, hold.gap_m) == (None, None, False, 0.0)


def test_opening_is_sure_in_the_second_step_of_wider_fingers() -> None:
    # The fingers follow two steps after the command, at once to 80 mm.
    hold = only_hold(scene(opened_at=LIFT_AT + 30))
    assert (hold.state, hold.phase, hold.opened) == ("broken", "LIFT", True)
    assert (hold.departed, hold.noticed, hold.n_carried) == (LIFT_AT + 32, LIFT_AT + 33, 32)
    assert hold.gap_m == pytest.approx(OPEN_M - HELD_M)


def test_fingers_that_close_on_nothing_have_lost_it() -> None:
    made = scene()
    width = widths(made)
    width[TRANSPORT_AT + 10 : RELEASE_AT] = 0.001
    hold = only_hold(with_width(made, width))
    assert (hold.state, hold.phase, hold.opened) == ("broken", "TRANSPORT", False)
    assert hold.departed == TRANSPORT_AT + 10


def test_fingers_that_closed_on_nothing_never_held() -> None:
    made = scene()
    empty = np.where(widths(made) < 0.01, 0.001, widths(made))
    assert only_hold(with_width(made, empty)).state == "never"
    assert held_by_fingers(with_width(made, empty)).coupling == 0.0


def test_fingers_that_close_further_as_the_object_turns_still_hold() -> None:
    made = scene()
    width = np.maximum(widths(made), 0.010)
    width[LIFT_AT : LIFT_AT + 10] = np.linspace(0.010, HELD_M, 10)
    width[LIFT_AT + 10 : RELEASE_AT] = HELD_M
    assert only_hold(with_width(made, width)).state == "carried"


def test_one_wild_width_is_no_loss() -> None:
    made = scene()
    width = widths(made)
    width[LIFT_AT + 20], width[LIFT_AT + 30] = 0.05, 0.0
    width[LIFT_AT + 40] = np.nan
    assert only_hold(with_width(made, width)).state == "carried"


def test_what_follows_the_release_changes_nothing() -> None:
    assert held_by_fingers(scene()) == held_by_fingers(scene(hover=200))


@pytest.mark.parametrize("opened_at", [LIFT_AT + 30, TRANSPORT_AT + 5, RELEASE_AT])
def test_growing_episode_gives_the_same_answer(opened_at: int) -> None:
    made = scene(opened_at=opened_at)
    whole = only_hold(made)
    for stop in range(LIFT_AT + 1, N_STEPS):
        [hold] = held_by_fingers(made.steps(stop)).holds
        is_known = whole.noticed is not None and stop > whole.noticed
        assert (hold.state == "broken") == is_known
        if is_known:
            assert (hold.departed, hold.noticed) == (whole.departed, whole.noticed)


def test_what_cannot_be_known() -> None:
    made = scene()
    [hold] = held_by_fingers(scene(tail=LIFT_AT + 10)).holds
    assert (hold.state, hold.reason) == ("unknown", "it ends in LIFT")
    assert held_by_fingers(scene(tail=LIFT_AT)).reason == "it never came to LIFT or TRANSPORT"
    no_fingers = replace(
        made,
        topic_map=replace(made.topic_map, gripper=replace(made.topic_map.gripper, fingers="")),  # type: ignore[type-var]
    )
    assert held_by_fingers(no_fingers).reason == "the topic map declares no fingers"
    gone = with_width(made, np.full(N_STEPS, np.nan))
    assert only_hold(gone).reason == "no value of finger_position"
    assert held_by_fingers(made, effort="effort").reason.startswith("no field 'effort'")
    assert held_by_fingers(without(made, "gripper", "phase")).state == "unknown"


def test_steps_of_unknown_phase_end_no_grip() -> None:
    made = scene(opened_at=LIFT_AT + 30)
    for unknown in (-1.0, np.nan):
        phase = made.fields["phase"].copy()
        phase[LIFT_AT + 25 : LIFT_AT + 40] = unknown
        hold = only_hold(with_fields(made, phase=phase))
        assert (hold.state, hold.departed, hold.phase) == ("broken", LIFT_AT + 32, "")


def test_without_phases_only_an_empty_grip_shows() -> None:
    early = without(scene(opened_at=LIFT_AT + 30), "phase")
    assert only_hold(early).state == "carried"
    width = widths(early)
    width[LIFT_AT + 5 : LIFT_AT + 30] = 0.001
    assert only_hold(with_width(early, width)).state == "broken"


# --- effort -------------------------------------------------------------------------------------


def test_effort_that_stays_holds_and_one_that_turns_does_not() -> None:
    made = scene()
    assert only_hold(with_effort(made, efforts(made)), "effort").state == "carried"
    early = scene(opened_at=LIFT_AT + 30)
    hold = only_hold(with_effort(early, efforts(early)), "effort")
    assert (hold.state, hold.object, hold.opened) == ("broken", "effort", True)
    assert (hold.departed, hold.gap_m) == (LIFT_AT + 32, 0.0)


def test_effort_may_fall_to_a_third_and_not_to_a_tenth() -> None:
    made = scene()
    for share, state in ((0.34, "carried"), (0.1, "broken")):
        effort = efforts(made)
        effort[LIFT_AT + 10 : RELEASE_AT] *= share
        assert only_hold(with_effort(made, effort), "effort").state == state


def test_grasp_without_effort_is_none() -> None:
    made = scene()
    effort = np.where(widths(made) < 0.01, 0.5, 10.0)
    assert only_hold(with_effort(made, effort), "effort").state == "never"
    effort[:] = np.nan
    hold = only_hold(with_effort(made, effort), "effort")
    assert (hold.state, hold.reason) == ("unknown", "no value of effort at the grasp")
