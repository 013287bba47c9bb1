"""A robot for benchmarks: publishes prepared CDR bytes, and owns the episodes."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any

import rclpy
import rclpy.context
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor

from curation_ros.core.episode.status import EpisodeEvent, Status, event_to_status
from curation_ros.core.types import NS_PER_S
from curation_ros.nodes.messages import array_to_ros, message_type, single_from_ros
from curation_ros.nodes.qos import DECISIONS, LATCHED, MAPPED

PATIENCE_S = 60.0


def stamped(data: bytes, stamp_ns: int) -> bytes:
    """The same message with another header stamp (little-endian CDR)."""
    return data[:4] + struct.pack("<iI", *divmod(stamp_ns, NS_PER_S)) + data[12:]


class Robot:
    """Publishes the topics of a map and the `episode` topic, and keeps decisions and states.

    Attributes:
        outputs: topic -> its publisher.
        decisions: episode -> time of arrival (monotonic clock, s) and the decision.
        recorder: episode -> state of the recorder.
    """

    def __init__(self, environment: Mapping[str, str], topics: Mapping[str, str]) -> None:
        """Join the graph; use in a `with` block."""
        os.environ.update(environment)
        self._context = rclpy.context.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("robot", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.decisions: dict[str, tuple[float, Status]] = {}
        self.recorder: dict[str, str] = {}
        self.node.create_subscription(
            DiagnosticArray, "curator/decision", self._on_decision, DECISIONS
        )
        self.node.create_subscription(
            DiagnosticArray, "recorder/status", self._on_recorder, LATCHED
        )
        self._episode = self.node.create_publisher(DiagnosticArray, "episode", LATCHED)
        self.outputs: dict[str, Any] = {
            topic: self.node.create_publisher(message_type(kind, topic), topic, MAPPED)
            for topic, kind in topics.items()
        }

    def __enter__(self) -> Robot:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.node.destroy_node()
        self._context.try_shutdown()

    def tell(self, event: EpisodeEvent) -> None:
        """Publish the start or the end of an episode."""
        self._episode.publish(array_to_ros([event_to_status(event)], event.start_ns))

    def until(self, is_true: Callable[[], bool], what: str) -> None:
        """Spin until a condition holds.

        Args:
            is_true: the condition.
            what: name of the condition for the error.

        Raises:
            TimeoutError: after a minute.
        """
        deadline_s = time.monotonic() + PATIENCE_S
        while not is_true():
            self._executor.spin_once(timeout_sec=0.01)
            if time.monotonic() > deadline_s:
                raise TimeoutError(what)

    def wait_for_subscribers(self, n: int) -> None:
        """Wait until each topic has `n` subscribers."""
        everything = (self._episode, *self.outputs.values())
        self.until(
            lambda: all(p.get_subscription_count() >= n for p in everything),
            f"{n} subscribers on every topic",
        )

    def _on_decision(self, message: DiagnosticArray) -> None:
        status = single_from_ros(message)
        self.decisions[status.hardware_id] = (time.monotonic(), status)

    def _on_recorder(self, message: DiagnosticArray) -> None:
        status = single_from_ros(message)
        self.recorder[status.hardware_id] = status.message.partition(" ")[0]
