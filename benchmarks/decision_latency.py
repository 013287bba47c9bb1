"""How long after an episode's end the curator decides: 100 episodes of 500 steps over DDS.

Real demonstrations (LIBERO, early release, 500 steps) are played under new ids and stamps to a
curator with a recorder beside it. The curator itself reports the time from the gate's closing to
the published decision; the time that an operator sees, from `ended` to the decision's arrival,
is measured here.
"""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from robot import Robot, stamped

from curation_ros.bags.reader import open_bag
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import playback_order
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.messages import status_from_ros
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.nodes.qos import EVENTS

COMMAND = "python benchmarks/run.py decision_latency"
N_EPISODES = 100
_SPEED = 15.0  # times real time: 300 steps a second


def record(folder: Path, **parameters: Any) -> Path:
    """Record demonstrations with the sim's expert; returns the dataset."""
    domain = Domain()
    with Nodes(domain, folder / "logs") as nodes:
        nodes.start("recorder", {"dataset": folder})
        nodes.start("sim_node", {"dataset": folder, "wait_for": ["recorder"], **parameters})
        nodes.wait("sim_node", 300.0)
    domain.close()
    return folder


def run() -> list[dict[str, Any]]:
    """Measure; a row a figure."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        reference = record(folder / "reference", episodes=6, seed=101)
        source = record(folder / "source", episodes=5, seed=7, contamination=1.0)
        topic_map = topic_map_or_default("")
        bags = [open_bag(path) for path in Dataset(source).bags()]
        episodes = [(bag.event(), playback_order(bag.samples(topic_map))) for bag in bags]
        domain = Domain()
        inside: list[float] = []
        seen: list[float] = []

        def on_health(message: DiagnosticArray) -> None:
            for status in map(status_from_ros, message.status):
                if status.name == "curator" and "latency_ms_p99" in status.values:
                    inside[:] = [
                        float(status.values[k]) for k in ("latency_ms_p50", "latency_ms_p99")
                    ] + [float(status.values["decisions"])]

        with (
            Nodes(domain, folder / "logs") as nodes,
            Robot(domain.environment, topic_map.topics) as robot,
        ):
            robot.node.create_subscription(DiagnosticArray, "/diagnostics", on_health, EVENTS)
            dataset = folder / "live"
            nodes.start("recorder", {"dataset": dataset})
            nodes.start("curator", {"dataset": dataset, "reference": [reference]})
            robot.wait_for_subscribers(2)
            for k in range(N_EPISODES):
                event, samples = episodes[k % len(episodes)]
                assert event is not None
                assert event.end_ns is not None
                shift_ns = (k + 1) * 1000 * NS_PER_S
                start_ns, end_ns = event.start_ns + shift_ns, event.end_ns + shift_ns
                episode, name = new_episode_id(), f"bench-{k:03d}"
                robot.tell(EpisodeEvent(episode, name, "started", start_ns))
                robot.until(
                    lambda e=episode: robot.recorder.get(e) == "recording",  # type: ignore[misc]
                    f"start of {name}",
                )
                # As fast as the sim, not faster: in a burst DDS drops messages and sends them
                # again seconds later.
                first_s, first_ns = time.monotonic(), samples[0].stamp_ns
                for sample in samples:
                    due_s = (sample.stamp_ns - first_ns) / NS_PER_S / _SPEED
                    time.sleep(max(0.0, first_s + due_s - time.monotonic()))
                    data = stamped(sample.data, sample.stamp_ns + shift_ns)
                    robot.outputs[sample.topic].publish(data)
                ended = EpisodeEvent(episode, name, "ended", start_ns, end_ns, event.counts)
                began_s = time.monotonic()
                robot.tell(ended)
                robot.until(lambda e=episode: e in robot.decisions, f"decision on {name}")  # type: ignore[misc]
                seen.append(1e3 * (robot.decisions[episode][0] - began_s))
                robot.until(
                    lambda e=episode: robot.recorder.get(e) == "closed",  # type: ignore[misc]
                    f"bag of {name}",
                )
            robot.until(lambda: bool(inside) and inside[2] >= N_EPISODES, "health of the curator")
        domain.close()
    p50, p99 = np.percentile(seen, [50, 99])

    def row(name: str, value: float, target: float | None = None) -> dict[str, Any]:
        return {
            "name": name,
            "value": float(value),
            "unit": "ms",
            "against": "",
            "ratio": None,
            "target": None if target is None else f"<= {target:g} ms",
            "holds": None if target is None else bool(value <= target),
            "command": COMMAND,
        }

    return [
        row("decision latency, gate closed to decision published, median", inside[0]),
        row("decision latency, gate closed to decision published, p99", inside[1], 100.0),
        row("decision latency, ended published to decision received, median", p50),
        row("decision latency, ended published to decision received, p99", p99),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
