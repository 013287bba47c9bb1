"""Control steps per second on the graph: the expert, and a policy in lockstep."""

from __future__ import annotations

import json
import tempfile
import time
from pathlib import Path
from typing import Any

from recorded import record
from rows import row

from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_selected, save_selection
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.study.graph_rollouts import evaluate_on_graph
from curation_ros.study.units import named_variant
from policy_node.settings import TrainingSettings
from policy_node.train import train

COMMAND = "python benchmarks/run.py graph_speed"
N_EPISODES = 8


def expert_rate(folder: Path, dataset: Dataset) -> float:
    """Steps per second while the expert's demonstrations are recorded and curated."""
    reference = record(folder / "reference", episodes=6, seed=101)
    domain = Domain()
    with Nodes(domain, folder / "logs") as nodes:
        nodes.start("recorder", {"dataset": dataset.path})
        nodes.start("curator", {"dataset": dataset.path, "reference": [reference]})
        nodes.start(
            "sim_node",
            {"dataset": dataset.path, "episodes": N_EPISODES, "wait_for": ["recorder", "curator"]},
        )
        # The clock starts at the end of the first episode, to leave the start-up out.
        while not dataset.truth_log.path.exists():
            time.sleep(0.02)
        began_s = time.monotonic()
        nodes.wait("sim_node", 300.0)
        elapsed_s = time.monotonic() - began_s
    domain.close()
    steps: int = sum(t["steps"] for t in list(dataset.truth().values())[1:])
    return steps / elapsed_s


def policy_rate(folder: Path, dataset: Dataset) -> float:
    """Steps per second of a policy in lockstep; the first rollout is left out."""
    manifest, _ = save_selection(dataset, rule="all", name="all")
    demonstrations = read_selected(manifest, dataset)
    settings = TrainingSettings(steps=500)
    policy = train(demonstrations, named_variant("relative"), seed=0, settings=settings).policy
    policy.save(folder / "policy")
    ends_s, steps = [], 0
    for rollout in evaluate_on_graph(
        folder / "policy", policy.card.id, "generated:3:5", log_folder=folder / "logs"
    ):
        ends_s.append(time.monotonic())
        steps += rollout["steps"] if len(ends_s) > 1 else 0
    return steps / (ends_s[-1] - ends_s[0])


def run() -> list[dict[str, Any]]:
    """Measure and return the rows."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        dataset = Dataset(folder / "live", create=True)
        expert, policy = expert_rate(folder, dataset), policy_rate(folder, dataset)
    return [
        row("graph steps, expert, sim + recorder + curator", expert, "steps/s", COMMAND),
        row("graph steps, policy in lockstep, sim + policy_node", policy, "steps/s", COMMAND),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
