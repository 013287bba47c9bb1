"""Observations made by hand, for tests that need no simulator."""

from __future__ import annotations

import numpy as np

from sim_node.environment import Observation
from sim_node.tasks.bowl_on_plate import BOWL, PLATE
from sim_node.tasks.pick_and_place import PHASES
from sim_node.tasks.task import Step

BOWL_START_M = np.array([-0.05, 0.20, 0.90])
PLATE_START_M = np.array([0.06, 0.20, 0.90])


def observation_at(eef_position_m, width_m: float = 0.08, bowl_m=BOWL_START_M) -> Observation:
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    return Observation(
        eef_position_m=np.asarray(eef_position_m, dtype=float),
        eef_quat_xyzw=upright,
        joint_position_rad=np.zeros(7),
        joint_velocity_rad_s=np.zeros(7),
        joint_effort_nm=np.zeros(7),
        finger_position_m=np.array([width_m / 2, -width_m / 2]),
        finger_velocity_m_s=np.zeros(2),
        finger_effort_n=np.zeros(2),
        objects={BOWL: (np.asarray(bowl_m), upright), PLATE: (PLATE_START_M, upright)},
    )


def step_at(
    eef_position_m, phase_index: int = 0, progress: float = 0.0, *, index: int = 0, **observed
) -> Step:
    """A step with a hand-made observation."""
    observation = observation_at(eef_position_m, **observed)
    return Step(index, observation, phase_index, PHASES[phase_index], progress)
