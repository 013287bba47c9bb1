"""Control steps a second: LIBERO's `env.step`, our lean loop, and bare MuJoCo, side by side.

The machine is rarely idle, so the three take turns in one process, and ratios are taken within a
round; each figure is a median over rounds.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from sim_node.env import LiberoEnv
from sim_node.starts import generated_start

COMMAND = "python benchmarks/sim_speed.py"
N_ROUNDS = 7
N_STEPS = 60
N_STARTS = 3
TARGET_RATIO = 2.5


def fresh_start_s(lean: bool) -> float:
    """Seconds from a fresh interpreter to the first observation, with warm caches."""
    code = (
        "from sim_node.env import LiberoEnv; from sim_node.starts import official_start; "
        f"LiberoEnv(lean={lean}).reset(official_start(0).state)"
    )
    started_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - started_s


def run(n_rounds: int = N_ROUNDS, n_steps: int = N_STEPS) -> list[dict[str, Any]]:
    """Measure and return one row a figure.

    Args:
        n_rounds: turns that each way of stepping takes.
        n_steps: control steps a turn.
    """
    state = generated_start(0, 0).state
    actions = np.random.default_rng(0).uniform(-0.2, 0.2, (n_steps, 3))
    with LiberoEnv() as lean, LiberoEnv(lean=False) as stock:

        def commanded(env: LiberoEnv) -> Callable[[int], None]:
            def step(k: int) -> None:
                env.step(actions[k], -1.0)
                env.is_success()

            return step

        def bare(k: int) -> None:
            # The same scene without controller: the arm hangs in its own gravity compensation.
            lean.data.ctrl[:7] = lean.data.qfrc_bias[:7]
            mujoco.mj_step(lean.model, lean.data, nstep=25)

        steppers = {
            "stock": (stock, commanded(stock)),
            "lean": (lean, commanded(lean)),
            "bare": (lean, bare),
        }
        rates: dict[str, list[float]] = {name: [] for name in steppers}
        resets: dict[str, list[float]] = {"stock": [], "lean": []}
        for round_index in range(n_rounds + 1):
            for name, (env, step) in steppers.items():
                env.reset(state)
                started_s = time.perf_counter()
                for k in range(n_steps):
                    step(k)
                elapsed_s = time.perf_counter() - started_s
                if round_index == 0:
                    continue  # compiles and warms up
                rates[name].append(n_steps / elapsed_s)
                if name in resets:
                    resets[name].append(env.reset_s)

    def ratio(over: str, under: str) -> float:
        return statistics.median(a / b for a, b in zip(rates[over], rates[under], strict=True))

    def row(
        name: str, value: float, unit: str, against: str = "", **extra: float | str | bool
    ) -> dict[str, Any]:
        empty = {"ratio": None, "target": None, "holds": None}
        return {
            "name": name,
            "value": value,
            "unit": unit,
            "against": against,
            **empty,
            **extra,
            "command": COMMAND,
        }

    start_s = {
        name: statistics.median(fresh_start_s(name == "lean") for _ in range(N_STARTS))
        for name in resets
    }
    median = {name: statistics.median(values) for name, values in rates.items()}
    speedup = ratio("lean", "stock")
    return [
        row("sim stock", median["stock"], "steps/s"),
        row(
            "sim lean",
            median["lean"],
            "steps/s",
            "sim stock",
            ratio=speedup,
            target=f"ratio >= {TARGET_RATIO}",
            holds=speedup >= TARGET_RATIO,
        ),
        row(
            "sim bare mj_step", median["bare"], "steps/s", "sim lean", ratio=ratio("bare", "lean")
        ),
        row(
            "sim start, lean",
            start_s["lean"],
            "s",
            "sim start, stock",
            ratio=start_s["lean"] / start_s["stock"],
        ),
        row("sim start, stock", start_s["stock"], "s"),
        row(
            "sim reset, lean",
            statistics.median(resets["lean"]),
            "s",
            "sim reset, stock",
            ratio=statistics.median(resets["lean"]) / statistics.median(resets["stock"]),
        ),
        row("sim reset, stock", statistics.median(resets["stock"]), "s"),
    ]


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
