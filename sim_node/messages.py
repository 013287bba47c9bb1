"""The messages of the simulated robot, as plain data: the same on a graph and in a bag."""

from __future__ import annotations

from collections.abc import Iterator

from curation_ros.core.episode import messages
from curation_ros.core.episode.messages import PlainMessage
from curation_ros.core.episode.status import phase_to_status
from sim_node.environment import Command, Environment
from sim_node.tasks.task import Step

COMMAND_TYPES = {"command/twist": messages.TWIST, "command/gripper": messages.JOINT_STATE}
COMMAND_TOPICS = tuple(COMMAND_TYPES)
GRIPPER_JOINT = "gripper"
CLOCK_TOPIC = "/clock"


class RobotMessages:
    """Makes the messages of observations.

    Args:
        env: the environment whose joints and objects are shown.

    Attributes:
        types: topic -> message type, of all topics with one message per observation.
    """

    def __init__(self, env: Environment) -> None:
        self._joint_names = tuple(env.joint_names)
        self._objects = {f"objects/{name}/pose": name for name in env.object_names}
        self.types = {
            "joint_states": messages.JOINT_STATE,
            **dict.fromkeys(self._objects, messages.POSE),
            "phase": messages.STATUS_ARRAY,
            # The topic with role clock goes last: once it arrives, the rest usually has, too.
            "eef_pose": messages.POSE,
        }

    def observation(self, stamp_ns: int, step: Step, episode_id: str) -> Iterator[PlainMessage]:
        """Everything that is observed at one stamp, the clock first."""
        yield PlainMessage(CLOCK_TOPIC, messages.CLOCK, messages.clock(stamp_ns))
        for topic, kind in self.types.items():
            yield PlainMessage(topic, kind, self.content(topic, stamp_ns, step, episode_id))

    def content(self, topic: str, stamp_ns: int, step: Step, episode_id: str) -> messages.Content:
        """The message of one of `types`."""
        o = step.observation
        if topic == "eef_pose":
            return messages.pose(o.eef_position_m, o.eef_quat_xyzw, stamp_ns)
        if topic == "joint_states":
            return messages.joint_state(
                self._joint_names,
                [*o.joint_position_rad, *o.finger_position_m],
                [*o.joint_velocity_rad_s, *o.finger_velocity_m_s],
                [*o.joint_effort_nm, *o.finger_effort_n],
                stamp_ns,
            )
        if topic == "phase":
            phase = phase_to_status(
                episode_id, step.phase_name, step.phase_index, step.phase_progress
            )
            return messages.status_array([phase], stamp_ns)
        return messages.pose(*o.objects[self._objects[topic]], stamp_ns)


def command_messages(stamp_ns: int, command: Command) -> Iterator[PlainMessage]:
    """A command that answers the observation of a stamp."""
    twist, gripper = COMMAND_TOPICS
    yield PlainMessage(twist, messages.TWIST, messages.twist(command.action_xyz, stamp_ns))
    joint = messages.joint_state([GRIPPER_JOINT], [command.gripper], [0.0], [0.0], stamp_ns)
    yield PlainMessage(gripper, messages.JOINT_STATE, joint)
