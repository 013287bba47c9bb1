"""LIBERO's task as an environment for one process: reset to a start state, step, observe.

Two ways of stepping give the same trajectories: `lean`, our own control loop on a model stripped
of its looks, and the stock one, LIBERO's `env.step`. Observations are read from the simulator in
both (robosuite's observables are up to one substep old), and poses are refreshed after the last
substep, so that positions, velocities and poses belong to one instant.
"""

from __future__ import annotations

import functools
import logging
import time
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from curation_ros.core.errors import ConfigError, SimError
from curation_ros.core.types import Floats
from sim_node import compiled_task, quiet_libero
from sim_node.environment import GRIPPER_OPEN, Observation

_LOGGER = logging.getLogger(__name__)


CONTROL_RATE_HZ = 20
N_SETTLE_STEPS = 10
"""Steps with open gripper after a reset: start states hold the objects above the table."""

BOWL = "akita_black_bowl_1"
PLATE = "plate_1"

_DIVERGED = {
    int(mujoco.mjtWarning.mjWARN_BADQPOS): "position",
    int(mujoco.mjtWarning.mjWARN_BADQVEL): "velocity",
    int(mujoco.mjtWarning.mjWARN_BADQACC): "acceleration",
    int(mujoco.mjtWarning.mjWARN_BADCTRL): "torque",
}
_XYZW_OF_WXYZ = np.array([1, 2, 3, 0])


class _Stepper(Protocol):
    """A way of stepping: owns model and data, and what a MuJoCo state does not hold."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def restore(self, start_state: Floats) -> None:
        """Set everything that the next step depends on."""

    def step(self, action_xyz: Floats, gripper: float) -> None:
        """Advance by one control step and refresh the poses."""

    def is_success(self) -> bool:
        """LIBERO's check of the goal, with the poses as refreshed."""

    def close(self) -> None:
        """Free what is held."""


class LiberoEnv:
    """The task `libero_spatial` 0: put the black bowl that is between two others onto the plate.

    The model is the same in every process (fixtures drawn once, from a fixed seed) and never
    changes; equal start state and equal actions give equal bits, whatever ran before. There is
    no step limit: that belongs to the caller. Not thread-safe; a step releases the interpreter's
    lock.

    Args:
        lean: our own control loop (the default); False is LIBERO's `env.step`.
        control_rate_hz: commands a second; must divide 500.

    Attributes:
        construct_s: seconds that the construction took.
        reset_s: seconds that the last reset took, settling included.
        control_period_ns: time between observations.
        joint_names: seven arm joints and two finger joints, in the order of `Observation`.
        object_names: movable objects.
        language: the instruction.

    Raises:
        ConfigError: if the rate does not divide the simulator's.
        SimError: if LIBERO cannot be loaded.
    """

    def __init__(self, *, lean: bool = True, control_rate_hz: int = CONTROL_RATE_HZ) -> None:
        started_s = time.perf_counter()
        # MuJoCo's own habit is a file MUJOCO_LOG.TXT in whatever folder one happens to be.
        mujoco.set_mju_user_warning(_LOGGER.info)
        if control_rate_hz <= 0 or 500 % control_rate_hz:
            raise ConfigError(f"control_rate_hz must divide 500, got {control_rate_hz}")
        self.lean = lean
        self.control_rate_hz = control_rate_hz
        self.control_period_ns = 1_000_000_000 // control_rate_hz
        self._stepper: _Stepper | None
        if lean:
            task = compiled_task.load_task()
            facts = task.facts
            self._stepper = _LeanStepper(task, control_rate_hz)
        else:
            stock = _StockStepper(control_rate_hz)
            facts = stock.facts
            self._stepper = stock
        model, data = self._stepper.model, self._stepper.data
        self._model, self._data = model, data
        self.joint_names = (*facts.arm_joints, *facts.finger_joints)
        self.object_names = tuple(facts.object_names)
        self.language = facts.language
        site_id = model.site(facts.grip_site).id
        # Views stay valid as long as the data lives, which this object holds.
        self._site_position, self._site_rotation = data.site_xpos[site_id], data.site_xmat[site_id]
        self._warning_counts = data.warning.number
        self._body_ids = np.array([model.body(name).id for name in facts.object_bodies])
        self._quat_places = 4 * self._body_ids[:, None] + _XYZW_OF_WXYZ
        self._n_steps = 0
        self.reset_s = 0.0
        self.construct_s = time.perf_counter() - started_s

    def __enter__(self) -> LiberoEnv:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def n_steps(self) -> int:
        """Commands executed since the last reset; below 0 while it settles."""
        return self._n_steps

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
        """LIBERO's own check: bowl in contact with the plate, above it, within 3 cm of its axis.

        An open gripper is no part of it.
        """
        return self._open_stepper().is_success()

    def close(self) -> None:
        """Free the simulator; a second call does nothing."""
        if self._stepper is not None:
            self._stepper.close()
            self._stepper = None

    def _open_stepper(self) -> _Stepper:
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
        # MuJoCo counts a warning and resets the state by itself, so the state alone tells nothing.
        counts = self._warning_counts
        for warning, name in _DIVERGED.items():
            if counts[warning]:
                return f"bad {name}"
        if not (np.isfinite(self._data.qpos).all() and np.isfinite(self._data.qvel).all()):
            return "state is not finite"
        return None


@functools.cache
def process_env() -> LiberoEnv:
    """The lean environment of this process, made once: for workers that get task after task."""
    return LiberoEnv()


