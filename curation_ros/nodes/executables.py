"""What `recorder` and the other programs start: a node, or one line on what it lacks."""

from __future__ import annotations

import importlib
import importlib.util
import os
import signal
import sys
from functools import partial

from curation_ros.nodes.processes import NODE_MODULES

_WRONG_SETUP = 2
_OF_SIM = ("libero", "llvmlite", "mujoco", "numba", "robosuite")


def _run(node: str) -> int:
    # Who is stopped while it is still importing, which takes seconds, has nothing to tidy up.
    signal.signal(signal.SIGINT, lambda *_: os._exit(0))
    try:
        module = importlib.import_module(NODE_MODULES[node])
    except ImportError as err:
        if not isinstance(err, ModuleNotFoundError):  # it is there, and does not load
            print(f"error: {node}: {str(err).partition(chr(10))[0]}", file=sys.stderr)  # noqa: T201
            return _WRONG_SETUP
        missing = str(err.name).partition(".")[0]
        if importlib.util.find_spec("rclpy") is None:
            remedy = (
                "source /opt/ros/jazzy/setup.bash; or, on a machine without ROS 2, install "
                "curation_ros with its extra [ros]"
            )
        elif missing in _OF_SIM:
            remedy = "install curation_ros with its extra [sim]"
        else:
            remedy = f"it is not installed for {sys.executable}"
        print(f"error: {node} needs {missing}: {remedy}", file=sys.stderr)  # noqa: T201
        return _WRONG_SETUP
    return int(module.main())


sim_node = partial(_run, "sim_node")
recorder = partial(_run, "recorder")
curator = partial(_run, "curator")
policy_node = partial(_run, "policy_node")
replay = partial(_run, "replay")
