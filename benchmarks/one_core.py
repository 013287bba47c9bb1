"""Runs a benchmark in a process of its own, with one thread: what it measures is one core."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any


def rows_of(file: str) -> list[dict[str, Any]]:
    """The rows that a benchmark's file prints as JSON lines when it is run."""
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    done = subprocess.run(
        [sys.executable, file], env={**os.environ, **one}, check=True, stdout=subprocess.PIPE
    )
    return [json.loads(line) for line in done.stdout.splitlines()]
