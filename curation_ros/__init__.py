"""Record, curate and judge robot demonstrations on a ROS 2 graph."""

from curation_ros.version import __version__

__all__ = ["__version__"]
