"""What imports nothing heavy: tasks, starts and defects can be named without a simulator."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module", ["tasks", "defects", "driving", "fields", "planning", "settings", "testing"]
)
def test_module_needs_no_simulator_no_torch_and_no_ros(module):
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('mujoco', 'libero', 'torch', 'rclpy')));"
        f"import sim_node.{module}"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
