"""Messages that a recorder loses of 10 topics at 200 Hz in a minute, and its CPU time."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import streams
import yaml
from rows import row

from curation_ros.bags import open_bag
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.processes import Domain, Nodes

COMMAND = "python benchmarks/run.py recorder_loss"
SECONDS = 60.0


def run(seconds: float = SECONDS) -> list[dict[str, Any]]:
    """Measure and return the rows."""
    domain = Domain()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        topics = folder / "topics.yaml"
        topics.write_text(yaml.safe_dump(streams.topic_map()))
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with Nodes(domain, folder / "logs") as nodes:
            nodes.start("recorder", {"dataset": folder / "data", "topic_map": topics})
            program = Path(__file__).with_name("streams.py")
            done = subprocess.run(
                [sys.executable, str(program), "--seconds", str(seconds)],
                env={**os.environ, **domain.environment},
                capture_output=True,
                text=True,
                check=True,
            )
            sender = resource.getrusage(resource.RUSAGE_CHILDREN)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        sent = json.loads(done.stdout.splitlines()[-1])
        bag = open_bag(Dataset(folder / "data").bag_path(sent["episode"]))
        kept = sum(topic.count for topic in bag.topics.values())
    domain.close()
    assert before.ru_utime <= sender.ru_utime
    recorder_s = after.ru_utime + after.ru_stime - sender.ru_utime - sender.ru_stime
    total = sent["sent"] * streams.N_TOPICS
    where = f"{streams.N_TOPICS} topics x {streams.RATE_HZ} Hz, {seconds:g} s"
    return [
        row(
            f"recorder loss, {where}",
            total - kept,
            "messages",
            COMMAND,
            target="0",
            holds=kept == total,
        ),
        row(f"recorder messages, {where}", kept, "messages", COMMAND),
        row(f"recorder CPU, {where}", recorder_s / seconds, "cores", COMMAND),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
