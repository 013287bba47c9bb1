"""LIBERO without the system libraries that only pictures need."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

_PROGRAM = """
import sys

class NoOpenCv:
    def find_spec(self, name, path=None, target=None):
        if name == "cv2" or name.startswith("cv2."):
            raise ImportError("libGL.so.1: cannot open shared object file")

sys.meta_path.insert(0, NoOpenCv())
from sim_node.tasks.bowl_on_plate import TASK

with TASK.environment(lean=False) as env:
    print(env.reset(TASK.start("official-00").state).eef_position_m.shape)
"""


@pytest.mark.sim
def test_stock_environment_starts_without_opencv(tmp_path: Path) -> None:
    pytest.importorskip("libero")
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-500:]
    assert done.stdout.strip().endswith("(3,)")
