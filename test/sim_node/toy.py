"""A simulator and a task without LIBERO: a hand on three slides carries a cup to a coaster."""

from __future__ import annotations

import numpy as np

from curation_ros.core.errors import ConfigError, SimError
from sim_node.environment import GRIPPER_CLOSE, GRIPPER_OPEN, Observation
from sim_node.starts import Start, read_start_name

CUP, COASTER = "cup", "coaster"
STEP_M = 0.02
OPEN_M, SHUT_M, HELD_M = 0.08, 0.0, 0.03
FALL_M = 0.03
NEAR_M = 0.025
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


class ToyEnvironment:
    """State: effector, cup and coaster, 3 coordinates each. The table is at z = 0."""

    control_period_ns = 100_000_000
    joint_names = ("slide_x", "slide_y", "slide_z", "left", "right")
    object_names = (CUP, COASTER)

    def __init__(self):
        self._is_open = True
        self.n_steps = 0

    def reset(self, start_state):
        self._check_open()
        state = np.array(start_state, dtype=np.float64)
        if state.shape != (9,) or not np.isfinite(state).all():
            raise SimError(f"a start state is 9 finite numbers, got shape {state.shape}")
        self._eef, self._cup, self._coaster = state[:3], state[3:6], state[6:]
        self._velocity = np.zeros(3)
        self._width, self._target, self._is_held = OPEN_M, OPEN_M, False
        self.n_steps = 0
        return self._observe()

    def step(self, action_xyz, gripper):
        self._check_open()
        action = np.array(action_xyz, dtype=np.float64)
        if action.shape != (3,) or not (np.isfinite(action).all() and np.isfinite(gripper)):
            raise SimError("a command is 3 finite numbers and a gripper command")
        self._velocity = STEP_M * np.clip(action, -1.0, 1.0)
        self._eef = self._eef + self._velocity
        if gripper:
            self._target = SHUT_M if gripper > 0 else OPEN_M
        least = HELD_M if self._is_held else SHUT_M
        self._width = max(least, self._width + np.clip(self._target - self._width, -0.02, 0.02))
        near = np.linalg.norm(self._cup - self._eef) < NEAR_M
        self._is_held = self._width <= HELD_M and (self._is_held or near)
        if self._is_held:
            self._cup = self._eef.copy()
        else:
            fallen = max(0.0, self._cup[2] - FALL_M)
            self._cup = np.array([*self._cup[:2], fallen])
        self.n_steps += 1
        return self._observe()

    def is_success(self):
        lies = not self._is_held and self._cup[2] == 0.0
        return bool(lies and np.linalg.norm(self._cup - self._coaster) < 0.03)

    def close(self):
        self._is_open = False

    def _check_open(self):
        if not self._is_open:
            raise SimError("the environment is closed")

    def _observe(self):
        half = self._width / 2
        return Observation(
            eef_position_m=self._eef.copy(),
            eef_quat_xyzw=UPRIGHT.copy(),
            joint_position_rad=self._eef.copy(),
            joint_velocity_rad_s=self._velocity.copy(),
            joint_effort_nm=np.zeros(3),
            finger_position_m=np.array([half, -half]),
            finger_velocity_m_s=np.zeros(2),
            finger_effort_n=np.zeros(2),
            objects={
                CUP: (self._cup.copy(), UPRIGHT.copy()),
                COASTER: (self._coaster.copy(), UPRIGHT.copy()),
            },
        )


class ToyTracker:
    phases = ("TAKE", "CARRY", "LEAVE")

    def __init__(self, first):
        self._cup, self._coaster = (first.objects[name][0].copy() for name in (CUP, COASTER))
        self._first = first.eef_position_m.copy()
        self.index, self.progress, self._n_shut = 0, 0.0, 0

    def update(self, observation):
        eef, width = observation.eef_position_m, observation.finger_width_m
        done = False
        if self.index == 0:
            self._n_shut += width <= HELD_M
            done = self._n_shut > 1
        elif self.index == 1:
            done = bool(np.linalg.norm((eef - self._coaster)[:2]) < 0.005 and eef[2] < 0.035)
        if done:
            self.index, self.progress = self.index + 1, 0.0
            self._first = eef.copy()
        goal = (self._cup, self._coaster, self._coaster)[self.index]
        n_axes = 2 if self.phases[self.index] == "CARRY" else 3  # what is left to go, not to sink
        whole = np.linalg.norm((self._first - goal)[:n_axes]) + 1e-9
        share = 1.0 - np.linalg.norm((eef - goal)[:n_axes]) / whole
        self.progress = max(self.progress, float(np.clip(share, 0.0, 1.0)))
        return self.index


class ToyExpert:
    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        self._pace, self._height = rng.uniform(0.6, 0.9), rng.uniform(0.1, 0.15)
        self._points = None

    def act(self, step):
        eef = step.observation.eef_position_m
        if self._points is None:
            self._points = [step.observation.objects[name][0].copy() for name in (CUP, COASTER)]
        cup, coaster = self._points
        if step.phase_name == "TAKE":
            left = cup - eef
            is_there = np.linalg.norm(left) < NEAR_M / 2
            return self._towards(left), GRIPPER_CLOSE if is_there else GRIPPER_OPEN
        if step.phase_name == "CARRY":
            left = coaster - eef
            far = np.linalg.norm(left[:2]) > 0.004
            return self._towards([*left[:2], (self._height if far else 0.02) - eef[2]]), 1.0
        return np.zeros(3), GRIPPER_OPEN

    def _towards(self, left):
        return np.clip(np.array(left) / STEP_M, -self._pace, self._pace)


class ToyTask:
    name = "cup_on_coaster"
    benchmark_id = "toy/0"
    phases = ToyTracker.phases
    carry_phases = ("CARRY",)
    moved_object = CUP
    goal_object = COASTER
    n_official_starts = 2

    def environment(self, *, lean=True):
        del lean  # there is one way of stepping
        return ToyEnvironment()

    def start(self, name):
        seed, index = read_start_name(name)
        if seed is None and index >= self.n_official_starts:
            raise ConfigError(f"official starts are numbered 0 and 1, got {index}")
        rng = np.random.default_rng((999 if seed is None else seed, index))
        places = np.array([0.0, 0.0, 0.2, 0.1, 0.1, 0.0, -0.2, 0.1, 0.0])
        places[[3, 4, 6, 7]] += rng.uniform(-0.02, 0.02, 4)
        return Start(name, places)

    def tracker(self, first):
        return ToyTracker(first)

    def expert(self, seed):
        return ToyExpert(seed)
