"""Control steps a second on the graph: the expert and a policy in lockstep, all nodes running."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

from decision_latency import record

from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_selected, save_selection
from curation_ros.nodes.evaluate import evaluate_on_graph
from curation_ros.nodes.processes import Domain, Nodes
from policy_node.train import train

COMMAND = "python benchmarks/run.py graph_speed"
N_EPISODES = 8


def run() -> list[dict[str, Any]]:
    """Measure; a row a figure."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        reference = record(folder / "reference", episodes=6, seed=101)
        domain = Domain()
        dataset = folder / "live"
        with Nodes(domain, folder / "logs") as nodes:
            nodes.start("recorder", {"dataset": dataset})
            nodes.start("curator", {"dataset": dataset, "reference": [reference]})
            nodes.start(
                "sim_node",
                {"dataset": dataset, "episodes": N_EPISODES, "wait_for": ["recorder", "curator"]},
            )
            began_s = _first_episode(dataset)
            nodes.wait("sim_node", 300.0)
            expert_s = time.monotonic() - began_s
        domain.close()
        # The first episode started the watch.
        expert_steps = sum(t["steps"] for t in list(Dataset(dataset).truth().values())[1:])
        manifest, _ = save_selection(Dataset(dataset), rule="all", name="all")
        policy = train(read_selected(manifest, Dataset(dataset)), seed=0, steps=500).policy
        policy.save(folder / "policy")
        stamps = []
        steps = 0
        for row in evaluate_on_graph(
            folder / "policy", policy.id, "generated:3:5", log_folder=folder / "logs"
        ):
            stamps.append(time.monotonic())
            steps += row["steps"] if len(stamps) > 1 else 0
        driven_s = stamps[-1] - stamps[0]
    rows = (
        ("graph steps, expert, sim + recorder + curator", expert_steps / expert_s),
        ("graph steps, policy in lockstep, sim + policy_node", steps / driven_s),
    )
    return [
        {
            "name": name,
            "value": value,
            "unit": "steps/s",
            "against": "",
            "ratio": None,
            "target": None,
            "holds": None,
            "command": COMMAND,
        }
        for name, value in rows
    ]


def _first_episode(dataset: Path) -> float:
    """Wait for the first episode to end; start-up is another figure."""
    while not Dataset(dataset, create=True).truth_log.path.exists():
        time.sleep(0.02)
    return time.monotonic()


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
