"""What the sim node says on the graph: observations, commands, episodes, outcomes, the clock."""

from __future__ import annotations

from collections.abc import Iterable

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from curation_ros.core.status import EpisodeEvent, Status, event_to_status, phase_to_status
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
from sim_node.env import LiberoEnv, Observation
from sim_node.phases import PhaseTracker

COMMAND_TOPICS = ("command/twist", "command/gripper")
GRIPPER_JOINT = "gripper"


class SimPublishers:
    """All publishers of the sim node; `episode` and the commands exist only for their owner."""

    def __init__(self, node: Node, env: LiberoEnv, *, owner: bool, expert: bool) -> None:
        """Make the publishers.

        Args:
            node: the sim node.
            env: whose joints and objects are published.
            owner: whether this node owns the episodes.
            expert: whether this node gives the commands.
        """
        self._node = node
        self._env = env
        make = node.create_publisher
        self._episode = make(DiagnosticArray, "episode", LATCHED) if owner else None
        self._outcome = make(DiagnosticArray, "episode/outcome", LATCHED) if owner else None
        self._clock = make(Clock, "/clock", EVENTS)
        self._joints = make(JointState, "joint_states", MAPPED)
        self._eef = make(PoseStamped, "eef_pose", MAPPED)
        self._phase = make(DiagnosticArray, "phase", MAPPED)
        self._objects = {
            name: make(PoseStamped, f"objects/{name}/pose", MAPPED) for name in env.object_names
        }
        self._twist = make(TwistStamped, COMMAND_TOPICS[0], MAPPED) if expert else None
        self._gripper = make(JointState, COMMAND_TOPICS[1], MAPPED) if expert else None
        self.observation_topics = (
            "joint_states",
            "eef_pose",
            "phase",
            *(f"objects/{name}/pose" for name in env.object_names),
        )
        self._matching = Matching(node)

    def observation(
        self, stamp_ns: int, o: Observation, tracker: PhaseTracker, episode_id: str
    ) -> None:
        """Publish everything that is seen at one stamp."""
        self._clock.publish(Clock(clock=time_to_ros(stamp_ns)))
        self._joints.publish(
            joints_to_ros(
                self._env.joint_names,
                [*o.joint_position_rad, *o.finger_position_m],
                [*o.joint_velocity_rad_s, *o.finger_velocity_m_s],
                [*o.joint_effort_nm, *o.finger_effort_n],
                stamp_ns,
            )
        )
        for name, publisher in self._objects.items():
            publisher.publish(pose_to_ros(*o.objects[name], stamp_ns))
        phase = phase_to_status(episode_id, tracker.name, tracker.index, tracker.progress)
        self._phase.publish(array_to_ros([phase], stamp_ns))
        # The clock-role topic goes last: who has it has, of a fast writer, mostly the rest too.
        self._eef.publish(pose_to_ros(o.eef_position_m, o.eef_quat_xyzw, stamp_ns))

    def command(self, stamp_ns: int, xyz: Iterable[float], gripper: float) -> None:
        """Publish the expert's command."""
        assert self._twist is not None
        assert self._gripper is not None
        self._twist.publish(twist_to_ros(xyz, stamp_ns))
        self._gripper.publish(joints_to_ros([GRIPPER_JOINT], [gripper], [0.0], [0.0], stamp_ns))

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
        owners = {(i.node_namespace, i.node_name) for i in infos}
        if len(owners) <= 1 and len(infos) <= len(COMMAND_TOPICS):
            return ""
        return " and ".join(sorted(name for _, name in owners)) + f" ({len(infos)} publishers)"

    def flush(self) -> None:
        """Wait until every subscriber has everything of our episodes."""
        if self._episode is not None:
            observations = (self._joints, *self._objects.values(), self._phase, self._eef)
            deliver([self._episode, self._outcome, *observations])

    def is_matched(self, node_name: str) -> bool:
        """Whether a node is there, with all its subscriptions, to `episode` too if it is ours."""
        topics = [] if self._episode is None else [self._episode.topic_name]
        return self._matching.is_complete(node_name, topics)
