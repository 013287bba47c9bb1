"""Two ways of stepping LIBERO: our control loop on the stripped model, and LIBERO's `env.step`.

Both give the same trajectories up to rounding, which a test checks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray
from typing_extensions import override

from curation_ros.core.errors import SimError
from curation_ros.core.types import Floats
from sim_node.libero import compiled, quiet
from sim_node.libero.problem import LiberoProblem

CONTROL_RATE_HZ = 20
"""Commands per second."""


class Stepper(Protocol):
    """A way of stepping. It owns model, data, and all state that MuJoCo does not hold.

    Attributes:
        model: the MuJoCo model.
        data: the MuJoCo state.
        facts: facts about robot and goal.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    facts: compiled.ProblemFacts

    def restore(self, start_state: Floats) -> None:
        """Set everything that the next step depends on."""

    def step(self, action_xyz: Floats, gripper: float) -> None:
        """Advance by one control step and refresh the poses."""

    def is_success(self) -> bool:
        """LIBERO's check of the goal, with the poses as refreshed."""

    def close(self) -> None:
        """Free what is held."""


class LeanStepper(Stepper):
    """Our control loop on the stripped model."""

    def __init__(self, problem: LiberoProblem) -> None:
        # Imported here: its machine code is compiled or loaded on import.
        from sim_node.libero import osc

        loaded = compiled.load_problem(problem)
        self.facts = facts = loaded.facts
        model = loaded.model
        joints = [model.joint(name) for name in (*facts.arm_joints, *facts.finger_joints)]
        expected = list(range(osc.N_ARM + 2))
        if [j.qposadr[0] for j in joints] != expected or [j.dofadr[0] for j in joints] != expected:
            raise SimError("arm and fingers are not the first nine joints of the model")
        if [model.actuator(i).trnid[0] for i in expected] != [j.id for j in joints]:
            raise SimError("the actuators are not in the order of the joints")
        self.model = model
        self.data = mujoco.MjData(model)
        self._control_step = osc.control_step
        self._n_substeps = round(1.0 / (CONTROL_RATE_HZ * model.opt.timestep))
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

    @override
    def restore(self, start_state: Floats) -> None:
        model, data = self.model, self.data
        mujoco.mj_resetData(model, data)
        data.time = start_state[0]
        data.qpos[:] = start_state[1 : 1 + model.nq]
        data.qvel[:] = start_state[1 + model.nq :]
        self._finger_target[:] = 0.0
        mujoco.mj_forward(model, data)

    @override
    def step(self, action_xyz: Floats, gripper: float) -> None:
        self._control_step(
            *self._before,
            *self._views,
            action_xyz * self._action_scale_m,
            *self._after,
            self._finger_target,
            gripper,
        )

    @override
    def is_success(self) -> bool:
        return all(goal.holds(self.model, self.data) for goal in self._goals)

    @override
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


class StockStepper(Stepper):
    """LIBERO's `env.step` on the full model."""

    def __init__(self, problem: LiberoProblem) -> None:
        stock = quiet.build_stock_environment(problem, compiled.FIXTURE_SEED, CONTROL_RATE_HZ)
        self._stock = stock
        self.facts = compiled.read_facts(stock)
        self.model = stock.sim.model._model
        self.data = stock.sim.data._data

    @override
    def restore(self, start_state: Floats) -> None:
        # LIBERO's set_init_state forgets controller, gripper, warm start and clock.
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

    @override
    def step(self, action_xyz: Floats, gripper: float) -> None:
        self._stock.step(np.concatenate([action_xyz, np.zeros(3), [gripper]]))
        mujoco.mj_kinematics(self.model, self.data)

    @override
    def is_success(self) -> bool:
        mujoco.mj_collision(self.model, self.data)
        return bool(self._stock.check_success())

    @override
    def close(self) -> None:
        self._stock.close()
