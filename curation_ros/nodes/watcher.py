"""Collects episodes, alerts and decisions from the graph, for programs that show them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from types import TracebackType

import rclpy
import rclpy.context
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from curation_ros.core.episode.status import EpisodeEvent, Status, event_from_status
from curation_ros.core.errors import CurationError
from curation_ros.nodes.messages import single_from_ros
from curation_ros.nodes.qos import DECISIONS, EVENTS, LATCHED


class Watcher:
    """Collects messages; use it in a `with` block.

    Whoever shows a message takes it from its queue.

    Attributes:
        events: messages of topic `episode`, oldest first.
        alerts: messages of topic `curator/alert`, oldest first.
        decisions: messages of topic `curator/decision`, oldest first.
    """

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Set the environment of this process.

        Args:
            environment: ROS variables of the domain to watch.
        """
        os.environ.update(environment)
        self.events: deque[EpisodeEvent] = deque()
        self.alerts: deque[Status] = deque()
        self.decisions: deque[Status] = deque()
        self._context = rclpy.context.Context()

    def __enter__(self) -> Watcher:
        # rclpy installs no signal handlers for such a context: Ctrl-C belongs to the program.
        rclpy.init(context=self._context)
        self._node = rclpy.create_node("watcher", context=self._context)
        self._node.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        self._node.create_subscription(DiagnosticArray, "curator/alert", self._on_alert, EVENTS)
        self._node.create_subscription(
            DiagnosticArray, "curator/decision", self._on_decision, DECISIONS
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._node.destroy_node()
        self._context.try_shutdown()

    def look(self, seconds: float) -> None:
        """Receive at most one message.

        Args:
            seconds: how long to wait for it.
        """
        self._executor.spin_once(timeout_sec=seconds)

    def _on_episode(self, message: DiagnosticArray) -> None:
        with suppress(CurationError):  # the nodes log it
            self.events.append(event_from_status(single_from_ros(message)))

    def _on_alert(self, message: DiagnosticArray) -> None:
        with suppress(CurationError):
            self.alerts.append(single_from_ros(message))

    def _on_decision(self, message: DiagnosticArray) -> None:
        with suppress(CurationError):
            self.decisions.append(single_from_ros(message))
