"""The phase of an episode, from observations alone, and the geometry of the task.

One tracker serves expert, defects, policies and people. It reads effector, fingers, and where
bowl and plate were after settling; never the live bowl, contacts or success: a controller that
has lost the bowl passes through the same phases as one that has not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from curation_ros.core.episode.phases import PHASES
from curation_ros.core.types import Floats
from sim_node.env import BOWL, PLATE
from sim_node.environment import Observation

PREGRASP, DESCEND, GRASP, LIFT, TRANSPORT, RELEASE = range(len(PHASES))

RIM_OFFSET_M = np.array([0.0075, -0.049, 0.0])
"""From the bowl's origin to where the fingers take its rim; there it slips least."""

PLACE_OFFSET_M = np.array([0.004, -0.036, 0.0])
"""From the plate's origin to where the hand lets go; the bowl hangs tilted below it."""

# Where controllers aim lies beyond where phases end, so that none waits at a fixed point.
PREGRASP_HEIGHT_M = 0.12
GRASP_HEIGHT_M = 0.034
LIFT_TARGET_HEIGHT_M = 0.22
RELEASE_HEIGHT_M = 0.08

TOLERANCE_M = 0.015
"""Reached, in each axis. Narrower ones stall cloned policies (1 cm did)."""

_DESCENDED_HEIGHT_M = 0.040
_LIFTED_HEIGHT_M = 0.185
_LOWERED_HEIGHT_M = 0.090
_GRASP_STEPS = 15
_GRASPED_WIDTH_M = 0.05
_OPEN_WIDTH_M = 0.078


def grasp_point(bowl_start_m: ArrayLike) -> Floats:
    """(3,) point of the bowl's rim that is taken; heights above it are in this module."""
    point_m: Floats = np.asarray(bowl_start_m, dtype=np.float64) + RIM_OFFSET_M
    return point_m


def place_point(plate_start_m: ArrayLike) -> Floats:
    """(3,) where the hand must be above so that the bowl hangs over the plate."""
    point_m: Floats = np.asarray(plate_start_m, dtype=np.float64) + PLACE_OFFSET_M
    return point_m


def lift_end_height_m(bowl_start_m: ArrayLike) -> float:
    """World height of the effector at which LIFT ends."""
    return float(grasp_point(bowl_start_m)[2]) + _LIFTED_HEIGHT_M


class PhaseTracker:
    """Follows one episode; phases only advance, at most one a step.

    Args:
        bowl_start_m: (3,) settled position of the bowl.
        plate_start_m: (3,) settled position of the plate.

    Attributes:
        index: of the present phase in `PHASES`.
        steps_in_phase: observations in the present phase, the last one included.
        progress: how much of the present phase is done, in [0, 1]; never falls within a phase.
    """

    def __init__(self, bowl_start_m: ArrayLike, plate_start_m: ArrayLike) -> None:
        self._grasp_m = grasp_point(bowl_start_m)
        self._place_m = place_point(plate_start_m)
        self._pregrasp_m: Floats = self._grasp_m + np.array([0.0, 0.0, PREGRASP_HEIGHT_M])
        self.index = PREGRASP
        self.steps_in_phase = 0
        self.progress = 0.0
        self._at_entry: Observation | None = None

    @classmethod
    def from_observation(cls, first: Observation) -> PhaseTracker:
        """A tracker for the episode that starts with this observation."""
        return cls(first.objects[BOWL][0], first.objects[PLATE][0])

    @property
    def name(self) -> str:
        """Name of the present phase."""
        return PHASES[self.index]

    def update(self, observation: Observation) -> int:
        """Take the next observation; call exactly once a step.

        Returns:
            Index of the phase that the command answering this observation belongs to.
        """
        if self._at_entry is None:
            self._at_entry = observation
        elif self._is_done(observation):
            self.index += 1
            self.steps_in_phase = 0
            self.progress = 0.0
            self._at_entry = observation
        self.steps_in_phase += 1
        done = self._fraction_done(observation, self._at_entry)
        self.progress = max(self.progress, min(max(done, 0.0), 1.0))
        return self.index

    def _is_done(self, observation: Observation) -> bool:
        eef_m = observation.eef_position_m
        height_m = float(eef_m[2] - self._grasp_m[2])
        if self.index == PREGRASP:
            offset_m = np.abs(eef_m - self._pregrasp_m)
            return bool((offset_m < TOLERANCE_M).all())
        if self.index == DESCEND:
            return height_m < _DESCENDED_HEIGHT_M
        if self.index == GRASP:
            # No sense of touch: closing on nothing looks the same.
            closed = observation.finger_width_m < _GRASPED_WIDTH_M
            return self.steps_in_phase >= _GRASP_STEPS and closed
        if self.index == LIFT:
            return height_m > _LIFTED_HEIGHT_M
        if self.index == TRANSPORT:
            offset_m = np.abs(eef_m - self._place_m)
            lowered = eef_m[2] < self._place_m[2] + _LOWERED_HEIGHT_M
            return bool((offset_m[:2] < TOLERANCE_M).all() and lowered)
        return False

    def _fraction_done(self, observation: Observation, entry: Observation) -> float:
        if self.index == PREGRASP:
            return _approach(entry.eef_position_m, observation.eef_position_m, self._pregrasp_m)
        if self.index in (DESCEND, LIFT):
            threshold_m = _DESCENDED_HEIGHT_M if self.index == DESCEND else _LIFTED_HEIGHT_M
            end_m = self._grasp_m[2] + threshold_m
            start_m = entry.eef_position_m[2]
            return _ratio(observation.eef_position_m[2] - start_m, end_m - start_m)
        if self.index == GRASP:
            # The entry itself counts as the first of the steps.
            return (self.steps_in_phase - 1) / _GRASP_STEPS
        if self.index == TRANSPORT:
            goal_m = self._place_m + np.array([0.0, 0.0, RELEASE_HEIGHT_M])
            return _approach(entry.eef_position_m, observation.eef_position_m, goal_m)
        entry_m = entry.finger_width_m
        return _ratio(observation.finger_width_m - entry_m, _OPEN_WIDTH_M - entry_m)


def _approach(start_m: Floats, now_m: Floats, goal_m: Floats) -> float:
    left_m = float(np.linalg.norm(now_m - goal_m))
    return 1.0 - _ratio(left_m, float(np.linalg.norm(start_m - goal_m)))


def _ratio(part: float, whole: float) -> float:
    # Where a phase starts at its end there is nothing left to do.
    return float(part / whole) if abs(whole) > 1e-9 else 1.0
