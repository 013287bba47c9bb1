"""Seconds until an episode can begin: from a fresh interpreter, and by a reset, on either path.

Steps a second are measured with a policy in the loop, by `closed_loop`. The machine is rarely
idle, so the paths take turns, and each figure is a median over rounds.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from typing import Any

from rows import row

from sim_node.settings import SIMULATED_TASK
from sim_node.tasks import TASKS

COMMAND = "python benchmarks/run.py sim_speed"
N_RESETS = 7
N_STARTS = 3


def fresh_start_s(lean: bool) -> float:
    """Seconds from a fresh interpreter to the first observation, with warm caches."""
    code = (
        f"from sim_node.tasks import TASKS; task = TASKS[{SIMULATED_TASK!r}]; "
        f"task.environment(lean={lean}).reset(task.start('official-00').state)"
    )
    started_s = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], check=True)
    return time.perf_counter() - started_s


def reset_s() -> dict[bool, list[float]]:
    """Seconds of each reset, settling included, by whether the path is lean."""
    seconds: dict[bool, list[float]] = {True: [], False: []}
    task = TASKS[SIMULATED_TASK]
    environments = {lean: task.environment(lean=lean) for lean in (True, False)}
    for k in range(N_RESETS + 1):
        for lean, env in environments.items():
            state = task.start(f"generated-0-{k:03d}").state
            started_s = time.perf_counter()
            env.reset(state)
            if k > 0:  # the first one warms up
                seconds[lean].append(time.perf_counter() - started_s)
    return seconds


def run() -> list[dict[str, Any]]:
    """Measure and return one row a figure."""
    starts: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(N_STARTS):
        for lean, values in starts.items():
            values.append(fresh_start_s(lean))
    rows = []
    for name, seconds in (("sim start", starts), ("sim reset", reset_s())):
        pairs = zip(seconds[True], seconds[False], strict=True)
        ratio = statistics.median(a / b for a, b in pairs)
        for lean in (True, False):
            rows.append(
                row(
                    f"{name}, {'lean' if lean else 'stock'}",
                    statistics.median(seconds[lean]),
                    "s",
                    COMMAND,
                    against=f"{name}, stock" if lean else "",
                    ratio=ratio if lean else None,
                )
            )
    return rows


if __name__ == "__main__":
    for result in run():
        print(json.dumps(result))
