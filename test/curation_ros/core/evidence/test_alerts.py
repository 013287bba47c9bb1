"""The alert of a running episode is that of the complete one, only sooner."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import (
    APPROACH,
    LIFT_AT,
    RELEASE_AT,
    TRANSPORT_AT,
    one_after_the_other,
    scene,
    tracked,
    without,
)

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.evidence.alerts import OPEN_S, AlertWatch, alerts_of
from curation_ros.core.types import NS_PER_S

LEFT = scene(is_taken=False, tremor_m=1e-5)
LOST = scene(dropped_at=LIFT_AT + 20)
CARRIED = scene()
#: Let go by command, in TRANSPORT.
OPENED_AT = TRANSPORT_AT + 20
OPENED = scene(dropped_at=OPENED_AT + 2, opened_at=OPENED_AT)


def no_fingers(episode: Episode) -> Episode:
    gripper = episode.topic_map.gripper
    assert gripper is not None
    return replace(
        episode,
        topic_map=replace(episode.topic_map, gripper=replace(gripper, fingers="")),
    )


def pressed(episode: Episode, at: int, n_steps: int) -> Episode:
    """The command is to open for some steps; nothing comes of it."""
    command = episode.fields["gripper"].copy()
    command[at : at + n_steps] = -1.0
    return replace(episode, fields={**episode.fields, "gripper": command})


def poorly_tracked(episode: Episode) -> Episode:
    """By a pose that comes half a second late."""
    rng = np.random.default_rng(1)
    bowl = tracked(episode.fields["bowl_position"], rng, 0.01, late=10, dropout=0.3)
    return replace(episode, fields={**episode.fields, "bowl_position": bowl})


def jumped(episode: Episode, at: int) -> Episode:
    """The pose of the object is of something else from a step on."""
    bowl = episode.fields["bowl_position"].copy()
    bowl[at:] = [0.5, 0.5, 0.5]
    bowl[at:] += 1e-4 * np.arange(len(bowl) - at)[:, None]
    return replace(episode, fields={**episode.fields, "bowl_position": bowl})


def upside_down(episode: Episode) -> Episode:
    """The topic map has the sign of the command wrong."""
    return replace(episode, fields={**episode.fields, "gripper": -episode.fields["gripper"]})


def silent(episode: Episode, first: int, last: int) -> Episode:
    gap = Finding("gap", "topic 'x': silent", episode.span(first, last))
    return replace(episode, findings=(gap,))


NO_OBJECT = {
    "let go": without(OPENED, "object"),
    "slipped": without(scene(dropped_at=LIFT_AT + 20), "object"),
    "carried": without(CARRIED, "object"),
}
EPISODES: dict[str, tuple[Episode, str | None]] = {
    "carried": (CARRIED, None),
    "lost in LIFT": (LOST, "object-lost"),
    "lost in TRANSPORT": (scene(dropped_at=TRANSPORT_AT + 20), "object-lost"),
    "let go in TRANSPORT": (OPENED, "object-lost"),
    "left behind": (LEFT, "not-carried"),
    # The first loss raises the alert, live and afterwards.
    "left behind, then lost": (one_after_the_other(LEFT, LOST), "not-carried"),
    "lost, then left behind": (one_after_the_other(LOST, LEFT), "object-lost"),
    # Without the pose of an object, by the gripper.
    "no object, carried": (NO_OBJECT["carried"], None),
    "no object, let go": (NO_OBJECT["let go"], "grip-lost"),
    "no object, no fingers, carried": (no_fingers(NO_OBJECT["carried"]), None),
    "no object, no fingers, let go": (no_fingers(NO_OBJECT["let go"]), "opened-early"),
    "no object, no phases, let go": (without(OPENED, "object", "phase"), None),
    "jumps, then let go": (jumped(OPENED, TRANSPORT_AT + 5), "grip-lost"),
    "jumps, and is carried": (jumped(CARRIED, TRANSPORT_AT + 5), None),
    # A pose that comes too late does not keep the operator waiting.
    "late pose, let go": (poorly_tracked(OPENED), "opened-early"),
    "late pose, carried": (poorly_tracked(CARRIED), None),
    # A slip of the thumb is none; and at the end of TRANSPORT a topic may be one step behind.
    "pressed for a moment": (pressed(CARRIED, TRANSPORT_AT + 9, 2), None),
    "pressed for long": (pressed(CARRIED, TRANSPORT_AT + 9, 8), "opened-early"),
    "one step early": (scene(opened_at=RELEASE_AT - 1), None),
    "never closed": (without(scene(opened_at=APPROACH), "object"), None),
    # What a command means must not be in doubt.
    "upside down": (without(upside_down(CARRIED), "object"), None),
    # A gap in the data raises no alert about what happened near it.
    "a gap at the loss": (silent(LOST, LIFT_AT + 10, LIFT_AT + 19), None),
    "a gap in the approach": (silent(LOST, 5, 15), "object-lost"),
    "a gap at the command": (silent(NO_OBJECT["let go"], OPENED_AT, OPENED_AT + 3), None),
}


@pytest.mark.parametrize("name", EPISODES)
def test_alert_is_raised_once_and_is_that_of_the_complete_episode(name: str) -> None:
    episode, expected = EPISODES[name]
    watch = AlertWatch(episode.topic_map)
    taken = [watch.take(episode.steps(n)) for n in range(2, len(episode) + 1)]
    [*found] = [finding for finding in taken if finding is not None]
    assert [f.id for f in found] == ([] if expected is None else [expected])
    whole = AlertWatch(episode.topic_map).take(episode)
    assert found == ([] if whole is None else [whole])


@pytest.mark.parametrize("name", [n for n, (_, expected) in EPISODES.items() if expected])
def test_alert_is_raised_as_soon_as_it_is_certain(name: str) -> None:
    """Its span ends at the step at which it is raised. A step takes 0.05 s."""
    episode, _ = EPISODES[name]
    watch = AlertWatch(episode.topic_map)
    for n in range(2, len(episode) + 1):
        if (finding := watch.take(episode.steps(n))) is not None:
            assert finding.span[1] == episode.span(n - 1, n - 1)[0] or "jumps" in name
            assert finding.span[1] - finding.span[0] <= 0.3 * NS_PER_S
            return
    raise AssertionError("no alert was raised")


def test_messages_about_the_gripper() -> None:
    def alert(name: str) -> Finding:
        episode, _ = EPISODES[name]
        finding = AlertWatch(episode.topic_map).take(episode)
        assert finding is not None
        return finding

    at_s = OPENED_AT / 20
    assert alert("no object, no fingers, let go") == Finding(
        "opened-early",
        f"the gripper was commanded to open at {at_s:.2f} s in TRANSPORT",
        (round(at_s * NS_PER_S), round((at_s + OPEN_S) * NS_PER_S)),
    )
    # The fingers of the scene follow two steps behind the command.
    assert alert("no object, let go").message == (
        f"the fingers had let go at {at_s + 0.1:.2f} s in TRANSPORT, as finger_position shows"
    )


def test_what_trusted_episodes_show_raises_no_alert() -> None:
    """A robot that throws: its object leaves in TRANSPORT, after a command to open."""
    assert {f.id for f in alerts_of(OPENED)} == {"object-lost", "opened-early"}
    usual = AlertWatch(OPENED.topic_map, usual=("object-lost", "opened-early"))
    assert usual.take(OPENED) is None
    assert not usual.has_alerted
    only = AlertWatch(OPENED.topic_map, usual=("object-lost",)).take(OPENED)
    assert only is not None
    assert only.id == "opened-early"
