"""Alerts of the live curator while an episode is running."""

from __future__ import annotations

import pytest
from live_takes import (
    DRAIN_S,
    early_take,
    good_take,
    interleaved,
    live_curator,
    stream_of,
    watch,
)
from streams import ended, started

from curation_ros.dataset.dataset import Dataset

# --- alerts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_loss_is_told_while_the_episode_runs(dataset: Dataset, seed: int) -> None:
    """Whatever the order in which topics come; once; with the span that the decision has."""
    live, episode = live_curator(dataset), early_take()
    live.event(started(episode), 0.0)
    alerts = []
    for sample in interleaved(stream_of("early"), seed):
        live.sample(sample, 0.0)
        alerts += live.take_alerts()
    [alert] = alerts
    assert (alert.episode, alert.name) == (episode.id, episode.name)
    [decided] = live.event(ended(episode), 0.0) + live.tick(DRAIN_S)
    assert alert.finding == decided.decision.findings[0]
    assert alert.finding.id == "object-lost"
    assert "in LIFT" in alert.finding.message
    left_ns = episode.start_ns + alert.finding.span[0]
    assert 0 < alert.seen_ns - left_ns <= 0.3e9 + 1e9 * (seed > 0)
    assert live.take_alerts() == []


def test_a_good_episode_alarms_nobody(dataset: Dataset) -> None:
    live = live_curator(dataset)
    watch(live, good_take(), stream_of("good"))
    assert live.take_alerts() == []


def test_a_silent_pose_alarms_nobody(dataset: Dataset) -> None:
    live, episode = live_curator(dataset), good_take()
    stop_ns = episode.start_ns + 120 * 50_000_000
    silent = [s for s in stream_of("good") if s.topic != "eef_pose" or s.stamp_ns < stop_ns]
    watch(live, episode, silent)
    assert live.take_alerts() == []
