from __future__ import annotations

import subprocess
import sys

import pytest

PROBE = """
import importlib, sys
for name in {blocked!r}:
    sys.modules[name] = None
importlib.import_module({module!r})
"""
HEAVY = ("torch", "mujoco", "robosuite", "libero", "numba", "sim_node")
ROS = ("rclpy", "sensor_msgs")


@pytest.mark.parametrize(
    "module",
    [
        *("policy", "mlp", "observation", "action", "settings", "variants", "controller"),
        *("testing", "live", "command_messages"),
    ],
)
def test_acting_needs_neither_torch_nor_simulator_nor_ros(module):
    run_with_blocked(f"policy_node.{module}", (*HEAVY, *ROS))


@pytest.mark.policy
@pytest.mark.parametrize("module", ["train", "train_many", "training_data"])
def test_training_needs_neither_simulator_nor_ros(module):
    run_with_blocked(f"policy_node.{module}", (*HEAVY[1:], *ROS))


@pytest.mark.sim
def test_rollouts_need_neither_torch_nor_ros():
    run_with_blocked("policy_node.rollouts", ("torch", *ROS))


def run_with_blocked(module, blocked):
    code = PROBE.format(module=module, blocked=blocked)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
