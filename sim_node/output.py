"""What the sim says at each step, and on which topic; who inherits sends it or writes it down."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

from curation_ros.core.episode.status import EpisodeEvent, Status, phase_to_status
from sim_node.environment import Environment
from sim_node.tasks.task import Step

COMMAND_TOPICS = ("command/twist", "command/gripper")
GRIPPER_JOINT = "gripper"


class SimOutput(ABC):
    """Topics and contents of the sim's messages: the same on a graph and without one.

    Args:
        env: whose joints and objects are shown.

    Attributes:
        observation_topics: every topic that has a message for each observation.
    """

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._object_topics = {name: f"objects/{name}/pose" for name in env.object_names}
        self.observation_topics = (
            "joint_states",
            "eef_pose",
            "phase",
            *self._object_topics.values(),
        )

    def observation(self, stamp_ns: int, step: Step, episode_id: str) -> None:
        """Send everything that is observed at one stamp."""
        o = step.observation
        self._joints(
            "joint_states",
            self._env.joint_names,
            [*o.joint_position_rad, *o.finger_position_m],
            [*o.joint_velocity_rad_s, *o.finger_velocity_m_s],
            [*o.joint_effort_nm, *o.finger_effort_n],
            stamp_ns,
        )
        for name, topic in self._object_topics.items():
            self._pose(topic, *o.objects[name], stamp_ns)
        phase = phase_to_status(episode_id, step.phase_name, step.phase_index, step.phase_progress)
        self._status("phase", phase, stamp_ns)
        # The clock-role topic goes last: who has it has, of a fast writer, mostly the rest too.
        self._pose("eef_pose", o.eef_position_m, o.eef_quat_xyzw, stamp_ns)

    def command(self, stamp_ns: int, xyz: Iterable[float], gripper: float) -> None:
        """Say the expert's command."""
        twist, joint = COMMAND_TOPICS
        self._twist(twist, xyz, stamp_ns)
        self._joints(joint, [GRIPPER_JOINT], [gripper], [0.0], [0.0], stamp_ns)

    @abstractmethod
    def event(self, event: EpisodeEvent) -> None:
        """Say an event of an episode."""

    @abstractmethod
    def _joints(
        self,
        topic: str,
        names: Sequence[str],
        position: Iterable[float],
        velocity: Iterable[float],
        effort: Iterable[float],
        stamp_ns: int,
    ) -> None:
        """A sensor_msgs/JointState."""

    @abstractmethod
    def _pose(
        self, topic: str, position_m: Iterable[float], quat_xyzw: Iterable[float], stamp_ns: int
    ) -> None:
        """A geometry_msgs/PoseStamped in the world frame."""

    @abstractmethod
    def _twist(self, topic: str, xyz: Iterable[float], stamp_ns: int) -> None:
        """A geometry_msgs/TwistStamped in the world frame."""

    @abstractmethod
    def _status(self, topic: str, status: Status, stamp_ns: int) -> None:
        """A diagnostic_msgs/DiagnosticArray of one status."""
