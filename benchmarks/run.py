"""Runs benchmarks and writes their rows to benchmarks/results.json."""

from __future__ import annotations

import importlib
import json
import os
import platform
import sys
from datetime import datetime, timezone
from pathlib import Path

BENCHMARKS = (
    "closed_loop",
    "sim_speed",
    "decoding",
    "graph_speed",
    "lockstep",
    "decision_latency",
    "recorder_loss",
    "kill_cost",
    "many_episodes",
    "scorer_cost",
    "examine",
    "training_speed",
)


def main(names: list[str]) -> int:
    """Run the named benchmarks, or all; rows of the others stay as they are.

    Returns:
        The exit code: 0, or 2 if a name is unknown.
    """
    path = Path(__file__).with_name("results.json")
    old = json.loads(path.read_text())["rows"] if path.exists() else []
    fresh = []
    for name in names or BENCHMARKS:
        if name not in BENCHMARKS:
            print(f"error: no benchmark {name!r}; there are {', '.join(BENCHMARKS)}")
            return 2
        for row in importlib.import_module(name).run():
            print(f"{row['name']}: {row['value']:.4g} {row['unit']}", flush=True)
            fresh.append({**row, "measured_at": f"{datetime.now(timezone.utc):%Y-%m-%d %H:%M}Z"})
    measured = {row["name"] for row in fresh}
    rows = [row for row in old if row["name"] not in measured] + fresh
    machine = {"python": platform.python_version(), "cores": os.cpu_count()}
    path.write_text(json.dumps({"machine": machine, "rows": rows}, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
