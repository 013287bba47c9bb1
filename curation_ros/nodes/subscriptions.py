"""Raw subscriptions to the mapped topics, and the state of their publishers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from curation_ros.bags.qos import QosProfile
from curation_ros.core.episode.stream import Sample, header_stamp_ns
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import EpisodeError
from curation_ros.nodes.health import publishers_found
from curation_ros.nodes.messages import message_type
from curation_ros.nodes.qos import MAPPED


class MappedSubscriptions:
    """One raw subscription per mapped topic. They stay alive between episodes."""

    def __init__(
        self, node: Node, topic_map: TopicMap, on_sample: Callable[[Sample], None]
    ) -> None:
        """Subscribe.

        Args:
            node: the subscribing node.
            topic_map: the topics and their types.
            on_sample: called with every sample, in the node's executor.

        Raises:
            ConfigError: if a message type is not installed.
        """
        self._node = node
        self._map = topic_map
        self._on_sample = on_sample
        self._types = {t: message_type(name, t) for t, name in topic_map.topics.items()}
        self._subscriptions = {t: self._subscribe(t, MAPPED) for t in topic_map.topics}
        self._reported: set[str] = set()
        self._n_publishers: dict[str, int] = {}

    def _subscribe(self, topic: str, qos: QoSProfile) -> Any:
        by_source = topic in self._map.source_stamped
        clock = self._node.get_clock()

        def receive(data: bytes, info: dict[str, Any]) -> None:
            try:
                stamp_ns = info["source_timestamp"] if by_source else header_stamp_ns(data)
            except EpisodeError as err:
                self._report(f"topic {topic!r}: {err}")
                return
            self._on_sample(
                Sample(
                    topic,
                    stamp_ns,
                    info["publication_sequence_number"] or 0,
                    data,
                    clock.now().nanoseconds,
                    info["source_timestamp"],
                )
            )

        # The type hints of rclpy lack callbacks with message info.
        callback: Any = receive
        return self._node.create_subscription(self._types[topic], topic, callback, qos, raw=True)

    def resolved(self, topic: str) -> str:
        """Full name of a topic, after namespace and remaps."""
        return str(self._subscriptions[topic].topic_name)

    def qos(self, topic: str) -> QosProfile:
        """QoS of a subscription, as a bag stores it."""
        profile = self._subscriptions[topic].qos_profile
        reliable = profile.reliability == ReliabilityPolicy.RELIABLE
        return QosProfile(
            depth=profile.depth, reliability="reliable" if reliable else "best_effort"
        )

    def n_publishers(self, topic: str) -> int:
        """Number of publishers of a topic that the graph shows now, at least 1."""
        return max(1, len(self._node.get_publishers_info_by_topic(self.resolved(topic))))

    def check(self, *, running: bool) -> list[str]:
        """Compare the graph with the map. Call it every second, between episodes too.

        A topic of another type is logged once. If a publisher offers only best effort, the
        subscription is made again with that.

        Args:
            running: whether an episode runs. Otherwise a missing publisher is no problem.

        Returns:
            What is wrong now, one line per problem.
        """
        problems = []
        for topic, expected in self._map.topics.items():
            infos = self._node.get_publishers_info_by_topic(self.resolved(topic))
            self._n_publishers[self.resolved(topic)] = len(infos)
            if running and not infos:
                problems.append(f"topic {self.resolved(topic)}: no publisher")
            for info in infos:
                if info.topic_type != expected:
                    problem = (
                        f"topic {self.resolved(topic)}: published as {info.topic_type} by "
                        f"{info.node_name}, the topic map expects {expected}"
                    )
                    problems.append(problem)
                    self._report(problem)
            qos = self._subscriptions[topic].qos_profile
            offered = {info.qos_profile.reliability for info in infos}
            if (
                ReliabilityPolicy.BEST_EFFORT in offered
                and qos.reliability == ReliabilityPolicy.RELIABLE
            ):
                self._report(
                    f"topic {self.resolved(topic)}: best effort only: messages may be lost"
                )
                self._node.destroy_subscription(self._subscriptions[topic])
                best_effort = QoSProfile(
                    depth=MAPPED.depth, reliability=ReliabilityPolicy.BEST_EFFORT
                )
                self._subscriptions[topic] = self._subscribe(topic, best_effort)
        return problems

    def publishers_found(self) -> dict[str, str]:
        """Publishers of `episode`, and of each topic at the last check, for /diagnostics."""
        episode = self._node.resolve_topic_name("episode")
        n_owners = self._node.count_publishers(episode)
        return publishers_found({episode: n_owners, **self._n_publishers})

    def _report(self, problem: str) -> None:
        if problem not in self._reported:
            self._reported.add(problem)
            self._node.get_logger().error(problem)
