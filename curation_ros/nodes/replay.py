"""Replay node: plays bags back onto the graph, for the live curator to decide on again."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

from curation_ros.bags import Bag, episode_event, open_bag
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.status import (
    EpisodeEvent,
    Status,
    counts_from_status,
    event_to_status,
)
from curation_ros.core.episode.stream import Sample, playback_order
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.episodes import claimed_id, find_episodes
from curation_ros.nodes.discovery import Discovery
from curation_ros.nodes.messages import array_to_ros, message_type, status_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import DECISIONS, EVENTS, LATCHED, MAPPED
from curation_ros.nodes.spinning import Finished, WorkingNode, run

PARAMETERS = (
    Parameter("bags", (), "datasets, folders of bags, bags or .mcap files, played in this order"),
    Parameter("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    Parameter("rate", 0.0, "speed factor; 0: as fast as the curator keeps up", 0.0, 1000.0),
    Parameter("wait_s", 30.0, "wait this long for a curator or a decision, s", 0.1, 3600.0),
)
# The curator's queues hold 1,000 messages per topic. After each 250, replay waits until no more
# than 250 are missing, so at most 500 are on their way. The curator's health report counts what it
# has taken, once per second. DDS acknowledgements are no substitute: they also cover messages that
# wait in a queue, and Fast DDS sends them up to 3 s later.
_AHEAD = 250


class Replay(WorkingNode):
    """Publishes the samples of bags, with `source: replay` and the ids of the recording."""

    def __init__(self) -> None:
        super().__init__("replay")
        p = declare(self, PARAMETERS)
        self._map = topic_map_or_default(p["topic_map"])
        self._rate, self._wait_s = p["rate"], p["wait_s"]
        if not p["bags"]:
            raise ConfigError("replay: parameter 'bags' is empty: name a dataset or bags")
        self._bags = find_episodes([Path(b).expanduser() for b in p["bags"]])
        self._episode = self.create_publisher(DiagnosticArray, "episode", LATCHED)
        self._outputs = {
            topic: self.create_publisher(message_type(kind, topic), topic, MAPPED)
            for topic, kind in self._map.topics.items()
        }
        self._decided: set[str] = set()
        self._progress: dict[str, Status] = {}
        self._discovery = Discovery(self)
        decisions = self.create_subscription(
            DiagnosticArray, "curator/decision", self._on_decision, DECISIONS
        )
        self._decision_topic = decisions.topic_name
        self.create_subscription(DiagnosticArray, "/diagnostics", self._on_health, EVENTS)
        self._script = self._play()

    def work(self) -> bool:
        """Continue the script. Raises Finished when all bags have been played."""
        try:
            return next(self._script)
        except StopIteration:
            raise Finished from None

    def close(self) -> None:
        """Nothing is left to finish: all messages were sent."""

    def _on_decision(self, message: DiagnosticArray) -> None:
        self._decided |= {status.hardware_id for status in message.status}

    def _on_health(self, message: DiagnosticArray) -> None:
        for status in map(status_from_ros, message.status):
            self._progress[status.name] = status

    def _play(self) -> Iterator[bool]:
        """The script. It yields to the executor, True to be called again at once."""
        yield from self._until(
            self._is_discovered,
            lambda: "no curator subscribes to episode, " + ", ".join(self._outputs),
        )
        for index, path in enumerate(self._bags, 1):
            try:
                bag = open_bag(path)
                samples = bag.samples(self._map)
                event = episode_event(bag, self._map, samples, claimed_id=claimed_id(path))
            except CurationError as err:
                self.get_logger().error(str(err))
                continue
            self.get_logger().info(f"{index} of {len(self._bags)}: {event.name} ({event.id})")
            yield from self._play_bag(bag, event, samples)

    def _play_bag(self, bag: Bag, event: EpisodeEvent, samples: list[Sample]) -> Iterator[bool]:
        self._publish_event(
            EpisodeEvent(event.id, event.name, "started", event.start_ns, source="replay")
        )
        yield from self._until(
            lambda: any(self._reports(event.id)),
            lambda: f"no curator has begun with {event.name} within {self._wait_s:g} s",
        )
        out: dict[str, set[int]] = {topic: set() for topic in self._outputs}
        began_s = time.monotonic()
        for sample in playback_order(samples):
            if not event.start_ns <= sample.stamp_ns <= (event.end_ns or sample.stamp_ns):
                continue
            if self._rate:
                due_s = (sample.stamp_ns - event.start_ns) / NS_PER_S / self._rate
                while time.monotonic() - began_s < due_s:
                    yield False
            self._outputs[sample.topic].publish(sample.data)
            sent = out[sample.topic]
            sent.add(sample.stamp_ns)
            if len(sent) % _AHEAD == 0:
                yield from self._until(
                    partial(self._has_taken, event.id, sample.topic, len(sent) - _AHEAD),
                    lambda: f"no curator keeps up with {event.name}",
                )
            # One by one through the executor, because a burst overruns the transport's queue.
            # Lost messages are sent again only 3 s later.
            yield True
        self._decided.discard(event.id)
        # Counts that the owner did not publish are added: the curator needs them to know when it
        # has everything.
        played = {topic: len(stamps) for topic, stamps in out.items() if stamps}
        self._publish_event(replace(event, source="replay", counts={**played, **event.counts}))
        yield from self._until(
            lambda: event.id in self._decided,
            lambda: f"no decision on {event.name} ({bag.path}) within {self._wait_s:g} s",
        )

    def _is_discovered(self) -> bool:
        """Whether there are curators, and all of them have all subscriptions."""
        infos = self.get_publishers_info_by_topic(self._decision_topic)
        topics = [p.topic_name for p in (self._episode, *self._outputs.values())]
        curators = {info.node_name for info in infos}
        return bool(curators) and all(self._discovery.is_complete(c, topics) for c in curators)

    def _has_taken(self, episode_id: str, topic: str, n: int) -> bool:
        """Whether every curator has taken at least n samples of a topic."""
        return all(counts_from_status(s).get(topic, 0) >= n for s in self._reports(episode_id))

    def _reports(self, episode_id: str) -> list[Status]:
        """The newest health report of each node that works on an episode."""
        return [s for s in self._progress.values() if s.hardware_id == episode_id]

    def _publish_event(self, event: EpisodeEvent) -> None:
        stamp_ns = self.get_clock().now().nanoseconds
        self._episode.publish(array_to_ros([event_to_status(event)], stamp_ns))

    def _until(self, is_true: Callable[[], bool], problem: Callable[[], str]) -> Iterator[bool]:
        deadline_s = time.monotonic() + self._wait_s
        while not is_true():
            if time.monotonic() > deadline_s:
                raise CurationError(f"replay: {problem()}")
            yield False


def main() -> int:
    """Entry point of `ros2 run curation_ros replay`."""
    return run(Replay, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
