"""Time per scorer on an episode of 350 steps, with 14 columns of state and 4 of action.

The episodes are copies of the sample demonstration, stretched to 350 steps, with other starts and
noise. Scorers that learn are fitted on 50 of them. The best of several passes counts, because
other work on the machine only adds time.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rows import row

from curation_ros.batch.published import TABLE_1
from curation_ros.core.episode.episode import Episode
from curation_ros.core.scorers import SCORERS, Scorer
from curation_ros.dataset.episodes import read_episode

COMMAND = "python benchmarks/run.py scorer_cost"
N_STEPS = 350
_N_FITTED, _N_SCORED, _N_PASSES = 50, 50, 15
_SAMPLE = Path(__file__).resolve().parents[1] / "bags" / "sample"


def episodes(n: int, rng: np.random.Generator) -> list[Episode]:
    """Stretched, shifted and noisy copies of the sample demonstration."""
    sample = read_episode(_SAMPLE)
    rows = np.arange(N_STEPS) * len(sample) // N_STEPS
    made = []
    for k in range(n):
        fields = {name: values[rows] for name, values in sample.fields.items()}
        noise = 0.01 * rng.standard_normal(fields["twist"].shape)
        fields["twist"] = fields["twist"] + noise
        # A held object moves with the effector, and another start moves everything.
        moved = np.cumsum(noise * 0.1, axis=0) + rng.uniform(-0.1, 0.1, 3)
        for name in ("eef_position", "bowl_position", "plate_position"):
            fields[name] = fields[name] + moved
        stamps = sample.stamps_ns[0] + 50_000_000 * np.arange(N_STEPS)
        made.append(replace(sample, id=f"{k}", stamps_ns=stamps, fields=fields))
    assert made[0].state.shape == (N_STEPS, 14)
    assert made[0].action.shape == (N_STEPS, 4)
    return made


def cost_us(scorers: Sequence[Scorer], scored: Sequence[Episode]) -> float:
    """Microseconds per episode; each is a fresh copy, so that nothing is cached."""
    best = float("inf")
    for _ in range(_N_PASSES):
        fresh = [replace(episode) for episode in scored]
        began = time.perf_counter()
        for episode in fresh:
            for scorer in scorers:
                scorer.score(episode)
        best = min(best, time.perf_counter() - began)
    return 1e6 * best / len(scored)


def run() -> list[dict[str, Any]]:
    """Measure and return the rows."""
    made = episodes(_N_FITTED + _N_SCORED, np.random.default_rng(0))
    fitted = {name: kind().fit(made[:_N_FITTED]) for name, kind in SCORERS.items()}
    scored = made[_N_FITTED:]
    paper = [fitted[name] for name in TABLE_1 if name in SCORERS]
    costs = {f"cost of {name}": cost_us([scorer], scored) for name, scorer in fitted.items()}
    costs["cost of the seven scorers of the paper"] = cost_us(paper, scored)
    return [
        row(f"{name}, episode of {N_STEPS} steps", value, "us", COMMAND)
        for name, value in costs.items()
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
