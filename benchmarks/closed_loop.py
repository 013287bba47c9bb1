"""The closed loop with a policy in it: our lean path, LIBERO's stock path, and bare MuJoCo.

Speed: a policy acts until it succeeds, on either path, and bare `mj_step` runs from the very
states that the lean loop went through. All take turns in one process on one core, resets are not
counted, and ratios are taken within a round. Equality: episodes of the expert, of defective
experts and of two policies, each once on either path, from the same start with the same seeds; and
once more on the lean path from a start that is moved by less than any sensor could tell. Contacts
blow up the rounding of either, so two paths cannot be more equal than one path is to itself.

Demonstrations for the policies are collected first, or read from a dataset with truth.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from one_core import rows_of

from curation_ros.configuration import topic_map_or_default
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.collect import Collection, collect
from curation_ros.study.units import named_variant
from policy_node.policy import Policy
from policy_node.rollouts import SimController, rollout
from policy_node.settings import TrainingSettings
from policy_node.train import train
from sim_node.defects import DEFECTS, Defect
from sim_node.environment import GRIPPER_CLOSE, GRIPPER_OPEN, Command
from sim_node.episodes import EpisodeResult, run_episode
from sim_node.libero.env import LiberoEnv
from sim_node.settings import EpisodeLimits
from sim_node.starts import Start, generated_name, official_name
from sim_node.tasks.bowl_on_plate import BOWL, TASK
from sim_node.tasks.task import Controller, Step

COMMAND = "python benchmarks/run.py closed_loop"
PARTS = ("speed", "pairs")
N_ROUNDS = 9
N_SUBSTEPS = 25
N_SCRIPTED = 34
"""Paired episodes of the expert, and of each defect; those of each policy are half as many."""
MAX_STEPS = 350
"""Of a paired episode: longer than any that succeeds."""
DIFFERENT_M = 1e-6
"""A difference beyond rounding; where an episode first has it is named if its length differs."""
MOVED_RAD = 1e-13
"""How far the arm of a moved start is from where it was, in each joint."""
TARGET_TO_STOCK, TARGET_TO_BARE = 4.0, 0.85

#: Apart from the starts of every other benchmark and default: seeds of generated starts.
_SEED_DEMONSTRATIONS, _SEED_SPEED, _SEED_PAIRED = 31, 32, 33
_DEMONSTRATIONS = Collection(
    episodes=48,
    contamination=0.5,
    paired=True,
    seed=_SEED_DEMONSTRATIONS,
    max_steps_defective=300,
)
#: With the noise that few demonstrations need.
_SETTINGS = TrainingSettings(steps=3000, start_jitter_m=0.004)

TOPIC_MAP = topic_map_or_default("")

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Pair:
    """What an episode is on both paths.

    Attributes:
        kind: who acts.
        start: where.
        controller: makes a fresh one for an environment.
        steps_after_success: as demonstrations or rollouts have it.
    """

    kind: str
    start: Start
    controller: Callable[[LiberoEnv], Controller]
    steps_after_success: int


@dataclass(frozen=True)
class Run:
    """One of the two.

    Attributes:
        result: how it went.
        eef_m: (T + 1, 3) effector, before each command and after the last.
        bowl_m: (T + 1, 3) bowl.
        phases: (T,) index of the phase of each command.
        let_go: index of the first command to open after one to close; T if there is none.
    """

    result: EpisodeResult
    eef_m: Floats
    bowl_m: Floats
    phases: list[int]
    let_go: int


def policies(dataset: Dataset) -> tuple[Policy, Policy]:
    """One trained on what is clean by the truth, and one on everything."""
    truth = dataset.truth()
    everything = [read_episode(bag) for bag in dataset.bags()]
    clean = [e for e in everything if truth[e.id]["defect"] == "none"]
    first, second = (
        train(
            [(e, None) for e in kept], named_variant("relative"), seed=0, settings=_SETTINGS
        ).policy
        for kept in (clean, everything)
    )
    return first, second


def recorded_states(env: LiberoEnv, start: Start, policy: Policy) -> list[Floats]:
    """What MuJoCo integrates from, torques included, before each command of a rollout."""
    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    states: list[Floats] = []

    def remember(_: Step, __: Command) -> None:
        states.append(np.empty(mujoco.mj_stateSize(env.model, kind)))
        mujoco.mj_getState(env.model, env.data, states[-1], kind)

    limits = EpisodeLimits(steps_after_success=0)
    run_episode(env, TASK, start, SimController(policy, env, TOPIC_MAP), limits, on_step=remember)
    return states


def bare_rate(model: mujoco.MjModel, data: mujoco.MjData, states: list[Floats]) -> float:
    """Control steps a second of bare `mj_step`, one from each state; setting it is free."""
    elapsed_s = 0.0
    for state in states:
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        started_s = time.perf_counter()
        for _ in range(N_SUBSTEPS):
            mujoco.mj_step(model, data)
        elapsed_s += time.perf_counter() - started_s
    return len(states) / elapsed_s


def loop_rate(env: LiberoEnv, start: Start, policy: Policy, max_steps: int = MAX_STEPS) -> float:
    """Steps a second of a rollout, its reset not counted."""
    started_s = time.perf_counter()
    done = rollout(env, TASK, start, policy, TOPIC_MAP, max_steps)
    return done.steps / (time.perf_counter() - started_s - env.reset_s)


def speed_rows(lean: LiberoEnv, stock: LiberoEnv, policy: Policy) -> list[dict[str, Any]]:
    """Closed-loop steps a second on each path."""
    rates: dict[str, list[float]] = {"stock": [], "lean": [], "bare": []}
    data = mujoco.MjData(lean.model)
    for k in range(N_ROUNDS):
        start = TASK.start(generated_name(_SEED_SPEED, k))
        states = recorded_states(lean, start, policy)
        ways: dict[str, Callable[[], float]] = {
            "lean": partial(loop_rate, lean, start, policy),
            "bare": partial(bare_rate, lean.model, data, states),
            "stock": partial(loop_rate, stock, start, policy),
        }
        # Whoever comes first in one round comes last in the next.
        for name in list(ways)[:: -1 if k % 2 else 1]:
            rates[name].append(ways[name]())
    median = {name: statistics.median(values) for name, values in rates.items()}

    def ratio(over: str, under: str) -> float:
        return statistics.median(a / b for a, b in zip(rates[over], rates[under], strict=True))

    to_stock, to_bare = ratio("lean", "stock"), ratio("lean", "bare")
    return [
        row("closed loop, stock", median["stock"], "steps/s"),
        row("closed loop, bare mj_step on the same states", median["bare"], "steps/s"),
        row(
            "closed loop, lean",
            median["lean"],
            "steps/s",
            against="closed loop, stock",
            ratio=to_stock,
            target=f"ratio >= {TARGET_TO_STOCK}",
            holds=to_stock >= TARGET_TO_STOCK,
        ),
        row(
            "closed loop, lean as a part of bare mj_step",
            to_bare,
            "",
            against="closed loop, bare mj_step on the same states",
            ratio=to_bare,
            target=f"ratio >= {TARGET_TO_BARE}",
            holds=to_bare >= TARGET_TO_BARE,
        ),
    ]


def n_compiled() -> int:
    """Functions that a fresh interpreter compiles before it steps, with no program on its path."""
    code = (
        "from sim_node.tasks.bowl_on_plate import TASK;"
        "from sim_node.libero import osc;"
        "env = TASK.environment(); env.reset(TASK.start('official-00').state);"
        "env.step([0.1, 0.0, 0.0], 1.0);"
        "functions = [f for f in vars(osc).values() if hasattr(f, 'stats')];"
        "assert len(functions) == 3, functions;"
        "print(sum(sum(f.stats.cache_misses.values()) for f in functions))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PATH": "", "CC": "", "CXX": ""},
        check=True,
        capture_output=True,
        text=True,
    )
    return int(done.stdout)


def scripted(defect: Defect, seed: int, _: LiberoEnv) -> Controller:
    """An expert with a defect."""
    return defect.inject(TASK.expert(seed), TASK, seed)


def driven_by(policy: Policy, env: LiberoEnv) -> Controller:
    """A policy that observes an environment."""
    return SimController(policy, env, TOPIC_MAP)


def pairs(clean: Policy, contaminated: Policy) -> Iterator[Pair]:
    """Everything that is done on both paths."""
    for first, defect in zip(itertools.count(step=N_SCRIPTED), DEFECTS.values(), strict=False):
        for k in range(first, first + N_SCRIPTED):
            yield Pair(
                "expert" if defect.name == "none" else defect.name,
                TASK.start(generated_name(_SEED_PAIRED, k)),
                partial(scripted, defect, k),
                steps_after_success=20,
            )
    for kind, policy in (("clean policy", clean), ("contaminated policy", contaminated)):
        for k in range(N_SCRIPTED // 2):
            yield Pair(
                kind,
                TASK.start(official_name(k)),
                partial(driven_by, policy),
                steps_after_success=0,
            )


def run_pair(env: LiberoEnv, pair: Pair) -> Run:
    """The episode on the path of this environment."""
    steps: list[Step] = []
    grippers: list[float] = []

    def remember(step: Step, command: Command) -> None:
        steps.append(step)
        grippers.append(command.gripper)

    result = run_episode(
        env,
        TASK,
        pair.start,
        pair.controller(env),
        EpisodeLimits(MAX_STEPS, pair.steps_after_success),
        on_step=remember,
    )
    seen = [*(step.observation for step in steps), env.observe()]
    has_closed, let_go = False, len(steps)
    for index, gripper in enumerate(grippers):
        has_closed |= gripper == GRIPPER_CLOSE
        if has_closed and gripper == GRIPPER_OPEN:
            let_go = index
            break
    return Run(
        result,
        np.array([observation.eef_position_m for observation in seen]),
        np.array([observation.objects[BOWL][0] for observation in seen]),
        [step.phase_index for step in steps],
        let_go,
    )


def moved(start: Start) -> Start:
    """The same start but for the last digits of the arm's joints."""
    state = start.state.copy()
    state[1:8] += MOVED_RAD
    return Start(start.name, state)


