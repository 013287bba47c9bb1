"""What pick-and-place tasks share: geometry, phases from observations, and a scripted expert.

Each task of this kind brings its own numbers. All heights are those of the effector above the
grasp point or the place point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from curation_ros.core.types import Floats
from sim_node.environment import GRIPPER_CLOSE, GRIPPER_OPEN, Observation
from sim_node.tasks.task import Step

PHASES = ("PREGRASP", "DESCEND", "GRASP", "LIFT", "TRANSPORT", "RELEASE")
PREGRASP, DESCEND, GRASP, LIFT, TRANSPORT, RELEASE = range(len(PHASES))

_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Geometry:
    """Where an object is taken and put down, and where phases end.

    Targets lie beyond the ends of their phases, so that no controller waits at a fixed point.

    Attributes:
        grasp_offset_m: (3,) from the object's origin to the grasp point.
        place_offset_m: (3,) from the goal's origin to the place point.
        pregrasp_height_m: target in PREGRASP.
        grasp_height_m: target in DESCEND and GRASP.
        lift_target_height_m: target in LIFT.
        release_height_m: target in RELEASE, and at the end of TRANSPORT.
        descended_height_m: DESCEND ends below it.
        lifted_height_m: LIFT ends above it.
        lowered_height_m: TRANSPORT ends below it.
        tolerance_m: largest distance in each axis at the end of PREGRASP and TRANSPORT. Narrower
            ones make cloned policies stall (1 cm did).
        grasp_steps: fewest steps in GRASP.
        grasped_width_m: GRASP ends when the fingers are closer than this.
        open_width_m: width at which RELEASE counts as done.
    """

    grasp_offset_m: tuple[float, float, float]
    place_offset_m: tuple[float, float, float]
    pregrasp_height_m: float = 0.12
    grasp_height_m: float = 0.034
    lift_target_height_m: float = 0.22
    release_height_m: float = 0.08
    descended_height_m: float = 0.040
    lifted_height_m: float = 0.185
    lowered_height_m: float = 0.090
    tolerance_m: float = 0.015
    grasp_steps: int = 15
    grasped_width_m: float = 0.05
    open_width_m: float = 0.078

    def grasp_point(self, object_start_m: ArrayLike) -> Floats:
        """(3,) point of an object at which it is taken."""
        point_m: Floats = np.asarray(object_start_m, dtype=np.float64) + self.grasp_offset_m
        return point_m

    def place_point(self, goal_start_m: ArrayLike) -> Floats:
        """(3,) point above which the hand must be, so that the object hangs over the goal."""
        point_m: Floats = np.asarray(goal_start_m, dtype=np.float64) + self.place_offset_m
        return point_m


class PickAndPlaceTracker:
    """A `PhaseTracker`: it reads the effector, the fingers, and where the objects were at first.

    Args:
        geometry: numbers of the task.
        object_start_m: (3,) settled position of the object.
        goal_start_m: (3,) settled position of the goal.

    Attributes:
        index: index of the present phase in `PHASES`.
        steps_in_phase: observations in the present phase, the last one included.
        progress: how much of the present phase is done, in [0, 1]; never falls within a phase.
    """

    def __init__(
        self, geometry: Geometry, object_start_m: ArrayLike, goal_start_m: ArrayLike
    ) -> None:
        self._geometry = geometry
        self._grasp_m = geometry.grasp_point(object_start_m)
        self._place_m = geometry.place_point(goal_start_m)
        self._pregrasp_m: Floats = self._grasp_m + geometry.pregrasp_height_m * _UP
        self.index = PREGRASP
        self.steps_in_phase = 0
        self.progress = 0.0
        self._at_entry: Observation | None = None

    def update(self, observation: Observation) -> int:
        """Take the next observation, see `PhaseTracker`."""
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
        geometry = self._geometry
        eef_m = observation.eef_position_m
        height_m = float(eef_m[2] - self._grasp_m[2])
        if self.index == PREGRASP:
            offset_m = np.abs(eef_m - self._pregrasp_m)
            return bool((offset_m < geometry.tolerance_m).all())
        if self.index == DESCEND:
            return height_m < geometry.descended_height_m
        if self.index == GRASP:
            # No sense of touch: closing on nothing looks the same.
            is_closed = observation.finger_width_m < geometry.grasped_width_m
            return self.steps_in_phase >= geometry.grasp_steps and is_closed
        if self.index == LIFT:
            return height_m > geometry.lifted_height_m
        if self.index == TRANSPORT:
            offset_m = np.abs(eef_m - self._place_m)
            is_lowered = eef_m[2] < self._place_m[2] + geometry.lowered_height_m
            return bool((offset_m[:2] < geometry.tolerance_m).all() and is_lowered)
        return False

    def _fraction_done(self, observation: Observation, entry: Observation) -> float:
        geometry = self._geometry
        if self.index == PREGRASP:
            return _approach(entry.eef_position_m, observation.eef_position_m, self._pregrasp_m)
        if self.index in (DESCEND, LIFT):
            is_lift = self.index == LIFT
            threshold_m = geometry.lifted_height_m if is_lift else geometry.descended_height_m
            end_m = self._grasp_m[2] + threshold_m
            start_m = entry.eef_position_m[2]
            return _ratio(observation.eef_position_m[2] - start_m, end_m - start_m)
        if self.index == GRASP:
            # The entry itself counts as the first of the steps.
            return (self.steps_in_phase - 1) / geometry.grasp_steps
        if self.index == TRANSPORT:
            goal_m = self._place_m + geometry.release_height_m * _UP
            return _approach(entry.eef_position_m, observation.eef_position_m, goal_m)
        entry_m = entry.finger_width_m
        return _ratio(observation.finger_width_m - entry_m, geometry.open_width_m - entry_m)


def _approach(start_m: Floats, now_m: Floats, goal_m: Floats) -> float:
    left_m = float(np.linalg.norm(now_m - goal_m))
    return 1.0 - _ratio(left_m, float(np.linalg.norm(start_m - goal_m)))


def _ratio(part: float, whole: float) -> float:
    # A phase that starts at its end is done.
    return float(part / whole) if abs(whole) > 1e-9 else 1.0


# How much experts vary, tuned on generated starts. Each range is drawn from once per episode.
#: Fastest action in each axis (0.2 is about 3 mm per step), and limits after the pace of a phase.
_SPEED_RANGE, _SLOWEST, _FASTEST = (0.16, 0.25), 0.12, 0.28
#: Log-normal spread of the pace of each phase.
_PHASE_SPEED_SIGMA = 0.08
#: Spread of each waypoint in x and y; half of it in z; cut at 2 sigma.
_WAYPOINT_STD_M = 0.002
#: Most steps of slow motion at the start of a phase, drawn for each; and their pace.
_HESITATION_STEPS, _HESITATION_SPEED = 8, 0.3
#: Spread of the slow noise on actions, and its correlation time.
_TREMOR_STD, _TREMOR_TIME_STEPS = 0.02, 15.0
#: How much higher than the release the object is carried.
_CARRY_HEIGHT_RANGE_M = (0.10, 0.14)
#: Action per metre of distance to the waypoint.
_GAIN_PER_M = 10.0
#: Largest action in each axis, tremor included.
_MAX_ACTION = 0.3


class PickAndPlaceExpert:
    """A scripted expert that differs from episode to episode, as a person does.

    It aims at one waypoint per phase. Each episode has a pace, a slant on every waypoint, short
    hesitations between phases, and a slow tremor, all drawn from its seed. So clean demonstrations
    differ in length and shape and still succeed. The objects are read once, in the first
    observation: like the phases, the expert does not notice that it has lost the object.

    Args:
        geometry: numbers of the task.
        moved_object: name of the object.
        goal_object: name of the goal.
        seed: seed of everything that varies.
    """

    def __init__(self, geometry: Geometry, moved_object: str, goal_object: str, seed: int) -> None:
        self._geometry = geometry
        self._names = moved_object, goal_object
        self._rng = rng = np.random.default_rng(seed)
        n = len(PHASES)
        pace = np.exp(rng.normal(0.0, _PHASE_SPEED_SIGMA, n))
        self._speed = np.clip(rng.uniform(*_SPEED_RANGE) * pace, _SLOWEST, _FASTEST)
        offset = np.clip(rng.normal(0.0, 1.0, (n, 3)), -2.0, 2.0) * _WAYPOINT_STD_M
        offset[:, 2] *= 0.5
        # Never higher in a phase that ends below a threshold close to the waypoint.
        for phase in (DESCEND, GRASP, TRANSPORT, RELEASE):
            offset[phase, 2] = -abs(offset[phase, 2])
        # Taken and held at one point of the object, put down over one point of the goal.
        offset[GRASP] = offset[DESCEND]
        offset[LIFT, :2] = offset[DESCEND, :2]
        offset[RELEASE] = offset[TRANSPORT]
        self._offset_m = offset
        self._hesitation = rng.integers(0, _HESITATION_STEPS + 1, n)
        self._carry_height_m = rng.uniform(*_CARRY_HEIGHT_RANGE_M)
        self._tremor = rng.normal(0.0, _TREMOR_STD, 3)
        self._phase = -1
        self._steps_in_phase = 0
        self._points_m: tuple[Floats, Floats] | None = None

    def act(self, step: Step) -> tuple[Floats, float]:
        """The command that answers a step; see `Controller`."""
        observation, phase_index = step.observation, step.phase_index
        if phase_index != self._phase:
            self._phase = phase_index
            self._steps_in_phase = 0
        waypoint_m = self._waypoint(observation, phase_index)
        limit = float(self._speed[phase_index])
        if self._steps_in_phase < self._hesitation[phase_index]:
            limit *= _HESITATION_SPEED
        self._steps_in_phase += 1

        action = _GAIN_PER_M * (waypoint_m - observation.eef_position_m)
        action = np.clip(action, -limit, limit) + self._next_tremor()
        is_closed = GRASP <= phase_index <= TRANSPORT
        return np.clip(
            action, -_MAX_ACTION, _MAX_ACTION
        ), GRIPPER_CLOSE if is_closed else GRIPPER_OPEN

    def _waypoint(self, observation: Observation, phase_index: int) -> Floats:
        geometry = self._geometry
        if self._points_m is None:
            object_m, goal_m = (observation.objects[name][0] for name in self._names)
            self._points_m = geometry.grasp_point(object_m), geometry.place_point(goal_m)
        grasp_m, place_m = self._points_m
        if phase_index >= TRANSPORT:
            point_m, height_m = place_m, geometry.release_height_m
        else:
            point_m = grasp_m
            height_m = {
                PREGRASP: geometry.pregrasp_height_m,
                LIFT: geometry.lift_target_height_m,
            }.get(phase_index, geometry.grasp_height_m)
        waypoint_m: Floats = point_m + self._offset_m[phase_index]
        if phase_index == TRANSPORT:
            # High while far, lower while near: one smooth motion over the rim and down.
            far_m = float(np.linalg.norm((waypoint_m - observation.eef_position_m)[:2])) - 0.01
            height_m += min(max(1.5 * far_m, 0.0), self._carry_height_m)
        waypoint_m[2] += height_m
        return waypoint_m

    def _next_tremor(self) -> Floats:
        keep = np.exp(-1.0 / _TREMOR_TIME_STEPS)
        fresh = self._rng.normal(0.0, _TREMOR_STD, 3)
        self._tremor = keep * self._tremor + np.sqrt(1.0 - keep**2) * fresh
        return self._tremor
