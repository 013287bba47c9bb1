"""Replay node: plays bags back onto the graph, for the live curator to judge again."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.duration import Duration
from rclpy.node import Node

from curation_ros.bags.reader import Bag, episode_event, find_bags, open_bag
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.status import EpisodeEvent, event_to_status
from curation_ros.core.stream import NS_PER_S, Sample, playback_order
from curation_ros.nodes.messages import array_to_ros, single_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import DECISIONS, LATCHED, MAPPED
from curation_ros.nodes.spinning import Finished, run
from curation_ros.nodes.subscriptions import message_type

PARAMETERS = (
    Parameter("bags", (), "datasets, folders of bags, bags or .mcap files to play, in order"),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("rate", 0.0, "speed; 0: as fast as the curator keeps up", 0.0, 1000.0),
    Parameter(
        "wait_s", 30.0, "patience for a curator to appear, and for a decision, s", 0.1, 3600.0
    ),
)
# The curator's queues hold 1,000 messages a topic; this many are out at most before all are
# acknowledged, so that none is overwritten.
_AHEAD = 500


class Replay(Node):
    """Publishes what bags hold, with `source: replay` and the ids of their recording."""

    def __init__(self) -> None:
        super().__init__("replay")
        p = declare(self, PARAMETERS)
        self._map = topic_map_or_default(p["topic_map"])
        self._rate, self._wait_s = p["rate"], p["wait_s"]
        if not p["bags"]:
            raise ConfigError("replay: parameter 'bags' is empty: name a dataset or bags")
        self._bags = find_bags([Path(b).expanduser() for b in p["bags"]])
        self._episode = self.create_publisher(DiagnosticArray, "episode", LATCHED)
        self._outputs = {
            topic: self.create_publisher(message_type(kind, topic), topic, MAPPED)
            for topic, kind in self._map.topics.items()
        }
        self._decided: set[str] = set()
        self.create_subscription(DiagnosticArray, "curator/decision", self._on_decision, DECISIONS)
        self._script = self._play()

    def work(self) -> bool:
        """Go on with the script; raises Finished when all bags have been played."""
        try:
            return next(self._script)
        except StopIteration:
            raise Finished from None

    def close(self) -> None:
        """Nothing to finish: what was published is out."""

    def _on_decision(self, message: DiagnosticArray) -> None:
        self._decided.add(single_from_ros(message).hardware_id)

    def _play(self) -> Iterator[bool]:
        """The script; it yields to the executor, True to be called again at once."""
        publishers: list[Any] = [self._episode, *self._outputs.values()]
        yield from self._until(
            lambda: all(p.get_subscription_count() for p in publishers),
            lambda: (
                "no curator listens on "
                + ", ".join(p.topic_name for p in publishers if not p.get_subscription_count())
            ),
        )
        for index, path in enumerate(self._bags, 1):
            try:
                bag = open_bag(path)
                samples = bag.samples(self._map)
                event = episode_event(bag, self._map, samples)
            except CurationError as err:
                self.get_logger().error(str(err))
                continue
            self.get_logger().info(f"{index} of {len(self._bags)}: {event.name} ({event.id})")
            yield from self._play_bag(bag, event, samples)

    def _play_bag(self, bag: Bag, event: EpisodeEvent, samples: list[Sample]) -> Iterator[bool]:
        self._tell(EpisodeEvent(event.id, event.name, "started", event.start_ns, source="replay"))
        yield from self._acknowledged()
        out: Counter[str] = Counter()
        began_s = time.monotonic()
        for sample in playback_order(samples):
            if not event.start_ns <= sample.stamp_ns <= (event.end_ns or sample.stamp_ns):
                continue
            if self._rate:
                due_s = (sample.stamp_ns - event.start_ns) / NS_PER_S / self._rate
                while time.monotonic() - began_s < due_s:
                    yield False
            self._outputs[sample.topic].publish(sample.data)
            out[sample.topic] += 1
            if out[sample.topic] == _AHEAD:
                yield from self._acknowledged()
                out.clear()
        yield from self._acknowledged()
        self._decided.discard(event.id)
        self._tell(
            EpisodeEvent(
                event.id,
                event.name,
                event.event,
                event.start_ns,
                event.end_ns,
                event.counts,
                "replay",
                event.reason,
            )
        )
        yield from self._until(
            lambda: event.id in self._decided,
            lambda: f"no decision on {event.name} ({bag.path}) within {self._wait_s:g} s",
        )

    def _tell(self, event: EpisodeEvent) -> None:
        stamp_ns = self.get_clock().now().nanoseconds
        self._episode.publish(array_to_ros([event_to_status(event)], stamp_ns))

    def _acknowledged(self) -> Iterator[bool]:
        """Wait until every subscriber has everything; a slow one is waited for."""
        moment = Duration(nanoseconds=NS_PER_S // 10)
        for publisher in (self._episode, *self._outputs.values()):
            while not publisher.wait_for_all_acked(moment):
                yield True

    def _until(self, is_true: Any, complaint: Any) -> Iterator[bool]:
        deadline_s = time.monotonic() + self._wait_s
        while not is_true():
            if time.monotonic() > deadline_s:
                raise CurationError(f"replay: {complaint()}")
            yield False


def main() -> int:
    """Entry point of `ros2 run curation_ros replay`."""
    return run(Replay)


if __name__ == "__main__":
    raise SystemExit(main())
