"""Curator node: scores each episode when its gate closes, decides, publishes and logs."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from diagnostic_msgs.srv import SelfTest
from rclpy.time import Time
from std_srvs.srv import Trigger

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.configuration import (
    read_reference,
    read_settings,
    share_file,
    topic_map_or_default,
)
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.episode.gate import DRAIN_S
from curation_ros.core.episode.status import (
    alert_to_status,
    counts_to_values,
    decision_to_status,
    event_from_status,
)
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection
from curation_ros.live.curator import Decided, LiveCurator
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import single_from_ros, status_to_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import DECISIONS, EVENTS, LATCHED
from curation_ros.nodes.spinning import WorkingNode, run, take_waiting
from curation_ros.nodes.subscriptions import MappedSubscriptions

PARAMETERS = (
    Parameter("dataset", "dataset", "dataset whose episodes are decided on", is_required=True),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("reference", (), "datasets or bags of trusted demonstrations; empty: none"),
    Parameter("config", "", "YAML file of scorers and rule; empty: config/curation.yaml"),
    Parameter("scorers", (), "scorers to compute; empty: the scorers of the config"),
    Parameter("rule", "", "decision rule; empty: the rule of the config"),
    Parameter(
        "drain_timeout_s", DRAIN_S, "wait this long for late samples after an end, s", 0.0, 60.0
    ),
)
_N_RECENT = 200
# A recorder that stops takes the pending messages, closes its bag and publishes that.
_LAST_MESSAGE_S = 2.0


class Curator(WorkingNode):
    """Turns messages into samples and events, and decisions into messages; nothing else."""

    def __init__(self) -> None:
        super().__init__("curator")
        p = declare(self, PARAMETERS)
        topic_map = topic_map_or_default(p["topic_map"])
        config = Path(p["config"]) if p["config"] else share_file("config/curation.yaml")
        settings = read_settings(config, {"scorers": p["scorers"], "rule": p["rule"]})
        paths = [Path(path).expanduser() for path in p["reference"]]
        curation = Curation.fit(settings, read_reference(paths, topic_map) if paths else [])
        dataset = Dataset(Path(p["dataset"]).expanduser(), create=True)
        self._live = LiveCurator(
            dataset, topic_map, CdrDecoder(), curation, drain_timeout_s=p["drain_timeout_s"]
        )
        known = dataset.latest_decisions(_N_RECENT).values()
        self._recent: deque[DiagnosticStatus] = deque(map(_to_ros, known), _N_RECENT)
        self._latencies_ms: deque[float] = deque(maxlen=_N_RECENT)
        self._decided = self.create_publisher(DiagnosticArray, "curator/decision", DECISIONS)
        self._alerted = self.create_publisher(DiagnosticArray, "curator/alert", EVENTS)
        # Before the data subscriptions, for the reason that the recorder gives.
        self.create_subscription(DiagnosticArray, "episode", self._on_episode, LATCHED)
        self.create_subscription(DiagnosticArray, "recorder/status", self._on_recorder, LATCHED)
        self.create_subscription(KeyValue, "curator/override", self._on_override, EVENTS)
        self._mapped = MappedSubscriptions(self, topic_map, self._on_sample)
        self.create_service(SelfTest, "~/decisions", self._decisions)
        self.create_service(Trigger, "~/curate", self._curate)
        self._health = Health(self)
        self._running = ""
        for line in curation.describe().splitlines():
            self.get_logger().info(line)

    # --- messages in ------------------------------------------------------------------------

    def _on_episode(self, message: DiagnosticArray) -> None:
        try:
            event = event_from_status(single_from_ros(message))
            self._publish_news(self._live.event(event, time.monotonic()))
        except CurationError as err:
            self.get_logger().error(f"topic episode: {err}")

    def _on_sample(self, sample: Sample) -> None:
        try:
            self._publish_news(self._live.sample(sample, time.monotonic()))
        except CurationError as err:
            self.get_logger().error(str(err))

    def _on_recorder(self, message: DiagnosticArray) -> None:
        status = message.status[0] if message.status else None
        if status is not None and status.message.startswith("closed "):
            try:
                self._publish_news(self._live.bag_closed(status.hardware_id))
            except CurationError as err:
                self.get_logger().error(str(err))

    def _on_override(self, message: KeyValue) -> None:
        verdict, _, reason = message.value.strip().partition(" ")
        try:
            decision = self._live.override(message.key, verdict, reason.strip(), "person")
        except CurationError as err:
            self.get_logger().error(f"curator/override: {err}")
            return
        self._publish(decision)

    # --- services ---------------------------------------------------------------------------

    def _decisions(self, _: SelfTest.Request, response: SelfTest.Response) -> SelfTest.Response:
        response.id = self._live.dataset.path.name
        response.passed = b"\x01"
        response.status = list(self._recent)
        return response

    def _curate(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        try:
            for decision in self._live.finish():
                self._publish(decision)
            manifest, path = save_selection(self._live.dataset, rule="decisions")
        except CurationError as err:
            response.message = str(err)
            return response
        response.success, response.message = True, str(path)
        kept = len(manifest.entries)
        self.get_logger().info(f"kept {kept} of {manifest.kept_of}: {path}")
        for line in manifest.phases.warnings() if manifest.phases is not None else ():
            self.get_logger().warning(line)
        return response

    # --- messages out -----------------------------------------------------------------------

    def work(self) -> bool:
        """Close gates whose time is over, and report health."""
        now_s = time.monotonic()
        try:
            self._publish_news(self._live.tick(now_s))
        except CurationError as err:
            self.get_logger().error(str(err))
        running = self._live.running
        # Also at once when an episode begins, because replay waits for that.
        if self._health.due(now_s) or running != self._running:
            self._running = running
            problems = self._mapped.check(running=bool(running))
            if self.count_publishers("episode") > 1:
                problems.insert(0, "topic episode has two owners: stop one of them")
            values = {"decisions": str(len(self._latencies_ms))}
            values |= counts_to_values(self._live.counts()) | self._mapped.publishers_found()
            if self._latencies_ms:
                middle, worst = np.percentile(list(self._latencies_ms), [50, 99])
                values |= {"latency_ms_p50": f"{middle:.1f}", "latency_ms_p99": f"{worst:.1f}"}
            self._health.publish(now_s, problems, values, running)
        return False

    def close(self) -> None:
        """Wait a moment for the end of the running episode: its owner may be stopping, too."""
        deadline_s = time.monotonic() + _LAST_MESSAGE_S
        while self._live.running and time.monotonic() < deadline_s:
            if not take_waiting(self):
                time.sleep(_LAST_MESSAGE_S / 100)
            self.work()

    def _publish_news(self, decided: list[Decided]) -> None:
        for alert in self._live.take_alerts():
            status = status_to_ros(alert_to_status(alert.episode, alert.name, alert.finding))
            message = DiagnosticArray(status=[status])
            message.header.stamp = Time(nanoseconds=alert.seen_ns).to_msg()
            self._alerted.publish(message)
            self.get_logger().warning(f"{alert.finding.id} {alert.name}: {alert.finding.message}")
        for one in decided:
            began = time.perf_counter()
            self._publish(one.decision)
            if one.latency_s is not None:
                self._latencies_ms.append(1e3 * (one.latency_s + time.perf_counter() - began))

    def _publish(self, d: Decision) -> None:
        message = DiagnosticArray(status=[_to_ros(d)])
        message.header.stamp = self.get_clock().now().to_msg()
        self._recent += message.status
        self._decided.publish(message)
        self.get_logger().info(f"{d.verdict} {d.name} (revision {d.revision}): {d.reason}")


def _to_ros(d: Decision) -> DiagnosticStatus:
    return status_to_ros(
        decision_to_status(
            episode_id=d.episode,
            name=d.name,
            verdict=d.verdict,
            reason=d.reason,
            span=d.span,
            revision=d.revision,
            scores=d.scores,
        )
    )


def main() -> int:
    """Entry point of `ros2 run curation_ros curator`."""
    return run(Curator, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
