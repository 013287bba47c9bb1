"""Start states by name: LIBERO's 50 official ones, and any number of generated ones.

Demonstrations use generated starts, and so does every choice; the official ones are for the final
measurement alone.
"""

from __future__ import annotations

import functools
import re
import threading
from dataclasses import dataclass

import numpy as np

from curation_ros.core.errors import ConfigError, SimError
from curation_ros.core.types import Floats
from sim_node import quiet_libero
from sim_node.env import BOWL, PLATE, LiberoEnv
from sim_node.environment import Observation

N_OFFICIAL = 50

# Position of the first number of each object's pose in a state (time, 9 joints, then the objects),
# and the middle of the region where the task's definition puts it, x and y in m.
_PLACES = {
    "akita_black_bowl_1": (10, (-0.05, 0.20)),
    "akita_black_bowl_2": (17, (-0.18, 0.32)),
    "cookies_1": (24, (0.07, 0.03)),
    "glazed_rim_porcelain_ramekin_1": (31, (-0.20, 0.20)),
    "plate_1": (38, (0.06, 0.20)),
}
_ARM = slice(1, 8)
_NOMINAL_JOINT_POSITION_RAD = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4)

# As the official states spread. Demonstrations that start from a narrower range teach too little:
# a policy then stalls where the official bowl has slid off the plate's edge.
_PLACE_HALF_RANGE_M = 0.0145
_JOINT_STD_RAD = 0.02

# What a start must look like after settling: some draws interpenetrate and are thrown apart.
_MAX_BOWL_SHIFT_M = 0.06
_MAX_PLATE_SHIFT_M = 0.03
_TABLE_HEIGHT_RANGE_M = (0.885, 0.915)
_MIN_UPRIGHT_COSINE = 0.985
_MAX_ATTEMPTS = 100

_SPEC_HELP = (
    "expected official:FIRST:END, generated:SEED:COUNT or generated:SEED:FIRST:END, "
    "several separated by commas"
)
_settling_lock = threading.Lock()


@dataclass(frozen=True)
class Start:
    """A start state and its name.

    Attributes:
        name: `official-07`, `generated-0-012` (seed, index); `start_by_name` finds it again.
        state: (92,) time, positions, velocities, as `LiberoEnv.reset` takes it.
    """

    name: str
    state: Floats


@functools.cache
def official_states() -> Floats:
    """All official start states of the task, (50, 92); read only.

    Raises:
        SimError: if LIBERO or its file of states is missing or not as expected.
    """
    file = quiet_libero.official_states_file()
    try:
        with np.load(file, allow_pickle=False) as stored:
            states = np.asarray(stored["states"], dtype=np.float64)
    except (OSError, ValueError, KeyError) as error:
        raise SimError(f"no official start states in {file}: {error}") from error
    if states.ndim != 2 or len(states) != N_OFFICIAL:
        raise SimError(f"{file} holds states of shape {states.shape}, expected ({N_OFFICIAL}, n)")
    states.setflags(write=False)
    return states


def official_start(index: int) -> Start:
    """One of the 50 official starts.

    Raises:
        ConfigError: if there is no such index.
        SimError: if the file of states cannot be read.
    """
    if not 0 <= index < N_OFFICIAL:
        raise ConfigError(f"official starts are numbered 0 to {N_OFFICIAL - 1}, got {index}")
    return Start(_official_name(index), official_states()[index].copy())


def generated_start(seed: int, index: int, *, env: LiberoEnv | None = None) -> Start:
    """A start drawn as the official ones are, that settles with bowl and plate in their places.

    The same (seed, index) gives the same bits in every process.

    Args:
        seed: of the family of starts.
        index: within the family; any order, any subset.
        env: a lean environment to settle in (it is reset); default: one kept for this purpose.

    Raises:
        ConfigError: if seed or index is negative.
        SimError: if no draw settles, or LIBERO is missing.
    """
    if seed < 0 or index < 0:
        raise ConfigError(f"seed and index of a generated start are >= 0, got {seed}, {index}")
    rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(index,)))
    with _settling_lock:
        judge = env if env is not None else _settling_env()
        for _ in range(_MAX_ATTEMPTS):
            state = _draw(rng)
            try:
                settled = judge.reset(state)
            except SimError:
                continue  # objects drawn into one another may explode
            if _is_acceptable(settled):
                return Start(_generated_name(seed, index), state)
    raise SimError(f"none of {_MAX_ATTEMPTS} draws of start {index} of seed {seed} settles")


