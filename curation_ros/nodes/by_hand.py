"""Episodes of a recorder that a person drives: it is their owner, and says so on `episode`."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent, event_to_status
from curation_ros.live.recorder import Notice, Recording
from curation_ros.nodes.delivery import deliver
from curation_ros.nodes.messages import array_to_ros
from curation_ros.nodes.qos import LATCHED

#: Whether a request was granted, and what to answer.
Answer = tuple[bool, str]


class ByHand:
    """Starts and ends episodes at the stamps of the clock topic, never at the recorder's time.

    Attributes:
        clock_ns: last stamp of the clock topic; kept by the recorder.
    """

    def __init__(
        self,
        node: Node,
        recording: Recording,
        tell: Callable[[Sequence[Notice]], None],
        *,
        task: str,
        clock_topic: str,
    ) -> None:
        """Become the owner of `episode`.

        Args:
            node: the recorder.
            recording: writes the bags.
            tell: publishes what became of them.
            task: short names are <task>-<number>, going on where the dataset stands.
            clock_topic: resolved name, for messages.
        """
        self._node = node
        self._recording = recording
        self._tell = tell
        self._task = task
        self._clock_topic = clock_topic
        named = [name.rpartition("-") for _, name in recording.dataset.names()]
        numbers = [int(n) for name, _, n in named if name == task and n.isdigit()]
        self._number = max(numbers, default=0)
        self._running: EpisodeEvent | None = None
        self._episode = node.create_publisher(DiagnosticArray, "episode", LATCHED)
        self.clock_ns = 0

    def start(self) -> Answer:
        """Start an episode after the last stamp seen."""
        if self._running is not None:
            return False, f"episode {self._running.name} is running: stop it first"
        if not self.clock_ns:
            return False, (
                f"nothing has arrived on {self._clock_topic}, whose stamps are the episode's clock"
            )
        name = f"{self._task}-{self._number + 1:04d}"
        event = EpisodeEvent(new_episode_id(), name, "started", self.clock_ns + 1)
        notices = self._recording.event(event, time.monotonic())
        self._tell(notices)
        if event.id not in self._recording.open_ids:
            return False, "; ".join(n.reason for n in notices)
        self._number += 1
        self._running = event
        self._publish(event)
        return True, json.dumps({"episode": event.id, "name": name})

    def stop(self) -> Answer:
        """End the running episode at the last stamp seen."""
        started = self._running
        if started is None:
            return False, "no episode was started by ~/start"
        self._end(replace(started, event="ended"))
        return True, json.dumps({"episode": started.id, "name": started.name})

    def give_up(self, reason: str) -> None:
        """Abort the running episode, if there is one, and see that everybody hears of it."""
        if self._running is not None:
            self._end(replace(self._running, event="aborted", reason=f"aborted: {reason}"))
            deliver([self._episode])

    def _end(self, event: EpisodeEvent) -> None:
        self._running = None
        event = replace(event, end_ns=max(self.clock_ns, event.start_ns))
        self._publish(event)
        self._tell(self._recording.event(event, time.monotonic()))

    def _publish(self, event: EpisodeEvent) -> None:
        stamp_ns = self._node.get_clock().now().nanoseconds
        self._episode.publish(array_to_ros([event_to_status(event)], stamp_ns))
