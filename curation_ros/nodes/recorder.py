"""Recorder node: one MCAP bag an episode, driven by the `episode` topic or by hand."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.errors import CurationError
from curation_ros.core.identity import new_episode_id
from curation_ros.core.status import (
    ERROR,
    OK,
    EpisodeEvent,
    Status,
    counts_to_values,
    event_from_status,
    event_to_status,
)
from curation_ros.core.stream import Sample
from curation_ros.dataset import Dataset
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import array_to_ros, single_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import DRAIN_S, EVENTS, LATCHED
from curation_ros.nodes.spinning import run
from curation_ros.nodes.subscriptions import MappedSubscriptions
from curation_ros.recording import Notice, RecordedTopic, Recording, recover_partials

PARAMETERS = (
    Parameter("dataset", "dataset", "folder that the bags go to; made where it does not exist"),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("auto", True, "follow the episode topic; false: driven by ~/start and ~/stop"),
    Parameter("task", "demo", "short names are <task>-<number>, when driven by hand"),
    Parameter("min_free_mb", 500.0, "free space below which no bag is written, MB", 0.0, 1e9),
    Parameter("drain_timeout_s", DRAIN_S, "patience for late samples after an end, s", 0.0, 60.0),
    Parameter("flush_period_s", 0.1, "at most this much is lost to a kill, s", 0.01, 10.0),
)
_STOPPED = "the recorder was stopped"


class Recorder(Node):
    """Turns messages into samples and events, and notices into messages; no more."""

    def __init__(self) -> None:
        super().__init__("recorder")
        p = declare(self, PARAMETERS)
        self._auto, self._task = p["auto"], p["task"]
        self._dataset = Dataset(Path(p["dataset"]).expanduser(), create=True)
        self._map = topic_map_or_default(p["topic_map"])
        # Created before the data subscriptions: an executor serves ready ones in that order, so
        # `started` is taken before the samples that follow it.
        self._status = self.create_publisher(DiagnosticArray, "recorder/status", LATCHED)
        self._override = self.create_publisher(KeyValue, "curator/override", EVENTS)
        if self._auto:
            self.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        else:
            self._episode = self.create_publisher(DiagnosticArray, "episode", LATCHED)
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
        self._by_hand: EpisodeEvent | None = None
        self._clock_ns = 0
        self._last_id = ""
        self._tell(recover_partials(self._dataset))
        self._number = 0 if self._auto else self._last_number()
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
        if sample.topic == self._map.clock_topic:
            self._clock_ns = sample.stamp_ns
        self._tell(self._recording.sample(sample, time.monotonic()))

    # --- driven by hand ---------------------------------------------------------------------

    def _start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        clock = self._mapped.resolved(self._map.clock_topic)
        problem = ""
        if self._auto:
            problem = "the recorder follows the episode topic (auto is true)"
        elif self._by_hand is not None:
            problem = f"episode {self._by_hand.name} is running: stop it first"
        elif not self._clock_ns:
            problem = f"nothing has arrived on {clock}, whose stamps are the episode's clock"
        if problem:
            response.message = problem
            return response
        name = f"{self._task}-{self._number + 1:04d}"
        event = EpisodeEvent(new_episode_id(), name, "started", self._clock_ns + 1)
        notices = self._recording.event(event, time.monotonic())
        if event.id in self._recording.open_ids:
            self._number += 1
            self._by_hand = event
            self._publish_event(event)
            response.success = True
            response.message = json.dumps({"episode": event.id, "name": name})
        else:
            response.message = "; ".join(n.reason for n in notices)
        self._tell(notices)
        return response

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        started = self._by_hand
        if started is None:
            response.message = "no episode was started by ~/start"
            return response
        self._end(replace(started, event="ended", end_ns=self._end_ns(started)))
        response.success = True
        response.message = json.dumps({"episode": started.id, "name": started.name})
        return response

    def _end(self, event: EpisodeEvent) -> None:
        self._by_hand = None
        self._publish_event(event)
        self._tell(self._recording.event(event, time.monotonic()))

    def _last_number(self) -> int:
        named = [name.rpartition("-") for _, name in self._dataset.names()]
        return max(
            (int(n) for task, _, n in named if task == self._task and n.isdigit()), default=0
        )

    def _publish_event(self, event: EpisodeEvent) -> None:
        self._episode.publish(array_to_ros([event_to_status(event)], self._now()))

    def _end_ns(self, started: EpisodeEvent) -> int:
        return max(self._clock_ns, started.start_ns)

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
            if not self._auto:
                self._dataset.append_truth({"episode": self._last_id, "button": verdict})
            response.success, response.message = True, f"{verdict} {self._last_id}"
        return response

    # --- messages out -----------------------------------------------------------------------

    def work(self) -> bool:
        """Flush, close and report."""
        now_s = time.monotonic()
        self._tell(self._recording.tick(now_s))
        if self._health.due(now_s):
            problems = self._mapped.check(running=bool(self._recording.open_ids))
            self._recording.topics |= self._topics()
            if self.count_publishers("episode") > 1:
                problems.insert(0, "topic episode has two owners: stop one of them")
            self._health.publish(now_s, problems, {"free": self._free()})
        return False

    def close(self) -> None:
        """Close the open bag as aborted, with all it has; who owns the episode says so."""
        if (started := self._by_hand) is not None:
            end_ns, reason = self._end_ns(started), f"aborted: {_STOPPED}"
            self._end(replace(started, event="aborted", end_ns=end_ns, reason=reason))
        self._tell(self._recording.abort(_STOPPED))

    def _tell(self, notices: list[Notice]) -> None:
        for n in notices:
            self._last_id = n.id if n.state == "closed" else self._last_id
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
    return run(Recorder)


if __name__ == "__main__":
    raise SystemExit(main())
