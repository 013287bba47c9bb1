"""A problem of LIBERO as an environment for one process: reset to a start state, step, observe.

There are two ways of stepping with the same trajectories. `lean` is our own control loop on a
model without visual parts; the stock way is LIBERO's `env.step`. In both, observations are read
from the simulator, because robosuite's observables are up to one substep old. Poses are refreshed
after the last substep, so that positions, velocities and poses belong to one instant.
"""

from __future__ import annotations

import logging
import time

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from curation_ros.core.errors import SimError
from curation_ros.core.types import NS_PER_S, Floats
from sim_node.environment import GRIPPER_OPEN, Observation
from sim_node.libero.problem import LiberoProblem
from sim_node.libero.steppers import CONTROL_RATE_HZ, LeanStepper, Stepper, StockStepper

_LOGGER = logging.getLogger(__name__)

N_SETTLE_STEPS = 10
"""Steps with open gripper after a reset: start states hold the objects above the table."""

_DIVERGED = {
    int(mujoco.mjtWarning.mjWARN_BADQPOS): "position",
    int(mujoco.mjtWarning.mjWARN_BADQVEL): "velocity",
    int(mujoco.mjtWarning.mjWARN_BADQACC): "acceleration",
    int(mujoco.mjtWarning.mjWARN_BADCTRL): "torque",
}
_XYZW_OF_WXYZ = np.array([1, 2, 3, 0])


