"""Start states of a LIBERO problem: the official ones, and ones drawn as those are spread."""

from __future__ import annotations

import functools
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import ConfigError, SimError
from curation_ros.core.types import Floats
from sim_node.environment import Observation
from sim_node.libero.problem import LiberoProblem
from sim_node.starts import Start, generated_name, official_name, read_start_name

if TYPE_CHECKING:
    from sim_node.libero.env import LiberoEnv

N_OFFICIAL = 50
"""Official starts of each problem."""

# A state is: time, 9 joints, 7 numbers for the pose of each object, and the velocities.
_ARM = slice(1, 8)
_FIRST_OBJECT, _PER_OBJECT = 10, 7
_NOMINAL_JOINT_POSITION_RAD = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4)

# As the official states spread. Demonstrations that start from a narrower range teach too little:
# a policy then stalls where the official bowl has slid off the plate's edge.
_PLACE_HALF_RANGE_M = 0.0145
_JOINT_STD_RAD = 0.02

# What a start must look like after settling: some draws interpenetrate and are thrown apart.
_TABLE_HEIGHT_RANGE_M = (0.885, 0.915)
_MIN_UPRIGHT_COSINE = 0.985
_MAX_ATTEMPTS = 100


@dataclass(frozen=True)
class Place:
    """Where an object starts on the table.

    Attributes:
        x_m, y_m: middle of the region.
        half_x_m, half_y_m: half the size of the region, as the official states spread.
        max_shift_m: an object that lies farther from the middle after settling, or not upright on
            the table, makes the draw unusable; None: this object is not checked.
    """

    x_m: float
    y_m: float
    half_x_m: float = _PLACE_HALF_RANGE_M
    half_y_m: float = _PLACE_HALF_RANGE_M
    max_shift_m: float | None = None


class LiberoStarts:
    """Makes the start states of a problem.

    Args:
        problem: which one.
        places: object -> where it starts, for all movable objects in the problem's order.
    """

    def __init__(self, problem: LiberoProblem, places: Mapping[str, Place]) -> None:
        self._problem = problem
        self._places = dict(places)
        self._lock = threading.Lock()

    def start(self, name: str) -> Start:
        """The start of a name.

        Raises:
            ConfigError: if there is no such start.
            SimError: if LIBERO is missing, or no draw settles.
        """
        seed, index = read_start_name(name)
        return self.official(index) if seed is None else self.generated(seed, index)

    def official(self, index: int) -> Start:
        """One of the official starts.

        Raises:
            ConfigError: if there is no such index.
            SimError: if the file of states cannot be read.
        """
        if not 0 <= index < N_OFFICIAL:
            raise ConfigError(f"official starts are numbered 0 to {N_OFFICIAL - 1}, got {index}")
        return Start(official_name(index), self.official_states[index].copy())

    def generated(self, seed: int, index: int) -> Start:
        """A start drawn as the official ones are spread, which settles with all in place.

        The same (seed, index) gives the same bits in every process.

        Args:
            seed: seed of the family of starts.
            index: within the family; any order, any subset.

        Raises:
            ConfigError: if seed or index is negative.
            SimError: if no draw settles, or LIBERO is missing.
        """
        if seed < 0 or index < 0:
            raise ConfigError(f"seed and index of a generated start are >= 0, got {seed}, {index}")
        rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(index,)))
        with self._lock:
            env = self._env
            for _ in range(_MAX_ATTEMPTS):
                state = self._draw(rng)
                try:
                    settled = env.reset(state)
                except SimError:
                    continue  # objects drawn into one another may explode
                if self._is_acceptable(settled):
                    return Start(generated_name(seed, index), state)
        raise SimError(f"none of {_MAX_ATTEMPTS} draws of start {index} of seed {seed} settles")

    @functools.cached_property
    def official_states(self) -> Floats:
        """All official start states, (50, k); read only.

        Raises:
            SimError: if LIBERO or its file of states is missing or not as expected.
        """
        file = self._problem.states_file
        try:
            with np.load(file, allow_pickle=False) as stored:
                states = np.asarray(stored["states"], dtype=np.float64)
        except (OSError, ValueError, KeyError) as error:
            raise SimError(f"no official start states in {file}: {error}") from error
        if states.ndim != 2 or len(states) != N_OFFICIAL:
            found = states.shape
            raise SimError(f"{file} holds states of shape {found}, expected ({N_OFFICIAL}, n)")
        states.setflags(write=False)
        return states

    @functools.cached_property
    def _env(self) -> LiberoEnv:
        """An environment of its own to settle in."""
        from sim_node.libero.env import LiberoEnv

        env = LiberoEnv(self._problem)
        if env.object_names != tuple(self._places):
            found = ", ".join(env.object_names)
            raise SimError(
                f"places are given for {', '.join(self._places)}; the objects of "
                f"{self._problem.name} are {found}"
            )
        return env

    def _draw(self, rng: np.random.Generator) -> Floats:
        state: Floats = self.official_states[0].copy()
        state[0] = 0.0
        nominal = np.array(_NOMINAL_JOINT_POSITION_RAD)
        state[_ARM] = nominal + rng.normal(0.0, _JOINT_STD_RAD, nominal.shape)
        for k, place in enumerate(self._places.values()):
            middle_m = np.array((place.x_m, place.y_m))
            half_m = np.array((place.half_x_m, place.half_y_m))
            first = _FIRST_OBJECT + _PER_OBJECT * k
            state[first : first + 2] = middle_m + rng.uniform(-half_m, half_m)
        return state

    def _is_acceptable(self, settled: Observation) -> bool:
        low_m, high_m = _TABLE_HEIGHT_RANGE_M
        for name, place in self._places.items():
            if place.max_shift_m is None:
                continue
            position, (x, y, _, _) = settled.objects[name]
            upright = 1.0 - 2.0 * (x * x + y * y)  # third diagonal element of the rotation
            shift_m = np.linalg.norm(position[:2] - np.array((place.x_m, place.y_m)))
            if (
                shift_m > place.max_shift_m
                or not low_m <= position[2] <= high_m
                or upright < _MIN_UPRIGHT_COSINE
            ):
                return False
        return True
