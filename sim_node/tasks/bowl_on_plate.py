"""Put the bowl that stands between plate and ramekin onto the plate: LIBERO's libero_spatial 0."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from curation_ros.core.evidence.holds import CARRY_PHASES
from sim_node.environment import Observation
from sim_node.libero.problem import LiberoProblem
from sim_node.libero.starts import N_OFFICIAL, LiberoStarts, Place
from sim_node.starts import Start
from sim_node.tasks.pick_and_place import (
    PHASES,
    Geometry,
    PickAndPlaceExpert,
    PickAndPlaceTracker,
)
from sim_node.tasks.task import Controller, PhaseTracker

if TYPE_CHECKING:
    from sim_node.libero.env import LiberoEnv

BOWL = "akita_black_bowl_1"
PLATE = "plate_1"

GEOMETRY = Geometry(
    # The rim of the bowl, where it slips least. The bowl hangs tilted below the hand.
    grasp_offset_m=(0.0075, -0.049, 0.0),
    place_offset_m=(0.004, -0.036, 0.0),
)

MAX_BOWL_SHIFT_M, MAX_PLATE_SHIFT_M = 0.06, 0.03


class BowlOnPlate:
    """A `Task` of the suite libero_spatial: the same bowl and plate, the bowl somewhere else.

    Args:
        name: key in `TASKS`.
        number: number in the suite.
        problem: name of the suite's file.
        places: where the objects start.
    """

    phases = PHASES
    carry_phases = CARRY_PHASES
    moved_object = BOWL
    goal_object = PLATE
    n_official_starts = N_OFFICIAL

    def __init__(self, name: str, number: int, problem: str, places: Mapping[str, Place]) -> None:
        self.name = name
        self.benchmark_id = f"libero_spatial/{number}"
        self._problem = LiberoProblem("libero_spatial", problem)
        self._starts = LiberoStarts(self._problem, places)

    def environment(self, *, lean: bool = True) -> LiberoEnv:
        """LIBERO, see `Task.environment`."""
        # Imported here: MuJoCo is only needed to simulate, not to name tasks and starts.
        from sim_node.libero.env import LiberoEnv

        return LiberoEnv(self._problem, lean=lean)

    def start(self, name: str) -> Start:
        """A start, see `Task.start`."""
        return self._starts.start(name)

    def tracker(self, first: Observation) -> PhaseTracker:
        """A tracker, see `Task.tracker`."""
        return PickAndPlaceTracker(GEOMETRY, first.objects[BOWL][0], first.objects[PLATE][0])

    def expert(self, seed: int) -> Controller:
        """The expert, see `Task.expert`."""
        return PickAndPlaceExpert(GEOMETRY, BOWL, PLATE, seed)


TASK = BowlOnPlate(
    name="bowl_on_plate",
    number=0,
    problem="pick_up_the_black_bowl_between_the_plate_and_the_ramekin_and_place_it_on_the_plate",
    places={
        BOWL: Place(-0.05, 0.20, max_shift_m=MAX_BOWL_SHIFT_M),
        "akita_black_bowl_2": Place(-0.18, 0.32),
        "cookies_1": Place(0.07, 0.03),
        "glazed_rim_porcelain_ramekin_1": Place(-0.20, 0.20),
        PLATE: Place(0.06, 0.20, max_shift_m=MAX_PLATE_SHIFT_M),
    },
)
