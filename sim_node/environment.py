"""What a simulator is to the rest of this package: an environment that is reset and stepped.

Another simulator is one more class with these members. `sim_node.testing.check_environment` runs
such a class through the rules.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from numpy.typing import ArrayLike

from curation_ros.core.types import Floats

GRIPPER_OPEN = -1.0
GRIPPER_HOLD = 0.0
GRIPPER_CLOSE = 1.0


@dataclass(frozen=True)
class Observation:
    """What the robot's sensors and a perfect object tracker measure at one instant.

    Positions are in the world frame. The effector is the point between the finger tips.

    Attributes:
        eef_position_m: (3,) position of the effector.
        eef_quat_xyzw: (4,) orientation of the effector.
        joint_position_rad: (n,) joints of the arm.
        joint_velocity_rad_s: (n,) joints of the arm.
        joint_effort_nm: (n,) torques of the actuators, gravity compensation included.
        finger_position_m: (2,) fingers, first >= 0, second <= 0.
        finger_velocity_m_s: (2,) fingers.
        finger_effort_n: (2,) forces of the actuators.
        objects: name -> position (3,) in m and quaternion (4,) xyzw of each movable object.
    """

    eef_position_m: Floats
    eef_quat_xyzw: Floats
    joint_position_rad: Floats
    joint_velocity_rad_s: Floats
    joint_effort_nm: Floats
    finger_position_m: Floats
    finger_velocity_m_s: Floats
    finger_effort_n: Floats
    objects: dict[str, tuple[Floats, Floats]]

    @property
    def finger_width_m(self) -> float:
        """Distance between the fingers, 0 when closed on nothing."""
        return float(self.finger_position_m[0] - self.finger_position_m[1])


class Command(NamedTuple):
    """What answers an observation.

    Attributes:
        action_xyz: (3,) motion of the effector, unitless in [-1, 1], in the world frame.
        gripper: -1 opens, +1 closes, 0 holds; only the sign counts.
    """

    action_xyz: Floats
    gripper: float


class Environment(Protocol):
    """A simulated robot in a scene, stepped once per control period.

    Equal start states and equal commands give equal bits, whatever ran before. An environment has
    no step limit: that belongs to the episode.
    """

    @property
    def control_period_ns(self) -> int:
        """Time between two observations, in ns."""

    @property
    def joint_names(self) -> Sequence[str]:
        """Joints of the arm, then the two fingers, in the order of `Observation`."""

    @property
    def object_names(self) -> Sequence[str]:
        """Movable objects: the keys of `Observation.objects`, in this order."""

    @property
    def n_steps(self) -> int:
        """Commands executed since the last reset."""

    def reset(self, start_state: ArrayLike) -> Observation:
        """Restore a start state and let it settle.

        Args:
            start_state: (k,) state as the task's starts have it.

        Returns:
            The first observation of the episode.

        Raises:
            SimError: if the state is invalid, the simulation diverged, or the environment is
                closed.
        """

    def step(self, action_xyz: ArrayLike, gripper: float) -> Observation:
        """Execute one command, see `Command`; actions beyond [-1, 1] are clipped.

        Returns:
            The observation one control period later.

        Raises:
            SimError: if the command is not four finite numbers, the simulation diverged, or the
                environment is closed.
        """

    def is_success(self) -> bool:
        """Whether the goal of the task holds now."""

    def close(self) -> None:
        """Free the simulator; a second call does nothing."""