class Comparison:
    """Two runs of each episode, by how equal they are.

    Attributes:
        n_outcome: episodes that end alike: success and phase reached.
        n_length: those that also have as many steps, in each phase.
        differing: each other episode, and since when it differs.
        apart_m: largest distance of effector and bowl, by when: until the hand lets go of the
            bowl (in the first to let go), and in all steps that both have.
    """

    def __init__(self) -> None:
        self.n_outcome = self.n_length = 0
        self.differing: list[str] = []
        self.apart_m = {(what, when): 0.0 for when in _WHEN for what in _WHAT}

    def add(self, pair: Pair, a: Run, b: Run) -> None:
        """Compare the runs of one more episode."""
        n = min(len(a.eef_m), len(b.eef_m))
        until = min(a.let_go, b.let_go, n - 1) + 1
        since = []
        for what, x, y in ((_WHAT[0], a.eef_m, b.eef_m), (_WHAT[1], a.bowl_m, b.bowl_m)):
            apart_m = np.linalg.norm(x[:n] - y[:n], axis=1)
            for when, stop in zip(_WHEN, (until, n), strict=True):
                key = what, when
                self.apart_m[key] = max(self.apart_m[key], float(apart_m[:stop].max()))
            different = np.flatnonzero(apart_m > DIFFERENT_M)
            if len(different):
                first = int(different[0])
                phase = TASK.phases[a.phases[min(first, len(a.phases) - 1)]]
                since.append(f"{what} apart since step {first} ({phase})")
        one, other = a.result, b.result
        is_outcome = (one.is_success, one.stage) == (other.is_success, other.stage)
        is_length = is_outcome and one.phase_steps == other.phase_steps
        self.n_outcome += is_outcome
        self.n_length += is_length
        if not is_length:
            ends = (f"{_outcome(r)} in {r.n_steps} steps {r.phase_steps}" for r in (one, other))
            self.differing.append(
                f"{pair.kind} {pair.start.name}: {' / '.join(ends)}, {', '.join(since)}, "
                f"let go at step {a.let_go}"
            )


