"""A scripted expert that differs from episode to episode as a person does.

It aims at one waypoint a phase. Each episode has a pace, a slant on every waypoint, short
hesitations where phases change, and a slow tremor, all drawn from its seed; so clean
demonstrations differ in length and shape and still succeed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from curation_ros.core.episode.phases import PHASES
from curation_ros.core.types import Floats
from sim_node import phases
from sim_node.env import BOWL, PLATE
from sim_node.environment import GRIPPER_CLOSE, GRIPPER_OPEN, Observation
from sim_node.tasks.task import Step


@dataclass(frozen=True)
class ExpertParams:
    """How much experts vary; every range is drawn from once an episode unless said otherwise.

    The defaults are tuned on generated starts.

    Attributes:
        speed_range: fastest action in each axis; 0.2 is about 3 mm a step.
        phase_speed_sigma: log-normal spread of the pace of each phase.
        waypoint_std_m: spread of each waypoint in x and y (in z, half of it); cut at 2 sigma.
        hesitation_steps: most steps of slow motion at the start of a phase, drawn for each.
        hesitation_speed: pace while hesitating, as a fraction.
        tremor_std: spread of the slow noise added to actions.
        tremor_time_steps: time in which the tremor forgets itself.
        carry_height_range_m: how much higher than the release the bowl is carried.
        gain_per_m: action a metre of distance to the waypoint.
        max_action: of each axis, tremor included.
    """

    speed_range: tuple[float, float] = (0.16, 0.25)
    phase_speed_sigma: float = 0.08
    waypoint_std_m: float = 0.002
    hesitation_steps: int = 8
    hesitation_speed: float = 0.3
    tremor_std: float = 0.02
    tremor_time_steps: float = 15.0
    carry_height_range_m: tuple[float, float] = (0.10, 0.14)
    gain_per_m: float = 10.0
    max_action: float = 0.3


class Expert:
    """Picks the bowl up by its rim and puts it onto the plate; for one episode.

    The live bowl is read once, in the first observation: like the phases, the expert does not
    notice when it has lost the bowl.

    Args:
        seed: of everything that varies.
        params: how much it varies.
    """

    def __init__(self, seed: int, params: ExpertParams | None = None) -> None:
        self.params = p = params if params is not None else ExpertParams()
        self._rng = rng = np.random.default_rng(seed)
        n = len(PHASES)
        pace = np.exp(rng.normal(0.0, p.phase_speed_sigma, n))
        self._speed = np.clip(rng.uniform(*p.speed_range) * pace, 0.12, 0.28)
        offset = np.clip(rng.normal(0.0, 1.0, (n, 3)), -2.0, 2.0) * p.waypoint_std_m
        offset[:, 2] *= 0.5
        # Never higher where a phase ends below a threshold close to the waypoint.
        for phase in (phases.DESCEND, phases.GRASP, phases.TRANSPORT, phases.RELEASE):
            offset[phase, 2] = -abs(offset[phase, 2])
        # Taken and held at one point of the rim, put down over one point of the plate.
        offset[phases.GRASP] = offset[phases.DESCEND]
        offset[phases.LIFT, :2] = offset[phases.DESCEND, :2]
        offset[phases.RELEASE] = offset[phases.TRANSPORT]
        self._offset_m = offset
        self._hesitation = rng.integers(0, p.hesitation_steps + 1, n)
        self._carry_height_m = rng.uniform(*p.carry_height_range_m)
        self._tremor = rng.normal(0.0, p.tremor_std, 3)
        self._phase = -1
        self._steps_in_phase = 0
        self._grasp_m: Floats | None = None
        self._place_m: Floats | None = None

    def act(self, step: Step) -> tuple[Floats, float]:
        """The command that answers a step; see `Controller`."""
        observation, phase_index = step.observation, step.phase_index
        if phase_index != self._phase:
            self._phase = phase_index
            self._steps_in_phase = 0
        waypoint_m = self._waypoint(observation, phase_index)
        limit = float(self._speed[phase_index])
        if self._steps_in_phase < self._hesitation[phase_index]:
            limit *= self.params.hesitation_speed
        self._steps_in_phase += 1

        action = self.params.gain_per_m * (waypoint_m - observation.eef_position_m)
        action = np.clip(action, -limit, limit) + self._next_tremor()
        closed = phases.GRASP <= phase_index <= phases.TRANSPORT
        limit = self.params.max_action
        return np.clip(action, -limit, limit), GRIPPER_CLOSE if closed else GRIPPER_OPEN

    def _waypoint(self, observation: Observation, phase_index: int) -> Floats:
        if self._grasp_m is None or self._place_m is None:
            self._grasp_m = phases.grasp_point(observation.objects[BOWL][0])
            self._place_m = phases.place_point(observation.objects[PLATE][0])
        if phase_index >= phases.TRANSPORT:
            point_m, height_m = self._place_m, phases.RELEASE_HEIGHT_M
        else:
            point_m = self._grasp_m
            height_m = {
                phases.PREGRASP: phases.PREGRASP_HEIGHT_M,
                phases.LIFT: phases.LIFT_TARGET_HEIGHT_M,
            }.get(phase_index, phases.GRASP_HEIGHT_M)
        waypoint_m: Floats = point_m + self._offset_m[phase_index]
        if phase_index == phases.TRANSPORT:
            # High while far, lower while near: one smooth motion over the rim and down.
            far_m = float(np.linalg.norm((waypoint_m - observation.eef_position_m)[:2])) - 0.01
            height_m += min(max(1.5 * far_m, 0.0), self._carry_height_m)
        waypoint_m[2] += height_m
        return waypoint_m

    def _next_tremor(self) -> Floats:
        keep = np.exp(-1.0 / self.params.tremor_time_steps)
        fresh = self._rng.normal(0.0, self.params.tremor_std, 3)
        self._tremor = keep * self._tremor + np.sqrt(1.0 - keep**2) * fresh
        return self._tremor
