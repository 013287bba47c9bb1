"""Training: `train_many`, `train` one policy after the other, and the loop that people write.

All take turns in one process, one thread and one core, on the same demonstrations. Ratios are
taken within a round. Each figure is the median over rounds of the seconds per policy of 4,000
steps: preparation is measured as it is, and fewer steps are scaled up to 4,000.
"""

from __future__ import annotations

import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from one_core import rows_of
from rows import row
from torch.utils.data import DataLoader, TensorDataset

from curation_ros.core.episode.episode import Episode
from curation_ros.core.types import Span
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.units import named_variant
from policy_node.settings import DEFAULTS, TrainingSettings
from policy_node.train import TrainedPolicy, new_network, train
from policy_node.train_many import GROUP, TrainingJob, train_many
from policy_node.training_data import TrainingData

COMMAND = "python benchmarks/run.py training_speed"
N_ROUNDS = 5
N_STEPS = 600
N_POLICIES = 10
N_ALONE = 2
"""Policies per round that are trained one after the other."""
N_EPISODES, N_KEPT = 80, 60
N_EQUAL = 100
PAPER_STEPS = DEFAULTS.steps
TARGET_RATIO = 1.5
TARGET_DIFFERENCE = 1e-5
_SAMPLE = Path(__file__).resolve().parents[1] / "bags" / "sample"

#: The defaults, with fewer steps.
SETTINGS = TrainingSettings(steps=N_STEPS)
VARIANT = named_variant("relative")

Demonstrations = list[tuple[Episode, Span | None]]


def demonstrations(rng: np.random.Generator) -> Demonstrations:
    """The sample, stretched to 300 to 500 steps, with other starts and a little noise."""
    sample = read_episode(_SAMPLE)
    made: Demonstrations = []
    for k in range(N_EPISODES):
        n_steps = int(rng.integers(300, 501))
        rows = np.arange(n_steps) * len(sample) // n_steps
        fields = {name: values[rows] for name, values in sample.fields.items()}
        for name in ("eef_position", "bowl_position", "plate_position"):
            fields[name] = fields[name] + rng.uniform(-0.05, 0.05, 3)
        fields["twist"] = fields["twist"] + 0.01 * rng.standard_normal(fields["twist"].shape)
        stamps = sample.stamps_ns[0] + 50_000_000 * np.arange(n_steps)
        made.append((replace(sample, id=f"{k:02d}", stamps_ns=stamps, fields=fields), None))
    return made


def prepared(kept: Demonstrations) -> TrainingData:
    """Rows to learn from; every way of training begins with them."""
    return TrainingData(kept, VARIANT, SETTINGS)


def train_by_data_loader(kept: Demonstrations, seed: int) -> None:
    """The loop of tutorials: a data set of rows, shuffled batches, zero_grad, backward, step."""
    data = prepared(kept)
    network = new_network(data.widths(SETTINGS.hidden), seed)
    torch.manual_seed(seed)
    loader = DataLoader(
        TensorDataset(data.obs, data.targets), batch_size=SETTINGS.batch_size, shuffle=True
    )
    optimizer = torch.optim.Adam(
        network.parameters(), lr=SETTINGS.lr, weight_decay=SETTINGS.weight_decay
    )
    step = 0
    while step < N_STEPS:
        for obs, targets in loader:
            loss = torch.nn.functional.mse_loss(network(obs), targets)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            step += 1
            if step == N_STEPS:
                break


#: Number of policies that a way of training makes per round, and how it does so.
Way = tuple[int, Callable[[], list[TrainedPolicy] | None]]