_WHAT = ("effector", "bowl")
_WHEN = ("until the hand lets go", "over whole episodes")


def _outcome(result: EpisodeResult) -> str:
    return "success" if result.is_success else f"failure in {result.stage}"


def paired_rows(
    lean: LiberoEnv, stock: LiberoEnv, clean: Policy, contaminated: Policy
) -> list[dict[str, Any]]:
    """How equal the paths are, and how equal one is to itself."""
    paths, itself = Comparison(), Comparison()
    counts: dict[str, list[int]] = {}
    for pair in pairs(clean, contaminated):
        began_s = time.perf_counter()
        run = run_pair(lean, pair)
        paths.add(pair, run, run_pair(stock, pair))
        itself.add(pair, run, run_pair(lean, replace(pair, start=moved(pair.start))))
        count = counts.setdefault(pair.kind, [0, 0])
        count[0] += 1
        count[1] += run.result.is_success
        print(
            f"{pair.kind} {pair.start.name}: {time.perf_counter() - began_s:.0f} s; alike so far "
            f"{paths.n_outcome} in outcome, {paths.n_length} in length",
            file=sys.stderr,
            flush=True,
        )
    kinds = ", ".join(f"{n} {kind} ({k} succeed)" for kind, (n, k) in counts.items())
    total = sum(n for n, _ in counts.values())

    def equal(what: str, name: str, note: str, note_itself: str) -> list[dict[str, Any]]:
        prefix = f"paired episodes of {total}, {what}"
        control = f"{prefix}, lean against itself from a start moved by {MOVED_RAD:g} rad"
        n, n_itself = getattr(paths, name), getattr(itself, name)
        return [
            row(
                f"{prefix}, lean against stock",
                n,
                "episodes",
                against=control,
                ratio=n / n_itself if n_itself else None,
                target=f"{total}",
                holds=n == total,
                note=note,
            ),
            row(control, n_itself, "episodes", note=note_itself),
        ]

    rows = equal("equal in outcome", "n_outcome", kinds, "")
    named = "; ".join(paths.differing), "; ".join(itself.differing)
    rows += equal("equal in outcome and length", "n_length", *named)
    for (what, when), apart_m in paths.apart_m.items():
        prefix, itself_m = f"paired episodes, {what} apart {when}", itself.apart_m[what, when]
        control = f"{prefix}, lean against itself"
        ratio = apart_m / itself_m if itself_m else None  # nothing was touched
        rows.append(
            row(f"{prefix}, lean against stock", apart_m, "m", against=control, ratio=ratio)
        )
        rows.append(row(control, itself_m, "m"))
    return rows


