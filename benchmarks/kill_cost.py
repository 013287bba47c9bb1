"""What is lost by `kill -9` of the recorder during an episode, at 10 topics and 200 Hz."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import streams
import yaml
from rows import row

from curation_ros.bags import open_bag
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.live.recorder import recover_partials
from curation_ros.nodes.processes import Domain, Nodes

COMMAND = "python benchmarks/run.py kill_cost"
N_KILLS = 8
TARGET_S = 0.3


def one(folder: Path, after_s: float) -> float:
    """Kill a recorder and recover its bag.

    Args:
        folder: empty, for the dataset and the logs.
        after_s: seconds from the start of the episode to the kill.

    Returns:
        Seconds up to the kill that are missing of the worst topic.
    """
    domain = Domain()
    topics = folder / "topics.yaml"
    topics.write_text(yaml.safe_dump(streams.topic_map()))
    try:
        with Nodes(domain, folder / "logs") as nodes:
            nodes.start("recorder", {"dataset": folder / "data", "topic_map": topics})
            program = Path(__file__).with_name("streams.py")
            sender = subprocess.Popen(
                [sys.executable, str(program), "--seconds", str(after_s + 1), "--no-end"],
                env={**os.environ, **domain.environment},
                stdout=subprocess.PIPE,
                text=True,
            )
            assert sender.stdout is not None
            begun = json.loads(sender.stdout.readline())
            time.sleep(after_s)
            nodes.send("recorder", signal.SIGKILL)
            killed_ns = time.time_ns()
            sender.communicate()
    finally:
        domain.close()
    dataset = Dataset(folder / "data")
    notices = recover_partials(dataset)
    assert [n.state for n in notices] == ["closed"], notices
    topic_map = topic_map_from_json(streams.topic_map())
    last: dict[str, int] = {}
    for sample in open_bag(dataset.bag_path(begun["episode"])).samples(topic_map):
        last[sample.topic] = max(last.get(sample.topic, 0), sample.stamp_ns)
    # Stamps are wall-clock times.
    return (killed_ns - min(last[topic] for topic in topic_map.topics)) / NS_PER_S


def run(n_kills: int = N_KILLS) -> list[dict[str, Any]]:
    """Measure and return the rows."""
    rng = random.Random(0)
    lost_s = []
    for _ in range(n_kills):
        with tempfile.TemporaryDirectory() as temporary:
            lost_s.append(one(Path(temporary), rng.uniform(2.0, 4.0)))
    median, worst = sorted(lost_s)[n_kills // 2], max(lost_s)
    what = f"of {n_kills}, lost"
    return [
        row(f"kill -9 of the recorder, median {what}", median, "s", COMMAND),
        row(
            f"kill -9 of the recorder, worst {what}",
            worst,
            "s",
            COMMAND,
            target=f"< {TARGET_S:g} s",
            holds=worst < TARGET_S,
        ),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
