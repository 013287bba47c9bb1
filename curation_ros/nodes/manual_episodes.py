"""Episodes that a person starts and stops. The recorder owns them and publishes `episode`."""

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

#: Whether a request was granted, and the message of the answer.
Answer = tuple[bool, str]


class ManualEpisodes:
    """Starts and ends episodes at stamps of the clock topic, never at the recorder's own time.

    Attributes:
        clock_ns: last stamp of the clock topic, in ns; the recorder keeps it up to date.
    """

    def __init__(
        self,
        node: Node,
        recording: Recording,
        publish_notices: Callable[[Sequence[Notice]], None],
        *,
        name_prefix: str,
        clock_topic: str,
    ) -> None:
        """Become the owner of `episode`.

        Args:
            node: the recorder.
            recording: writes the bags.
            publish_notices: publishes what happened to the bags.
            name_prefix: short names are <name_prefix>-<number>. Numbers continue those of the
                dataset.
            clock_topic: resolved name of the clock topic, for messages.
        """
        self._node = node
        self._recording = recording
        self._publish_notices = publish_notices
        self._name_prefix = name_prefix
        self._clock_topic = clock_topic
        named = [name.rpartition("-") for _, name in recording.dataset.names()]
        numbers = [int(n) for prefix, _, n in named if prefix == name_prefix and n.isdigit()]
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
                f"no message on {self._clock_topic} yet; its stamps are the episode's clock"
            )
        name = f"{self._name_prefix}-{self._number + 1:04d}"
        event = EpisodeEvent(new_episode_id(), name, "started", self.clock_ns + 1)
        notices = self._recording.event(event, time.monotonic())
        self._publish_notices(notices)
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
        """Abort the running episode, if there is one, and wait until all subscribers know.

        Args:
            reason: why, for people.
        """
        if self._running is not None:
            self._end(replace(self._running, event="aborted", reason=f"aborted: {reason}"))
            deliver([self._episode])

    def _end(self, event: EpisodeEvent) -> None:
        self._running = None
        event = replace(event, end_ns=max(self.clock_ns, event.start_ns))
        self._publish(event)
        self._publish_notices(self._recording.event(event, time.monotonic()))

    def _publish(self, event: EpisodeEvent) -> None:
        stamp_ns = self._node.get_clock().now().nanoseconds
        self._episode.publish(array_to_ros([event_to_status(event)], stamp_ns))