def row(name: str, value: float, unit: str, **extra: float | str | bool | None) -> dict[str, Any]:
    """A row of results.json."""
    empty = {"against": "", "ratio": None, "target": None, "holds": None}
    return {"name": name, "value": value, "unit": unit, **empty, **extra, "command": COMMAND}


def measure(dataset: Path | None, parts: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows as they are measured, in this process."""
    with tempfile.TemporaryDirectory() as temporary:
        if dataset is None:
            dataset = Path(temporary) / "demonstrations"
            for collected in collect(dataset, _DEMONSTRATIONS):
                assert not collected.problem, collected
        clean, contaminated = policies(Dataset(dataset))
    with TASK.environment() as lean, TASK.environment(lean=False) as stock:
        if "speed" in parts:
            yield from speed_rows(lean, stock, clean)
            compiled = n_compiled()
            name = "closed loop, functions compiled by a later start without a compiler"
            yield row(name, compiled, "", target="0", holds=compiled == 0)
        if "pairs" in parts:
            yield from paired_rows(lean, stock, clean, contaminated)


def run() -> list[dict[str, Any]]:
    """Measure in a process of its own, with one thread on one core, and return its rows."""
    return rows_of(__file__)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path, nargs="?", help="demonstrations with truth")
    parser.add_argument("--part", choices=PARTS, help="default: all")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    wanted = (arguments.part,) if arguments.part else PARTS
    for result in measure(arguments.dataset, wanted):
        print(json.dumps(result), flush=True)