class _LeanStepper:
    """Our control loop on the stripped model."""

    def __init__(self, task: compiled_task.CompiledTask, control_rate_hz: int) -> None:
        # Imported here: its machine code is compiled or loaded on import.
        from sim_node import osc

        model, facts = task.model, task.facts
        joints = [model.joint(name) for name in (*facts.arm_joints, *facts.finger_joints)]
        expected = list(range(osc.N_ARM + 2))
        if [j.qposadr[0] for j in joints] != expected or [j.dofadr[0] for j in joints] != expected:
            raise SimError("arm and fingers are not the first nine joints of the model")
        if [model.actuator(i).trnid[0] for i in expected] != [j.id for j in joints]:
            raise SimError("the actuators are not in the order of the joints")
        self.model = model
        self.data = mujoco.MjData(model)
        self._control_step = osc.control_step
        self._n_substeps = round(1.0 / (control_rate_hz * model.opt.timestep))
        self._action_scale_m = facts.action_scale_m
        self._finger_target = np.zeros(2)
        site_id = model.site(facts.grip_site).id
        data = self.data
        # Views stay valid as long as the data lives, which this object holds.
        self._before = (model._address, data._address, self._n_substeps, np.int32(site_id))
        self._views = (
            data.qpos,
            data.qvel,
            data.ctrl,
            data.qfrc_bias,
            data.site_xpos[site_id],
            data.site_xmat[site_id],
        )
        self._after = (
            np.array(facts.goal_rotation).reshape(3, 3),
            np.array(facts.nominal_joint_position_rad),
            facts.kp,
            facts.kd,
            np.array(model.actuator_ctrlrange),
        )
        self._goals = [
            _OnGoal(
                upper_body=model.body(facts.object_bodies[facts.object_names.index(upper)]).id,
                lower_body=model.body(facts.object_bodies[facts.object_names.index(lower)]).id,
                is_upper=_geom_mask(model, facts.contact_geoms[upper]),
                is_lower=_geom_mask(model, facts.contact_geoms[lower]),
            )
            for upper, lower in facts.goal_pairs
        ]

    def restore(self, start_state: Floats) -> None:
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        data.time = start_state[0]
        data.qpos[:] = start_state[1 : 1 + model.nq]
        data.qvel[:] = start_state[1 + model.nq :]
        self._finger_target[:] = 0.0
        mujoco.mj_forward(model, data)

    def step(self, action_xyz: Floats, gripper: float) -> None:
        self._control_step(
            *self._before,
            *self._views,
            action_xyz * self._action_scale_m,
            *self._after,
            self._finger_target,
            gripper,
        )

    def is_success(self) -> bool:
        return all(goal.holds(self.model, self.data) for goal in self._goals)

    def close(self) -> None:
        pass


@dataclass(frozen=True)
class _OnGoal:
    """LIBERO's predicate 'on', for two movable objects; masks are over the model's geoms."""

    upper_body: int
    lower_body: int
    is_upper: NDArray[np.bool_]
    is_lower: NDArray[np.bool_]

    def holds(self, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
        upper, lower = data.xpos[self.upper_body], data.xpos[self.lower_body]
        if lower[2] > upper[2] or not np.linalg.norm(lower[:2] - upper[:2]) < 0.03:
            return False
        # The known contacts are those before the last substep. Finding them anew costs time.
        mujoco.mj_collision(model, data)
        pairs = data.contact.geom
        is_upper, is_lower = self.is_upper[pairs], self.is_lower[pairs]
        return bool(((is_upper[:, 0] & is_lower[:, 1]) | (is_lower[:, 0] & is_upper[:, 1])).any())


def _geom_mask(model: mujoco.MjModel, names: list[str]) -> NDArray[np.bool_]:
    mask = np.zeros(model.ngeom, dtype=np.bool_)
    mask[[model.geom(name).id for name in names]] = True
    return mask


class _StockStepper:
    """LIBERO's `env.step` on the full model."""

    def __init__(self, control_rate_hz: int) -> None:
        stock = quiet_libero.build_stock_environment(compiled_task.FIXTURE_SEED, control_rate_hz)
        self._stock = stock
        self.facts = compiled_task.read_facts(stock)
        self.model = stock.sim.model._model
        self.data = stock.sim.data._data

    def restore(self, start_state: Floats) -> None:
        """Also what LIBERO's set_init_state forgets: controller, gripper, warm start, clock."""
        stock, env = self._stock, self._stock.env
        robot = env.robots[0]
        controller = robot.controller
        stock.sim.reset()
        stock.sim.set_state_from_flattened(start_state)
        stock.sim.forward()
        robot.gripper.current_action = np.zeros(1)
        controller.initial_joint = np.array(self.facts.nominal_joint_position_rad)
        controller.initial_ee_ori_mat = np.array(self.facts.goal_rotation).reshape(3, 3)
        controller.goal_ori = controller.initial_ee_ori_mat.copy()
        controller.update(force=True)
        controller.goal_pos = np.array(controller.ee_pos)
        controller.new_update = True
        env.timestep = 0
        env.cur_time = 0
        env.done = False
        for observable in env._observables.values():
            observable.reset()

    def step(self, action_xyz: Floats, gripper: float) -> None:
        self._stock.step(np.concatenate([action_xyz, np.zeros(3), [gripper]]))
        mujoco.mj_kinematics(self.model, self.data)

    def is_success(self) -> bool:
        mujoco.mj_collision(self.model, self.data)
        return bool(self._stock.check_success())

    def close(self) -> None:
        self._stock.close()
