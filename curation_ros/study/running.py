"""Runs a study: collects, scores, trains and rolls out what its plan names and is not done yet."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from curation_ros.core.episode.episode import Episode
from curation_ros.core.types import JsonObject
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_all_episodes
from curation_ros.files import append_line, named_errors, read_lines
from curation_ros.study.curated import timeline_of
from curation_ros.study.datasets import check_starts, collect_datasets
from curation_ros.study.plan import Stage, StudyPlan
from curation_ros.study.pools import Pool, score_pool
from curation_ros.study.terms import parse_row
from curation_ros.study.training_sets import TrainingSet, training_set
from curation_ros.study.trials import PolicyTrials, Work
from curation_ros.study.units import PolicyUnit, RolloutUnit

#: Called with a line about each part of a study.
Log = Callable[[str], None]
#: Called for each unit that was done: a label, how many are done, and of how many.
Ticks = Callable[[str, int, int], None]
# So many training sets are trained on, then rolled out, then the next ones.
_CELLS = 16


@dataclass(frozen=True)
class Cell:
    """A training set and a variant in a stage, with a policy per training seed.

    Attributes:
        stage: of the plan.
        variant: name of what the policies observe and command.
        sets: training seed -> what its policy learns from. All are the same set, except for
            controls that are drawn again for each seed.
    """

    stage: Stage
    variant: str
    sets: Mapping[int, TrainingSet]

    @property
    def pool(self) -> str:
        """Name of the pool."""
        return next(iter(self.sets.values())).pool

    @property
    def row(self) -> str:
        """Name of the training set in the plan."""
        return next(iter(self.sets.values())).row

    @property
    def policies(self) -> dict[int, str]:
        """Training seed -> id of the policy; equal sets have the same policies."""
        return {
            seed: PolicyUnit(made.id, self.variant, seed, ()).key
            for seed, made in self.sets.items()
        }


@dataclass(frozen=True)
class Study:
    """A study, complete or not.

    Attributes:
        plan: of it.
        trials: its policies and rollouts.
        pools: by name, scored.
        reference: trusted demonstrations.
        cells: all of the plan, in its order.
        problems: what failed or was not begun, one line each.
        seconds: duration of each part, in all runs so far.
        n_reference: number of trusted demonstrations.
        timelines: id -> demonstration with its phases and stamps alone.
    """

    plan: StudyPlan
    trials: PolicyTrials
    pools: Mapping[str, Pool]
    reference: Dataset
    cells: tuple[Cell, ...]
    problems: tuple[str, ...]
    seconds: tuple[JsonObject, ...]
    n_reference: int
    timelines: Mapping[str, Episode] = field(default_factory=dict)


def run_study(
    plan: StudyPlan,
    folder: Path,
    data: Path,
    *,
    jobs: int = 1,
    backend: str = "loky",
    log: Log = lambda text: None,
    ticks: Ticks = lambda label, done, of: None,
    work: bool = True,
    stages: Sequence[str] = (),
) -> Study:
    """Do what a plan names and no earlier run has done.

    Args:
        plan: what to do.
        folder: of the study: policies, `units.jsonl`, `seconds.jsonl`.
        data: folder of the datasets, which are collected if they are missing; studies may share
            them.
        jobs: workers.
        backend: of the workers.
        log: called with a line about each part.
        ticks: called for each unit that is done.
        work: whether to train and roll out; False: only count what is done.
        stages: names of the stages to do and to count; empty: all.

    Raises:
        ConfigError: if the plan makes no sense, or differs from the one that the folder was begun
            with.
        CurationError: if a dataset cannot be completed or scored, or a file cannot be written.
    """
    check_starts(plan)
    if stages:
        plan = plan.only(stages)
    clock = _Clock(folder / "seconds.jsonl", writes=work)
    with clock.measured("collect") as fact:
        datasets, fact["units"] = collect_datasets(data, plan, jobs=jobs, backend=backend, log=log)
    reference = read_all_episodes(datasets["reference"], "reference")
    pools = _score_pools(plan, datasets, reference, clock, log)
    trials = _trials(plan, folder, jobs, backend)
    cells = tuple(_cells(plan, pools, datasets["reference"], datasets.get("more")))
    log(
        f"{len(cells)} cells, {len({p for c in cells for p in c.policies.values()})} policies; "
        f"{trials.used_steps} of {plan.budget_steps} simulation steps are used"
    )
    problems: list[str] = []
    for label, part in _parts(cells) if work else ():
        problems += _train_and_roll(trials, plan, label, part, clock, log, ticks)
    return Study(
        plan=plan,
        trials=trials,
        pools=pools,
        reference=datasets["reference"],
        cells=cells,
        problems=tuple(dict.fromkeys(problems)),
        seconds=tuple(clock.all()),
        n_reference=len(reference),
        timelines=_timelines(datasets, reference, pools),
    )


def _score_pools(
    plan: StudyPlan,
    datasets: Mapping[str, Dataset],
    reference: Sequence[Episode],
    clock: _Clock,
    log: Log,
) -> dict[str, Pool]:
    pools = {}
    with clock.measured("score and audit"):
        for name in plan.pools:
            pools[name] = score_pool(name, datasets[name], reference, plan)
            log(f"pool {name}: {len(plan.scorers)} scorers, {pools[name].facts['n']} scored")
    return pools


def _timelines(
    datasets: Mapping[str, Dataset], reference: Sequence[Episode], pools: Mapping[str, Pool]
) -> dict[str, Episode]:
    """Id -> demonstration with only its phases and stamps, of all datasets."""
    further = read_all_episodes(datasets["more"], "more") if "more" in datasets else []
    timelines = {e.id: timeline_of(e) for e in (*reference, *further)}
    for pool in pools.values():
        timelines |= pool.timelines
    return timelines


def _cells(
    plan: StudyPlan, pools: Mapping[str, Pool], reference: Dataset, more: Dataset | None
) -> Iterator[Cell]:
    made: dict[tuple[str, str, int], TrainingSet] = {}
    for stage in plan.stages:
        for pool, variant, row in stage.cells():
            is_drawn = any(term.is_drawn for term in parse_row(row))
            sets = {}
            for seed in stage.seeds_of(row):
                draw = stage.seeds.index(seed) if is_drawn else 0
                key = (pool, row, draw)
                if key not in made:
                    made[key] = training_set(
                        pools[pool], row, reference, plan.selection_seed, draw, more=more
                    )
                sets[seed] = made[key]
            yield Cell(stage, variant, sets)


def _parts(cells: tuple[Cell, ...]) -> Iterator[tuple[str, list[Cell]]]:
    """Cells that are trained and then rolled out, with a label: a run cut short has both."""
    parts: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        parts.setdefault((cell.stage.name, cell.pool, cell.variant), []).append(cell)
    for (stage, pool, variant), alike in parts.items():
        for k in range(0, len(alike), _CELLS):
            yield f"{stage}: {pool}, {variant}", alike[k : k + _CELLS]


def _trials(plan: StudyPlan, folder: Path, jobs: int, backend: str) -> PolicyTrials:
    return PolicyTrials(
        folder,
        jobs=jobs,
        backend=backend,
        max_steps=plan.max_steps,
        gives_up=plan.gives_up,
        budget_steps=plan.budget_steps,
        simulated_task=plan.simulated_task,
        topic_map=plan.topic_map,
    )


def _train_and_roll(
    trials: PolicyTrials,
    plan: StudyPlan,
    label: str,
    cells: list[Cell],
    clock: _Clock,
    log: Log,
    ticks: Ticks,
) -> list[str]:
    """Do a part of a study; returns a line for each unit that failed or was not begun."""
    problems = _train(trials, plan, cells, label, clock, log, ticks)
    return problems + _roll(trials, cells, label, clock, log, ticks)


def _train(
    trials: PolicyTrials,
    plan: StudyPlan,
    cells: list[Cell],
    label: str,
    clock: _Clock,
    log: Log,
    ticks: Ticks,
) -> list[str]:
    units = {
        cell.policies[seed]: PolicyUnit(
            set_id=made.id,
            variant=cell.variant,
            seed=seed,
            bags=made.bags,
            steps=plan.gradient_steps,
            selection=(f"{made.pool}/{made.row}", made.id),
        )
        for cell in cells
        for seed, made in cell.sets.items()
    }
    n = 0

    def tick(row: JsonObject) -> None:
        nonlocal n
        n += 1
        ticks(f"{label}: trained", n, len(units))

    with clock.measured("train", label) as fact:
        work = trials.train(list(units.values()), tick)
        fact["units"] = len(work.done)
    log(f"{label}: {len(work.done)} policies trained, {work.known} known, {len(work.failed)} not")
    return [f"policy {row['policy']}: {row['reason']}" for row in work.failed]


def _roll(
    trials: PolicyTrials, cells: list[Cell], label: str, clock: _Clock, log: Log, ticks: Ticks
) -> list[str]:
    from sim_node.tasks import start_names

    units = [
        RolloutUnit(policy, start)
        for cell in cells
        for policy in cell.policies.values()
        for start in start_names(cell.stage.starts, trials.simulated_task)
    ]
    wanted, n = len(set(units)), 0

    def tick(row: JsonObject) -> None:
        nonlocal n
        n += 1
        ticks(f"{label}: rolled out", n, wanted)

    with clock.measured("roll", label) as fact:
        work: Work = trials.roll(units, tick)
        fact["units"] = len(work.done)
        fact["steps"] = sum(int(row["steps"]) for row in work.done)
    log(
        f"{label}: {len(work.done)} rollouts done, {work.known} known, "
        f"{len(work.failed) + len(work.missing)} not"
    )
    failed = [f"rollout of {r['policy']} from {r['start']}: {r['reason']}" for r in work.failed]
    return failed + list(work.missing)


class _Clock:
    """Wall time of each part of each run, kept in a file."""

    def __init__(self, path: Path, writes: bool) -> None:
        self._path, self._writes = path, writes

    @contextmanager
    def measured(self, what: str, part: str = "") -> Iterator[JsonObject]:
        """Measure a part, and write it down if it did something; the caller may add facts."""
        row: JsonObject = {"what": what, "part": part}
        began_s = time.monotonic()
        yield row
        row["seconds"] = round(time.monotonic() - began_s, 2)
        if self._writes and row.get("units", 1):
            with named_errors(self._path):
                append_line(self._path, row)

    def all(self) -> list[JsonObject]:
        """All parts of all runs, oldest first."""
        return read_lines(self._path)
