"""Time from the end of an episode to the decision: 100 episodes of 500 steps over DDS.

Real demonstrations (LIBERO, early release, 500 steps) are published under new ids and stamps to a
recorder and a curator. The curator itself reports the time from the closing of the gate to the
published decision. The time that an operator waits, from `ended` to the arrival of the decision,
is measured here.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from recorded import record
from robot import Robot, stamped
from rows import row

from curation_ros.bags import open_bag
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample, playback_order
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.messages import status_from_ros
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.nodes.qos import EVENTS

COMMAND = "python benchmarks/run.py decision_latency"
N_EPISODES = 100
TARGET_MS = 100.0
#: Times real time: 300 steps per second.
_SPEED = 15.0

Recorded = tuple[EpisodeEvent, Sequence[Sample]]


def play(robot: Robot, recorded: Recorded, number: int) -> float:
    """Publish an episode under a new id and stamps, and wait for decision and bag.

    Returns:
        Milliseconds from `ended` to the arrival of the decision.
    """
    event, samples = recorded
    assert event.end_ns is not None
    shift_ns = (number + 1) * 1000 * NS_PER_S
    start_ns, end_ns = event.start_ns + shift_ns, event.end_ns + shift_ns
    episode, name = new_episode_id(), f"bench-{number:03d}"

    def recorder_says(state: str) -> Callable[[], bool]:
        return lambda: robot.recorder.get(episode) == state

    robot.tell(EpisodeEvent(episode, name, "started", start_ns))
    robot.until(recorder_says("recording"), f"start of {name}")
    # Not faster than the simulator: in a burst DDS drops messages and sends them again seconds
    # later.
    first_s, first_ns = time.monotonic(), samples[0].stamp_ns
    for sample in samples:
        due_s = (sample.stamp_ns - first_ns) / NS_PER_S / _SPEED
        time.sleep(max(0.0, first_s + due_s - time.monotonic()))
        data = stamped(sample.data, sample.stamp_ns + shift_ns)
        robot.outputs[sample.topic].publish(data)
    ended = EpisodeEvent(episode, name, "ended", start_ns, end_ns, event.counts)
    began_s = time.monotonic()
    robot.tell(ended)
    robot.until(lambda: episode in robot.decisions, f"decision on {name}")
    latency_ms = 1e3 * (robot.decisions[episode][0] - began_s)
    robot.until(recorder_says("closed"), f"bag of {name}")
    return latency_ms


def measure(folder: Path) -> tuple[dict[str, float], list[float]]:
    """The curator's own figures, and the latency of each episode in milliseconds."""
    reference = record(folder / "reference", episodes=6, seed=101)
    source = record(folder / "source", episodes=5, seed=7, contamination=1.0)
    topic_map = topic_map_or_default("")
    recorded: list[Recorded] = []
    for bag in map(open_bag, Dataset(source).bags()):
        event = bag.event()
        assert event is not None
        recorded.append((event, playback_order(bag.samples(topic_map))))
    health: dict[str, float] = {}

    def on_health(message: DiagnosticArray) -> None:
        for status in map(status_from_ros, message.status):
            if status.name == "curator" and "latency_ms_p99" in status.values:
                for key in ("latency_ms_p50", "latency_ms_p99", "decisions"):
                    health[key] = float(status.values[key])

    domain = Domain()
    with (
        Nodes(domain, folder / "logs") as nodes,
        Robot(domain.environment, topic_map.topics) as robot,
    ):
        robot.node.create_subscription(DiagnosticArray, "/diagnostics", on_health, EVENTS)
        nodes.start("recorder", {"dataset": folder / "live"})
        nodes.start("curator", {"dataset": folder / "live", "reference": [reference]})
        robot.wait_for_subscribers(2)
        latencies_ms = [play(robot, recorded[k % len(recorded)], k) for k in range(N_EPISODES)]
        robot.until(lambda: health.get("decisions", 0) >= N_EPISODES, "health of the curator")
    domain.close()
    return health, latencies_ms


def run() -> list[dict[str, Any]]:
    """Measure and return the rows."""
    with tempfile.TemporaryDirectory() as temporary:
        health, latencies_ms = measure(Path(temporary))
    p50, p99 = (float(p) for p in np.percentile(latencies_ms, [50, 99]))
    inside = "decision latency, gate closed to decision published"
    outside = "decision latency, ended published to decision received"
    inside_p99 = health["latency_ms_p99"]
    as_row = partial(row, unit="ms", command=COMMAND)
    return [
        as_row(f"{inside}, median", health["latency_ms_p50"]),
        as_row(
            f"{inside}, p99",
            inside_p99,
            target=f"<= {TARGET_MS:g} ms",
            holds=inside_p99 <= TARGET_MS,
        ),
        as_row(f"{outside}, median", p50),
        as_row(f"{outside}, p99", p99),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
