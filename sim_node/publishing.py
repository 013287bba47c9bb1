"""What the sim node says on the graph: observations, commands, episodes, outcomes, the clock."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from curation_ros.core.episode.status import EpisodeEvent, Status, event_to_status
from curation_ros.nodes.delivery import deliver
from curation_ros.nodes.matching import Matching
from curation_ros.nodes.messages import (
    array_to_ros,
    joints_to_ros,
    pose_to_ros,
    time_to_ros,
    twist_to_ros,
)
from curation_ros.nodes.qos import EVENTS, LATCHED, MAPPED
from sim_node.environment import Environment
from sim_node.output import COMMAND_TOPICS, SimOutput
from sim_node.tasks.task import Step

#: As rmw calls the node of a publisher that it cannot name yet.
_UNNAMED = "_NODE_NAME_UNKNOWN_"


class SimPublishers(SimOutput):
    """All publishers of the sim node; `episode` and the commands exist only for their owner."""

    def __init__(self, node: Node, env: Environment, *, owner: bool, expert: bool) -> None:
        """Make the publishers.

        Args:
            node: the sim node.
            env: whose joints and objects are published.
            owner: whether this node owns the episodes.
            expert: whether this node gives the commands.
        """
        super().__init__(env)
        self._node = node
        make = node.create_publisher
        self._episode = make(DiagnosticArray, "episode", LATCHED) if owner else None
        self._outcome = make(DiagnosticArray, "episode/outcome", LATCHED) if owner else None
        self._clock = make(Clock, "/clock", EVENTS)
        kinds = {"joint_states": JointState, "eef_pose": PoseStamped, "phase": DiagnosticArray}
        self._mapped = {
            topic: make(kinds.get(topic, PoseStamped), topic, MAPPED)
            for topic in self.observation_topics
        }
        if expert:
            for topic, kind in zip(COMMAND_TOPICS, (TwistStamped, JointState), strict=True):
                self._mapped[topic] = make(kind, topic, MAPPED)
        self._matching = Matching(node)

    def observation(self, stamp_ns: int, step: Step, episode_id: str) -> None:
        """Publish everything that is observed at one stamp, the clock first."""
        self._clock.publish(Clock(clock=time_to_ros(stamp_ns)))
        super().observation(stamp_ns, step, episode_id)

    def _joints(
        self,
        topic: str,
        names: Sequence[str],
        position: Iterable[float],
        velocity: Iterable[float],
        effort: Iterable[float],
        stamp_ns: int,
    ) -> None:
        self._mapped[topic].publish(joints_to_ros(names, position, velocity, effort, stamp_ns))

    def _pose(
        self, topic: str, position_m: Iterable[float], quat_xyzw: Iterable[float], stamp_ns: int
    ) -> None:
        self._mapped[topic].publish(pose_to_ros(position_m, quat_xyzw, stamp_ns))

    def _twist(self, topic: str, xyz: Iterable[float], stamp_ns: int) -> None:
        self._mapped[topic].publish(twist_to_ros(xyz, stamp_ns))

    def _status(self, topic: str, status: Status, stamp_ns: int) -> None:
        self._mapped[topic].publish(array_to_ros([status], stamp_ns))

    def event(self, event: EpisodeEvent) -> None:
        """Publish an event of an episode.

        Nobody waits here until it is acknowledged: a writer asks for acknowledgements every 3 s
        (Fast DDS's heartbeat). What follows goes the same way and overtakes it only where a
        packet is lost; `wait_for` the recorder to be sure.
        """
        if self._episode is not None:
            self._episode.publish(array_to_ros([event_to_status(event)], event.start_ns))

    def outcome(self, status: Status) -> None:
        """Publish an outcome, for evaluation only."""
        if self._outcome is not None:
            stamp_ns = self._node.get_clock().now().nanoseconds
            self._outcome.publish(array_to_ros([status], stamp_ns))

    def several_commanders(self) -> str:
        """Names of the nodes that command, if they are several or one has two publishers."""
        infos = [i for t in COMMAND_TOPICS for i in self._node.get_publishers_info_by_topic(t)]
        # A publisher is discovered a moment before the name of its node.
        infos = [i for i in infos if i.node_name != _UNNAMED]
        owners = {(i.node_namespace, i.node_name) for i in infos}
        if len(owners) <= 1 and len(infos) <= len(COMMAND_TOPICS):
            return ""
        return " and ".join(sorted(name for _, name in owners)) + f" ({len(infos)} publishers)"

    def flush(self) -> None:
        """Wait until every subscriber has everything of our episodes."""
        if self._episode is not None:
            observations = [self._mapped[topic] for topic in self.observation_topics]
            deliver([self._episode, self._outcome, *observations])

    def is_matched(self, node_name: str) -> bool:
        """Whether a node is there, with all its subscriptions, to `episode` too if it is ours."""
        topics = [] if self._episode is None else [self._episode.topic_name]
        return self._matching.is_complete(node_name, topics)
