"""What is measured of an episode is measured once, and shared."""

from __future__ import annotations

import gc
import pickle
import weakref
from dataclasses import replace

import numpy as np
import pytest
from episodes import make_episode, with_fields

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.carrying import carrying_of
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.evidence.gripper import commanded, finger_width
from curation_ros.core.evidence.holds import carry_steps
from curation_ros.core.evidence.once import once_per_episode


def test_an_answer_is_computed_once_per_episode_object() -> None:
    asked: list[str] = []

    @once_per_episode
    def measure(episode: Episode) -> list[str]:
        asked.append(episode.name)
        return [episode.name]

    first, second = make_episode(name="a"), make_episode(name="b")
    assert measure(first) is measure(first)
    assert measure(second) == ["b"]
    assert asked == ["a", "b"]


def test_parts_and_copies_are_measured_anew() -> None:
    episode = make_episode(open_at=140)
    assert len(commanded(episode)) == len(episode)
    assert len(commanded(episode.steps(100))) == 100
    closed = with_fields(episode, gripper=np.ones((len(episode), 1)))
    assert not (commanded(closed) > 0).any()
    assert commanded(replace(episode)) is not commanded(episode)


def test_an_error_is_raised_each_time() -> None:
    episode = make_episode()
    without = replace(episode, topic_map=replace(episode.topic_map, gripper=None))
    for _ in range(2):
        with pytest.raises(EpisodeError, match="no gripper"):
            commanded(without)


@pytest.mark.parametrize("measure", [commanded, finger_width, lambda e: carry_steps(e)[0]])
def test_shared_arrays_are_read_only(measure: object) -> None:
    values = measure(make_episode())  # type: ignore[operator] # parametrised
    with pytest.raises(ValueError, match="read-only"):
        values[0] = 0


def test_nothing_that_was_computed_travels_to_another_process() -> None:
    episode = make_episode()
    size = len(pickle.dumps(episode))
    carrying_of(episode)
    held_by_fingers(episode)
    assert len(pickle.dumps(episode)) == size
    assert carrying_of(pickle.loads(pickle.dumps(episode))) == carrying_of(episode)


def test_answers_go_with_their_episode() -> None:
    episode = make_episode()
    held = weakref.ref(commanded(episode))
    assert held() is not None
    del episode
    gc.collect()
    assert held() is None
