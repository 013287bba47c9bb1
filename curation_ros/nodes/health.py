"""Health of a node on /diagnostics, once per second."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from curation_ros.core.episode.status import ERROR, OK, Status
from curation_ros.nodes.messages import array_to_ros
from curation_ros.nodes.qos import EVENTS

_PERIOD_S = 1.0


def publishers_found(counts: Mapping[str, int]) -> dict[str, str]:
    """The number of publishers per topic, as values of a report.

    Args:
        counts: full name of a topic -> number of publishers that the node has found.
    """
    return {f"publishers/{topic.lstrip('/')}": str(n) for topic, n in counts.items()}


class Health:
    """Publishes the status of a node: OK, or ERROR with the first problem as its message."""

    def __init__(self, node: Node) -> None:
        """Create the publisher.

        Args:
            node: the node whose health it is.
        """
        self._node = node
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", EVENTS)
        self._last_s = 0.0

    def due(self, now_s: float) -> bool:
        """Whether a second has passed since the last report."""
        return now_s - self._last_s >= _PERIOD_S

    def publish(
        self,
        now_s: float,
        problems: Sequence[str],
        values: Mapping[str, str],
        episode_id: str = "",
    ) -> None:
        """Publish a report.

        Args:
            now_s: the time that `due` was asked about, in s.
            problems: what is wrong now, the worst problem first.
            values: figures of the node.
            episode_id: the running episode, which the figures are about; may be empty.
        """
        self._last_s = now_s
        level, message = (ERROR, problems[0]) if problems else (OK, "ok")
        status = Status(
            level, self._node.get_fully_qualified_name().strip("/"), message, episode_id, values
        )
        stamp_ns = self._node.get_clock().now().nanoseconds
        self._publisher.publish(array_to_ros([status], stamp_ns))
