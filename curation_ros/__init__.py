"""Record, curate and judge robot demonstrations on a ROS 2 graph."""

__version__ = "0.1.0"
