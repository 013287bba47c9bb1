"""Runs benchmarks in processes of their own, with one thread on one core."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any


def environment() -> dict[str, str]:
    """Environment of a process whose numerical libraries use one thread."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **one}


def rows_of(file: str) -> list[dict[str, Any]]:
    """The rows that a benchmark prints as JSON lines when its file is run."""
    done = subprocess.run(
        [sys.executable, file], env=environment(), check=True, stdout=subprocess.PIPE
    )
    return [json.loads(line) for line in done.stdout.splitlines()]
