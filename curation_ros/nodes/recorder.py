"""Recorder node: one MCAP bag per episode, driven by the `episode` topic or by a person."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray, KeyValue
from std_srvs.srv import SetBool, Trigger

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.gate import DRAIN_S
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
from curation_ros.nodes.delivery import deliver
from curation_ros.nodes.health import Health
from curation_ros.nodes.manual_episodes import Answer, ManualEpisodes
from curation_ros.nodes.messages import array_to_ros, single_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import EVENTS, LATCHED
from curation_ros.nodes.spinning import WorkingNode, run, take_all, take_arrived
from curation_ros.nodes.subscriptions import MappedSubscriptions

PARAMETERS = (
    Parameter(
        "dataset", "dataset", "folder of the bags; made if it does not exist", is_required=True
    ),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("auto", True, "follow the episode topic; false: wait for ~/start and ~/stop"),
    Parameter("task", "demo", "with auto false: episodes are named <task>-<number>"),
    Parameter("min_free_mb", 500.0, "write no bag with less free space than this, MB", 0.0, 1e9),
    Parameter(
        "drain_timeout_s", DRAIN_S, "wait this long for late samples after an end, s", 0.0, 60.0
    ),
    Parameter("flush_period_s", 0.1, "a kill loses at most this much, s", 0.01, 10.0),
)
_STOPPED = "the recorder was stopped"
_FOLLOWS: Answer = (False, "the recorder follows the episode topic (auto is true)")


class Recorder(WorkingNode):
    """Turns messages into samples and events, and notices into messages; nothing else."""

    def __init__(self) -> None:
        super().__init__("recorder")
        p = declare(self, PARAMETERS)
        self._map = topic_map_or_default(p["topic_map"])
        self._dataset = Dataset(Path(p["dataset"]).expanduser(), create=True)
        # Before the data subscriptions: an executor serves subscriptions in the order of their
        # creation, so `started` is taken before the samples that follow it.
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
            publishers=self._mapped.n_publishers,
        )
        self.create_service(Trigger, "~/start", self._start)
        self.create_service(Trigger, "~/stop", self._stop)
        self.create_service(Trigger, "~/recover", self._recover)
        self.create_service(SetBool, "~/finalize", self._finalize)
        self._health = Health(self)
        self._last_id = ""
        # id -> name and topics that are reported as arriving, until that is every topic
        self._starting: dict[str, tuple[str, frozenset[str]]] = {}
        self._publish_notices(recover_partials(self._dataset))
        self._manual: ManualEpisodes | None = None
        if not p["auto"]:
            self._manual = ManualEpisodes(
                self,
                self._recording,
                self._publish_notices,
                name_prefix=p["task"],
                clock_topic=self._mapped.resolved(self._map.clock_topic),
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
            self._publish_notices(self._recording.event(event, time.monotonic()))

    def _on_sample(self, sample: Sample) -> None:
        if self._manual is not None and sample.topic == self._map.clock_topic:
            self._manual.clock_ns = sample.stamp_ns
        self._publish_notices(self._recording.sample(sample, time.monotonic()))

    # --- services ---------------------------------------------------------------------------

    def _start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        take_arrived(self)
        response.success, response.message = self._manual.start() if self._manual else _FOLLOWS
        return response

    def _stop(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        take_arrived(self)
        response.success, response.message = self._manual.stop() if self._manual else _FOLLOWS
        return response

    def _recover(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        notices = recover_partials(self._dataset)
        self._publish_notices(notices)
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
            response.message = "no curator is running: use curation override"
        else:
            self._override.publish(
                KeyValue(key=self._last_id, value=f"{verdict} with the recorder's button")
            )
            if self._manual is not None:
                self._dataset.append_truth({"episode": self._last_id, "button": verdict})
            response.success, response.message = True, f"{verdict} {self._last_id}"
        return response

    # --- messages out -----------------------------------------------------------------------

    def work(self) -> bool:
        """Flush and close bags, and report."""
        now_s = time.monotonic()
        self._publish_notices(self._recording.tick(now_s))
        self._publish_arrivals()
        if self._health.due(now_s):
            problems = self._mapped.check(running=bool(self._recording.open_ids))
            self._recording.topics |= self._topics()
            if self.count_publishers("episode") > 1:
                problems.insert(0, "topic episode has two owners: stop one of them")
            values = {"free": self._free(), **self._mapped.publishers_found()}
            self._health.publish(now_s, problems, values)
        return False

    def close(self) -> None:
        """Close the open bag as aborted, with all samples that were sent."""
        if self._recording.open_ids:
            take_all(self)
        was_open = bool(self._recording.open_ids)
        if self._manual is not None:
            self._manual.give_up(_STOPPED)
        self._publish_notices(self._recording.abort(_STOPPED))
        if was_open:  # the curator waits for this status to decide on the bag
            deliver([self._status])

    def _publish_arrivals(self) -> None:
        """Publish which topics of an episode arrive, once its commands do, and after each change.

        The owner of the episode waits for this. A topic without a sample counts 0.
        """
        for episode_id, (name, reported) in list(self._starting.items()):
            counts = dict.fromkeys(self._map.topics, 0) | self._recording.counts(episode_id)
            arrived = frozenset(topic for topic, n in counts.items() if n)
            if arrived == reported or not arrived.issuperset(self._map.command_topics):
                continue
            self._starting[episode_id] = name, arrived
            if len(arrived) == len(counts):
                del self._starting[episode_id]
            values = {"reason": "its commands arrive", **counts_to_values(counts)}
            self._publish(Status(OK, name, f"recording {episode_id}", episode_id, values))

    def _publish_notices(self, notices: Sequence[Notice]) -> None:
        for n in notices:
            self._last_id = n.id if n.state == "closed" else self._last_id
            self._starting.pop(n.id, None)
            if n.state == "recording":
                self._starting[n.id] = n.name, frozenset()
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
