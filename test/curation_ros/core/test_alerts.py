"""What is said of an episode that grows is what is said of the whole one."""

from __future__ import annotations

import pytest
from scenes import LIFT_AT, TRANSPORT_AT, one_after_the_other, scene

from curation_ros.core.alerts import AlertWatch
from curation_ros.core.episode import Episode

LEFT = scene(is_taken=False, tremor_m=1e-5)
LOST = scene(dropped_at=LIFT_AT + 20)
CARRIED = scene()
EPISODES: dict[str, tuple[Episode, str | None]] = {
    "carried": (CARRIED, None),
    "lost in LIFT": (LOST, "object-lost"),
    "lost in TRANSPORT": (scene(dropped_at=TRANSPORT_AT + 20), "object-lost"),
    "left behind": (LEFT, "not-carried"),
    # The first that goes wrong is told, live and afterwards.
    "left behind, then lost": (one_after_the_other(LEFT, LOST), "not-carried"),
    "lost, then left behind": (one_after_the_other(LOST, LEFT), "object-lost"),
}


@pytest.mark.parametrize("name", EPISODES)
def test_told_once_and_the_same_as_of_the_whole(name: str) -> None:
    episode, expected = EPISODES[name]
    watch = AlertWatch(episode.topic_map)
    told = [watch.take(episode.steps(n)) for n in range(2, len(episode) + 1)]
    [*found] = [finding for finding in told if finding is not None]
    assert [f.id for f in found] == ([] if expected is None else [expected])
    whole = AlertWatch(episode.topic_map).take(episode)
    assert found == ([] if whole is None else [whole])