def ways_to_train(kept: list[Demonstrations]) -> dict[str, Way]:
    """The ways that are compared.

    Args:
        kept: a selection of demonstrations for each policy.
    """
    jobs = [TrainingJob(f"policy {k}", own, VARIANT, seed=k) for k, own in enumerate(kept)]

    def one_after_the_other() -> list[TrainedPolicy]:
        return [train(kept[k], VARIANT, seed=k, settings=SETTINGS) for k in range(N_ALONE)]

    def together(group: int) -> list[TrainedPolicy]:
        trained = list(train_many(jobs, SETTINGS, group=group))
        policies = [policy for policy in trained if isinstance(policy, TrainedPolicy)]
        assert len(policies) == N_POLICIES
        return policies

    def by_data_loader() -> None:
        train_by_data_loader(kept[0], 0)

    return {
        "alone": (N_ALONE, one_after_the_other),
        "together": (N_POLICIES, lambda: together(GROUP)),
        "all together": (N_POLICIES, lambda: together(N_POLICIES)),
        "data loader": (1, by_data_loader),
    }


def measure(n_rounds: int = N_ROUNDS) -> list[dict[str, Any]]:
    """All rows, measured in this process."""
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    every = demonstrations(rng)
    # Selections of the paper's size; each policy has its own.
    kept = [
        [every[i] for i in rng.choice(N_EPISODES, N_KEPT, replace=False)]
        for _ in range(N_POLICIES)
    ]
    ways = ways_to_train(kept)
    # The first training loads what torch's optimizers need.
    train(kept[0], VARIANT, seed=0, settings=TrainingSettings(steps=1))
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    difference = 0.0
    for _ in range(n_rounds):
        results = {}
        started_s = time.perf_counter()
        prepared(kept[0])
        preparation_s = time.perf_counter() - started_s
        for name, (n_policies, way) in ways.items():
            started_s = time.perf_counter()
            results[name] = way()
            steps_s = (time.perf_counter() - started_s) / n_policies - preparation_s
            seconds[name].append(preparation_s + steps_s * PAPER_STEPS / N_STEPS)
        for a, b in zip(results["alone"] or [], results["together"] or [], strict=False):
            gaps = np.abs(np.subtract(a.losses[:N_EQUAL], b.losses[:N_EQUAL]))
            difference = max(difference, float(gaps.max()))
    return rows_from(seconds, difference)


def rows_from(seconds: dict[str, list[float]], difference: float) -> list[dict[str, Any]]:
    """The rows of the benchmark.

    Args:
        seconds: way of training -> seconds per policy in each round.
        difference: largest difference of the losses of the first two ways.
    """

    def ratio(slow: str, fast: str = "together") -> float:
        pairs = zip(seconds[slow], seconds[fast], strict=True)
        return statistics.median(a / b for a, b in pairs)

    as_row = partial(row, command=COMMAND)
    median = {name: statistics.median(values) for name, values in seconds.items()}
    unit = "s/policy"
    return [
        as_row("training, one policy after the other", median["alone"], unit),
        as_row(
            f"training, {N_POLICIES} policies by train_many",
            median["together"],
            unit,
            against="training, one policy after the other",
            ratio=ratio("alone"),
            target=f"ratio >= {TARGET_RATIO}",
            holds=ratio("alone") >= TARGET_RATIO,
        ),
        as_row(
            f"training, {N_POLICIES} policies by train_many in one group",
            median["all together"],
            unit,
            against="training, one policy after the other",
            ratio=ratio("alone", "all together"),
        ),
        as_row(
            "training, DataLoader loop",
            median["data loader"],
            unit,
            against=f"training, {N_POLICIES} policies by train_many",
            ratio=ratio("data loader"),
        ),
        as_row(
            f"training, largest difference of the first {N_EQUAL} losses",
            difference,
            "",
            against="training, one policy after the other",
            target=f"<= {TARGET_DIFFERENCE}",
            holds=difference <= TARGET_DIFFERENCE,
        ),
    ]


def run() -> list[dict[str, Any]]:
    """Measure in a process of its own, with one thread on one core, and return its rows."""
    return rows_of(__file__)


if __name__ == "__main__":
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for result in measure():
        print(json.dumps(result))
