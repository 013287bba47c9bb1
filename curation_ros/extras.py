"""Which extra of the package brings an optional module, for messages about a missing one."""

from __future__ import annotations

import re

#: Top-level module -> extra in setup.py.
EXTRAS = {
    "libero": "sim",
    "llvmlite": "sim",
    "mujoco": "sim",
    "numba": "sim",
    "robosuite": "sim",
    "torch": "policy",
    "matplotlib": "report",
    "ray": "ray",
    "dask": "dask",
    "distributed": "dask",
    "pyarrow": "parquet",
}
_OF_ROS = re.compile(r"rclpy|\w+_(msgs|srvs|interfaces)")


def how_to_install(module: str) -> str:
    """What to do about a missing module.

    Args:
        module: name of the module; only its first part counts.

    Returns:
        A command, or alternatives, to follow a colon.
    """
    name = module.partition(".")[0]
    if _OF_ROS.fullmatch(name):
        return "source /opt/ros/jazzy/setup.bash; on a machine without ROS: pip install '.[ros]'"
    if name in EXTRAS:
        return f"pip install '.[{EXTRAS[name]}]'"
    return "pip install ."