class LiberoEnv:
    """An `Environment` of a LIBERO problem.

    The model is the same in every process and never changes: fixtures are drawn once, from a fixed
    seed. The effector is the grip site between the finger tips. Efforts are those of the substep
    that led to the observation. Not thread-safe; a step releases the interpreter's lock.

    Args:
        problem: which one.
        lean: our own control loop; False: LIBERO's `env.step`.

    Attributes:
        lean: as given.
        reset_s: seconds that the last reset took, settling included.
        control_period_ns: time between observations.
        joint_names: seven arm joints and two finger joints.
        object_names: movable objects, by their LIBERO names.

    Raises:
        SimError: if LIBERO cannot be loaded, or the control loop cannot run the problem.
    """

    def __init__(self, problem: LiberoProblem, *, lean: bool = True) -> None:
        # By itself MuJoCo writes a file MUJOCO_LOG.TXT into the current folder.
        mujoco.set_mju_user_warning(_LOGGER.info)
        self.lean = lean
        self.control_period_ns = NS_PER_S // CONTROL_RATE_HZ
        self._stepper: Stepper | None = LeanStepper(problem) if lean else StockStepper(problem)
        facts = self._stepper.facts
        model, data = self._stepper.model, self._stepper.data
        self._model, self._data = model, data
        self.joint_names = (*facts.arm_joints, *facts.finger_joints)
        self.object_names = tuple(facts.object_names)
        site_id = model.site(facts.grip_site).id
        # Views stay valid as long as the data lives, which this object holds.
        self._site_position, self._site_rotation = data.site_xpos[site_id], data.site_xmat[site_id]
        self._warning_counts = data.warning.number
        self._body_ids = np.array([model.body(name).id for name in facts.object_bodies])
        self._quat_places = 4 * self._body_ids[:, None] + _XYZW_OF_WXYZ
        self._n_steps = 0
        self.reset_s = 0.0

    def __enter__(self) -> LiberoEnv:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_steps(self) -> int:
        """Commands executed since the last reset, settling steps not counted."""
        return max(0, self._n_steps)

    @property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model; without visual geoms if lean. Read only."""
        return self._model

    @property
    def data(self) -> mujoco.MjData:
        """The MuJoCo state. Read only."""
        return self._data

    def reset(self, start_state: ArrayLike) -> Observation:
        """Restore a start state, settle, and observe.

        Args:
            start_state: (1 + nq + nv,) time, positions and velocities, as LIBERO stores them.

        Returns:
            The observation after the settling steps: the first one of the episode.

        Raises:
            SimError: if the state has the wrong size or is not finite, or the simulation diverged.
        """
        started_s = time.perf_counter()
        stepper = self._open_stepper()
        state = np.asarray(start_state, dtype=np.float64)
        size = 1 + self._model.nq + self._model.nv
        if state.shape != (size,) or not np.isfinite(state).all():
            raise SimError(f"a start state is {size} finite numbers, got shape {state.shape}")
        stepper.restore(state)
        self._n_steps = -N_SETTLE_STEPS
        rest = np.zeros(3)
        for _ in range(N_SETTLE_STEPS):
            self._advance(rest, GRIPPER_OPEN)
        self.reset_s = time.perf_counter() - started_s
        return self.observe()

    def step(self, action_xyz: ArrayLike, gripper: float) -> Observation:
        """Execute one command.

        Args:
            action_xyz: (3,) goal offset; 1 is 5 cm. Values beyond [-1, 1] are clipped.
            gripper: -1 opens, +1 closes, 0 holds what was last commanded; only the sign counts.

        Returns:
            The observation one control period later.

        Raises:
            SimError: if the action is not three finite numbers or the simulation diverged.
        """
        action = np.array(action_xyz, dtype=np.float64)
        if action.shape != (3,) or not (np.isfinite(action).all() and np.isfinite(gripper)):
            raise SimError(f"an action is 3 finite numbers and a gripper command, got {action}")
        clipped = np.minimum(np.maximum(action, -1.0), 1.0)
        self._advance(clipped, float(np.sign(gripper)))
        return self.observe()

    def observe(self) -> Observation:
        """The observation of the present instant."""
        data = self._data
        quat_wxyz = np.empty(4)
        mujoco.mju_mat2Quat(quat_wxyz, self._site_rotation)
        # One copy of all joints; arm and fingers are parts of it.
        position, velocity = data.qpos[:9].copy(), data.qvel[:9].copy()
        effort = data.qfrc_actuator[:9].copy()
        poses = zip(
            self.object_names,
            data.xpos.take(self._body_ids, axis=0),
            data.xquat.take(self._quat_places),
            strict=True,
        )
        return Observation(
            eef_position_m=self._site_position.copy(),
            eef_quat_xyzw=quat_wxyz[_XYZW_OF_WXYZ],
            joint_position_rad=position[:7],
            joint_velocity_rad_s=velocity[:7],
            joint_effort_nm=effort[:7],
            finger_position_m=position[7:],
            finger_velocity_m_s=velocity[7:],
            finger_effort_n=effort[7:],
            objects={name: (at_m, quat_xyzw) for name, at_m, quat_xyzw in poses},
        )

    def is_success(self) -> bool:
        """LIBERO's own check: the object touches the goal, above it, within 3 cm of its axis.

        An open gripper is not part of it.
        """
        return self._open_stepper().is_success()

    def close(self) -> None:
        """Free the simulator; a second call does nothing."""
        if self._stepper is not None:
            self._stepper.close()
            self._stepper = None

    def _open_stepper(self) -> Stepper:
        if self._stepper is None:
            raise SimError("the environment is closed")
        return self._stepper

    def _advance(self, action_xyz: Floats, gripper: float) -> None:
        self._open_stepper().step(action_xyz, gripper)
        self._n_steps += 1
        reason = self._divergence()
        if reason is not None:
            n = self._n_steps
            place = f"step {n}" if n > 0 else f"settling step {n + N_SETTLE_STEPS}"
            raise SimError(f"the simulation diverged in {place}: {reason}")

    def _divergence(self) -> str | None:
        # MuJoCo counts a warning and resets the state by itself: the state alone does not show it.
        counts = self._warning_counts
        for warning, name in _DIVERGED.items():
            if counts[warning]:
                return f"bad {name}"
        if not (np.isfinite(self._data.qpos).all() and np.isfinite(self._data.qvel).all()):
            return "state is not finite"
        return None