def start_names(spec: str) -> list[str]:
    """Names of the starts that a specification means; nothing is simulated for it.

    Args:
        spec: `official:0:50` (first, end), `generated:0:24` (seed, count),
            `generated:0:24:48` (seed, first, end); or several of these, separated by commas.

    Raises:
        ConfigError: if the text is no such specification.
    """
    names: list[str] = []
    for part in spec.split(","):
        kind, *texts = part.strip().split(":")
        numbers = [int(text) for text in texts if re.fullmatch(r"[0-9]{1,9}", text)]
        if len(numbers) != len(texts):
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is no range; {_SPEC_HELP}")
        if kind == "official" and len(numbers) == 2:
            first, end = numbers
            if end > N_OFFICIAL:
                raise ConfigError(f"starts {spec!r}: there are {N_OFFICIAL} official starts")
        elif kind == "generated" and len(numbers) in (2, 3):
            first, end = (0, numbers[1]) if len(numbers) == 2 else (numbers[1], numbers[2])
        else:
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is unknown; {_SPEC_HELP}")
        if first >= end:
            raise ConfigError(f"starts {spec!r}: {part.strip()!r} is empty; {_SPEC_HELP}")
        for index in range(first, end):
            names.append(
                _official_name(index) if kind == "official" else _generated_name(numbers[0], index)
            )
    if len(set(names)) != len(names):
        raise ConfigError(f"starts {spec!r}: some start is named twice")
    return names


def parse_starts(spec: str) -> list[Start]:
    """The starts that a specification means; see `start_names`."""
    return [start_by_name(name) for name in start_names(spec)]


def _official_name(index: int) -> str:
    return f"official-{index:02d}"


def _generated_name(seed: int, index: int) -> str:
    return f"generated-{seed}-{index:03d}"


def start_by_name(name: str) -> Start:
    """The start that a name of a `Start` belongs to.

    Raises:
        ConfigError: if the name is none of ours.
    """
    official = re.fullmatch(r"official-([0-9]{1,9})", name)
    if official:
        return official_start(int(official[1]))
    generated = re.fullmatch(r"generated-([0-9]{1,9})-([0-9]{1,9})", name)
    if generated:
        return generated_start(int(generated[1]), int(generated[2]))
    raise ConfigError(f"start {name!r} is unknown; expected official-07 or generated-0-012")


@functools.cache
def _settling_env() -> LiberoEnv:
    return LiberoEnv(lean=True)


def _draw(rng: np.random.Generator) -> Floats:
    state: Floats = official_states()[0].copy()
    state[0] = 0.0
    nominal = np.array(_NOMINAL_JOINT_POSITION_RAD)
    state[_ARM] = nominal + rng.normal(0.0, _JOINT_STD_RAD, nominal.shape)
    for first, (x, y) in _PLACES.values():
        shift = rng.uniform(-_PLACE_HALF_RANGE_M, _PLACE_HALF_RANGE_M, 2)
        state[first : first + 2] = np.array((x, y)) + shift
    return state


def _is_acceptable(settled: Observation) -> bool:
    for name, limit_m in ((BOWL, _MAX_BOWL_SHIFT_M), (PLATE, _MAX_PLATE_SHIFT_M)):
        position, (x, y, _, _) = settled.objects[name]
        upright = 1.0 - 2.0 * (x * x + y * y)  # third diagonal element of the rotation
        low, high = _TABLE_HEIGHT_RANGE_M
        shift_m = np.linalg.norm(position[:2] - np.array(_PLACES[name][1]))
        if shift_m > limit_m or not low <= position[2] <= high or upright < _MIN_UPRIGHT_COSINE:
            return False
    return True
