"""Recorder node: one MCAP bag an episode, driven by the `episode` topic or by hand."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.status import (
    ERROR,
    OK,
    Status,
    counts_to_values,
    event_from_status,
)
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.live.recorder import Notice, RecordedTopic, Recording, recover_partials
from curation_ros.nodes.by_hand import Answer, ByHand
from curation_ros.nodes.delivery import deliver
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import array_to_ros, single_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import DRAIN_S, EVENTS, LATCHED
from curation_ros.nodes.spinning import run, take_all, take_arrived
from curation_ros.nodes.subscriptions import MappedSubscriptions

PARAMETERS = (
    Parameter("dataset", "dataset", "folder of the bags; made where there is none", needed=True),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("auto", True, "follow the episode topic; false: driven by ~/start and ~/stop"),
    Parameter("task", "demo", "short names are <task>-<number>, when driven by hand"),
    Parameter("min_free_mb", 500.0, "free space below which no bag is written, MB", 0.0, 1e9),
    Parameter("drain_timeout_s", DRAIN_S, "patience for late samples after an end, s", 0.0, 60.0),
    Parameter("flush_period_s", 0.1, "at most this much is lost to a kill, s", 0.01, 10.0),
)
_STOPPED = "the recorder was stopped"
_FOLLOWS: Answer = (False, "the recorder follows the episode topic (auto is true)")


class Recorder(Node):
    """Turns messages into samples and events, and notices into messages; no more."""

    def __init__(self) -> None:
        super().__init__("recorder")
        p = declare(self, PARAMETERS)
        self._map = topic_map_or_default(p["topic_map"])
        self._dataset = Dataset(Path(p["dataset"]).expanduser(), create=True)
        # Created before the data subscriptions: an executor serves ready ones in that order, so
        # `started` is taken before the samples that follow it.
        self._status = self.create_publisher(DiagnosticArray, "recorder/status", LATCHED)
        self._override = self.create_publisher(KeyValue, "curator/override", EVENTS)
        if p["auto"]:
            self.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        self._mapped = MappedSubscriptions(self, self._map, self._on_sample)
        self._recording = Recording(
            self._dataset,
            self._map,
            self._topics(),
            min_free_mb=p["min_free_mb"],
            drain_timeout_s=p["drain_timeout_s"],
            flush_period_s=p["flush_period_s"],
            publishers=self._mapped.publishers,
        )
        self.create_service(Trigger, "~/start", self._start)
        self.create_service(Trigger, "~/stop", self._stop)
        self.create_service(Trigger, "~/recover", self._recover)
        self.create_service(SetBool, "~/finalize", self._finalize)
        self._health = Health(self)
        self._last_id = ""
        # id -> name and what was said to have arrived, until that is every topic
        self._begun: dict[str, tuple[str, frozenset[str]]] = {}
        self._tell(recover_partials(self._dataset))
        self._by_hand: ByHand | None = None
        if not p["auto"]:
            clock = self._mapped.resolved(self._map.clock_topic)
            self._by_hand = ByHand(
                self, self._recording, self._tell, task=p["task"], clock_topic=clock
            )
        self._publish(Status(OK, "recorder", "idle", values={"reason": self._free()}))

    # --- messages in ------------------------------------------------------------------------

    def _on_episode(self, message: DiagnosticArray) -> None:
        try:
            event = event_from_status(single_from_ros(message))
        except CurationError as err:
            self.get_logger().error(f"topic episode: {err}")
            return
        if event.source != "replay":
            self._tell(self._recording.event(event, time.monotonic()))

    def _on_sample(self, sample: Sample) -> None:
        if self._by_hand is not None and sample.topic == self._map.clock_topic:
            self._by_hand.clock_ns = sample.stamp_ns
        self._tell(self._recording.sample(sample, time.monotonic()))

    # --- services ---------------------------------------------------------------------------

    def _start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        take_arrived(self)
        response.success, response.message = self._by_hand.start() if self._by_hand else _FOLLOWS
        return response

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        take_arrived(self)
        response.success, response.message = self._by_hand.stop() if self._by_hand else _FOLLOWS
        return response

    def _recover(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        notices = recover_partials(self._dataset)
        self._tell(notices)
        response.success = all(n.state == "closed" for n in notices)
        response.message = (
            f"{sum(n.state == 'closed' for n in notices)} of {len(notices)} recovered"
        )
        return response

    def _finalize(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        verdict = "keep" if request.data else "discard"
        if not self._last_id:
            response.message = "no episode has been recorded yet"
        elif self._override.get_subscription_count() == 0:
            response.message = "no curator listens: use curation override"
        else:
            self._override.publish(
                KeyValue(key=self._last_id, value=f"{verdict} with the recorder's button")
            )
            if self._by_hand is not None:
                self._dataset.append_truth({"episode": self._last_id, "button": verdict})
            response.success, response.message = True, f"{verdict} {self._last_id}"
        return response

    # --- messages out -----------------------------------------------------------------------

    def work(self) -> bool:
        """Flush, close and report."""
        now_s = time.monotonic()
        self._tell(self._recording.tick(now_s))
        self._tell_what_arrives()
        if self._health.due(now_s):
            problems = self._mapped.check(running=bool(self._recording.open_ids))
            self._recording.topics |= self._topics()
            if self.count_publishers("episode") > 1:
                problems.insert(0, "topic episode has two owners: stop one of them")
            self._health.publish(now_s, problems, {"free": self._free(), **self._mapped.seen()})
        return False

    def close(self) -> None:
        """Close the open bag as aborted, with all that was sent; who owns the episode says so."""
        if self._recording.open_ids:
            take_all(self)
        was_open = bool(self._recording.open_ids)
        if self._by_hand is not None:
            self._by_hand.give_up(_STOPPED)
        self._tell(self._recording.abort(_STOPPED))
        if was_open:  # the curator must hear of it: it judges the bag, not what went on
            deliver([self._status])

    def _tell_what_arrives(self) -> None:
        """Say of an episode, once its commands come, which topics do, so that its owner may go on.

        A topic without a sample counts 0; what is there later is said later.
        """
        for episode_id, (name, said) in list(self._begun.items()):
            counts = dict.fromkeys(self._map.topics, 0) | self._recording.counts(episode_id)
            arrived = frozenset(topic for topic, n in counts.items() if n)
            if arrived == said or not arrived.issuperset(self._map.command_topics):
                continue
            self._begun[episode_id] = name, arrived
            if len(arrived) == len(counts):
                del self._begun[episode_id]
            values = {"reason": "its commands arrive", **counts_to_values(counts)}
            self._publish(Status(OK, name, f"recording {episode_id}", episode_id, values))

    def _tell(self, notices: Sequence[Notice]) -> None:
        for n in notices:
            self._last_id = n.id if n.state == "closed" else self._last_id
            self._begun.pop(n.id, None)
            if n.state == "recording":
                self._begun[n.id] = n.name, frozenset()
            level = ERROR if n.state == "failed" else OK
            values = {"reason": n.reason or self._free()}
            values |= counts_to_values(n.counts)
            self._publish(Status(level, n.name, f"{n.state} {n.id}", n.id, values))
            line = f"{n.state} {n.name or n.id}{': ' + n.reason if n.reason else ''}"
            # rclpy refuses a line of code that logs with two severities.
            if n.state == "failed":
                self.get_logger().error(line)
            else:
                self.get_logger().info(line)

    def _topics(self) -> dict[str, RecordedTopic]:
        return {
            t: RecordedTopic(self._mapped.resolved(t), kind, self._mapped.qos(t))
            for t, kind in self._map.topics.items()
        }

    def _publish(self, status: Status) -> None:
        self._status.publish(array_to_ros([status], self._now()))

    def _now(self) -> int:
        return int(self.get_clock().now().nanoseconds)

    def _free(self) -> str:
        return f"{self._recording.free_mb() / 1000:.1f} GB free"


def main() -> int:
    """Entry point of `ros2 run curation_ros recorder`."""
    return run(Recorder, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
