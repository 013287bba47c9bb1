"""Meaning of the gripper: hold, both signs, both kinds, and the check against the fingers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from episodes import make_episode, topic_map, with_fields
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import GripperSpec
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.gripper import (
    contradiction,
    finger_width,
    first_opening,
    gripper_findings,
    is_closed_command,
    is_open_command,
    opening_of,
    width_state,
)


def commanded(*command: float, **spec: object) -> Episode:
    """An episode with these commands, under the shipped map with `spec` changed."""
    episode = make_episode(n_steps=len(command))
    gripper = replace(topic_map().gripper or GripperSpec("gripper"), **spec)  # type: ignore[arg-type]
    episode = with_fields(episode, gripper=np.array(command, dtype=float)[:, None])
    return replace(episode, topic_map=replace(topic_map(), gripper=gripper))


def finger_opening(episode: Episode) -> int | None:
    width = finger_width(episode)
    assert width is not None
    return opening_of(width_state(width))


def test_zero_holds_the_previous_command() -> None:
    episode = commanded(0, -1, 0, 0, 1, 0, -0.2, 0)
    np.testing.assert_array_equal(is_open_command(episode), [0, 1, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(is_closed_command(episode), [0, 0, 0, 0, 1, 1, 0, 0])


def test_sign_is_the_declared_one() -> None:
    episode = commanded(-1, 1, -1, opens=1, open_value=1.0, closed_value=-1.0)
    np.testing.assert_array_equal(is_open_command(episode), [0, 1, 0])


def test_continuous_command_goes_to_the_nearer_end_and_the_middle_holds() -> None:
    spec = {"kind": "continuous", "opens": 1, "open_value": 0.08, "closed_value": 0.0}
    episode = commanded(0.08, 0.05, 0.04, 0.03, 0.04, 0.041, **spec)
    np.testing.assert_array_equal(is_open_command(episode), [1, 1, 1, 0, 0, 1])


def test_nan_holds() -> None:
    np.testing.assert_array_equal(is_open_command(commanded(-1, np.nan, 1, np.nan)), [1, 1, 0, 0])


def test_first_opening_wants_a_closing_before_it() -> None:
    assert first_opening(commanded(-1, -1, 1, 1, -1, -1)) == 4
    assert first_opening(commanded(-1, -1, 1, 1, 0, 0)) is None
    assert first_opening(commanded(-1, -1, -1)) is None
    assert first_opening(commanded(1, -1, 1, -1)) == 1
    assert first_opening(make_episode(n_steps=0)) is None


@given(st.lists(st.sampled_from([-1, 0, 1]), min_size=1, max_size=30))
def test_first_opening_agrees_with_a_plain_loop(command: list[int]) -> None:
    closed, expected = False, None
    for step, value in enumerate(command):
        closed = closed or value == 1
        if closed and value == -1:
            expected = step
            break
    assert first_opening(commanded(*command)) == expected


def test_finger_width_of_two_one_and_mimic_columns() -> None:
    episode = make_episode(n_steps=3)
    two = with_fields(episode, finger_position=np.array([[0.04, -0.04], [0.01, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(finger_width(two), [0.08, 0.01, 0.0])
    one = with_fields(episode, finger_position=np.array([[0.08], [0.01], [0.0]]))
    np.testing.assert_allclose(finger_width(one), [0.08, 0.01, 0.0])
    mimic = with_fields(episode, finger_position=np.array([[0.04, 0.04], [0.01, 0.01], [0, 0]]))
    np.testing.assert_allclose(finger_width(mimic), [0.08, 0.02, 0.0])
    assert finger_width(commanded(-1, 1, fingers="")) is None


def test_fingers_follow_after_their_lag(rng: np.random.Generator) -> None:
    assert finger_opening(make_episode(rng, open_at=140, finger_lag=3)) == 143
    assert finger_opening(make_episode(rng, close_at=None)) is None


@pytest.mark.parametrize("open_at", [-1, 140, None])
@pytest.mark.parametrize("lag", [0, 2, 8])
def test_right_sign_is_no_contradiction(
    rng: np.random.Generator, open_at: int | None, lag: int
) -> None:
    assert contradiction(make_episode(rng, open_at=open_at, finger_lag=lag)) is None


@pytest.mark.parametrize("open_at", [-1, 140, None])
def test_inverted_sign_is_explained(rng: np.random.Generator, open_at: int | None) -> None:
    text = contradiction(make_episode(rng, opens=1, open_at=open_at))
    assert text is not None
    assert "72 mm" in text
    assert "(opens: -1) looks inverted" in text


def test_inverted_sign_names_the_command_and_the_way(rng: np.random.Generator) -> None:
    # Sent with +1 for open, the closing at step 95 reads as an opening; the fingers close.
    assert contradiction(make_episode(rng, opens=1, open_at=None)) == (
        "after an opening command the fingers moved together by 72 mm: the sign declared in the "
        "topic map (opens: -1) looks inverted"
    )


@pytest.mark.parametrize("rate_hz", [5.0, 20.0, 500.0])
def test_contradiction_counts_time_not_steps(rng: np.random.Generator, rate_hz: float) -> None:
    lag = int(0.3 * rate_hz)
    episode = make_episode(rng, opens=1, rate_hz=rate_hz, finger_lag=lag, n_steps=600)
    assert contradiction(episode) is not None


def test_fingers_that_do_not_move_are_no_contradiction(rng: np.random.Generator) -> None:
    episode = make_episode(rng, opens=1)
    still = np.tile([0.02, -0.02], (len(episode), 1)) + 1e-4 * rng.standard_normal((240, 2))
    assert contradiction(with_fields(episode, finger_position=still)) is None
    nothing = with_fields(episode, finger_position=np.full((len(episode), 2), np.nan))
    assert contradiction(nothing) is None


# --- kinds that the data contradict -------------------------------------------------------------


def recoded(episode: Episode, opened: float, closed: float, **spec: object) -> Episode:
    """The same motion with other numbers, under a map with `spec` changed."""
    is_open = episode.fields["gripper"] < 0
    gripper = replace(topic_map().gripper or GripperSpec("gripper"), **spec)  # type: ignore[arg-type]
    episode = with_fields(episode, gripper=np.where(is_open, opened, closed))
    return replace(episode, topic_map=replace(topic_map(), gripper=gripper))


def test_zero_and_one_is_not_binary_where_zero_moves_the_fingers(
    rng: np.random.Generator,
) -> None:
    assert contradiction(recoded(make_episode(rng), 0.0, 1.0)) == (
        "the command is never below 0, so that with kind binary it can only close, yet the "
        "fingers moved apart by 72 mm after it went to 0: kind continuous?"
    )
    opens = {"opens": 1, "open_value": 1.0, "closed_value": 0.0}
    assert contradiction(recoded(make_episode(rng), 1.0, 0.0, **opens)) == (
        "the command is never below 0, so that with kind binary it can only open, yet the "
        "fingers moved together by 72 mm after it went to 0: kind continuous?"
    )
    right = recoded(make_episode(rng), 1.0, 0.0, kind="continuous", **opens)
    assert contradiction(right) is None


def test_widths_are_not_binary(rng: np.random.Generator) -> None:
    text = contradiction(recoded(make_episode(rng), 0.08, 0.008))
    assert text is not None
    assert "only close, yet the fingers moved apart by 72 mm after it went to 0.08" in text


def test_one_sided_without_fingers_is_refused_only_where_it_stays_small(
    rng: np.random.Generator,
) -> None:
    text = contradiction(recoded(make_episode(rng, open_at=180), 0.0, 1.0, fingers=""))
    assert text is not None
    assert text.endswith("can only close, yet it goes back to 0: kind continuous?")
    never = make_episode(rng, open_at=None)  # 0 holds until it closes, for good
    assert contradiction(recoded(never, 0.0, 1.0, fingers="")) is None
    press = np.zeros((240, 1))
    press[95:100] = 1.0  # a button: closes, and 0 holds
    held = with_fields(recoded(never, 0.0, 1.0, fingers=""), gripper=press)
    assert contradiction(held) is None


def test_zero_that_holds_is_no_contradiction(rng: np.random.Generator) -> None:
    # A button that closes, then nothing: the fingers stay together.
    episode = make_episode(rng, open_at=None)
    press = np.zeros((240, 1))
    press[95:130] = 1.0
    assert contradiction(with_fields(episode, gripper=press)) is None
    # They close further, as the object has slipped away.
    fingers = episode.fields["finger_position"].copy()
    fingers[132:] = 0.0
    slipped = with_fields(episode, gripper=press, finger_position=fingers)
    assert contradiction(slipped) is None
    # A policy's outputs of both signs are binary by their sign.
    unsure = make_episode(rng).fields["gripper"] * rng.uniform(0.05, 1.0, (240, 1))
    assert contradiction(with_fields(make_episode(rng), gripper=unsure)) is None


def test_continuous_commands_beyond_the_declared_ends_are_refused(
    rng: np.random.Generator,
) -> None:
    ends = {"kind": "continuous", "opens": 1, "open_value": 0.08, "closed_value": 0.0}
    text = contradiction(recoded(make_episode(rng), 1.0, -1.0, **ends))
    assert text == (
        "100% of the commands lie outside open_value 0.08 and closed_value 0: "
        "they run from -1 to 1"
    )
    assert contradiction(recoded(make_episode(rng), 0.085, -0.005, **ends)) is None  # overshoot
    glitch = recoded(make_episode(rng), 0.08, 0.0, **ends)
    command = glitch.fields["gripper"].copy()
    command[50:55] = 7.0
    command[60] = np.nan
    assert contradiction(with_fields(glitch, gripper=command)) is None


@given(
    st.lists(st.sampled_from([-1.0, 0.0, 1.0, np.nan]), min_size=2, max_size=60),
    st.sampled_from([-1, 1]),
    st.integers(0, 3),
)
def test_fingers_that_obey_the_declared_meaning_never_contradict_it(
    command: list[float], opens: int, lag: int
) -> None:
    ends = {"opens": opens, "open_value": float(opens), "closed_value": -float(opens)}
    episode = commanded(*command, **ends)
    # Open until the first command to close.
    wide = ~is_closed_command(episode)[np.maximum(np.arange(len(command)) - lag, 0)]
    fingers = np.outer(np.where(wide, 0.04, 0.004), [1.0, -1.0])
    assert contradiction(with_fields(episode, finger_position=fingers)) is None


@given(st.lists(st.floats(-1, 1, allow_nan=False), min_size=2, max_size=40), st.floats(0.01, 100))
def test_meaning_does_not_depend_on_the_unit_of_the_command(
    command: list[float], unit: float
) -> None:
    ends = {"kind": "continuous", "opens": 1}
    here = commanded(*command, open_value=1.0, closed_value=-1.0, **ends)
    there = commanded(*(unit * c for c in command), open_value=unit, closed_value=-unit, **ends)
    clear = np.abs(command) > 1e-9  # at the exact middle rounding decides
    np.testing.assert_array_equal(is_open_command(here)[clear], is_open_command(there)[clear])


def test_gripper_finding_spans_the_episode(rng: np.random.Generator) -> None:
    episode = make_episode(rng, opens=1)
    (finding,) = gripper_findings(episode)
    assert finding.id == "gripper-meaning"
    assert finding.span == (0, episode.end_ns - episode.start_ns)
    assert gripper_findings(make_episode(rng)) == ()


def test_map_without_gripper_raises_and_finds_nothing(rng: np.random.Generator) -> None:
    episode = replace(make_episode(rng), topic_map=replace(topic_map(), gripper=None))
    with pytest.raises(EpisodeError, match="no gripper"):
        is_open_command(episode)
    assert contradiction(episode) is None
    assert gripper_findings(episode) == ()
