"""Runs a study: collects, scores, trains and rolls out what its plan says and is not done yet."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from curation_ros.core.episode.episode import Episode
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
from curation_ros.study.units import PolicyUnit, RolloutUnit, Row

Said = Callable[[str], None]
#: What is told of a unit that was done: which stage, what kind, how many of how many.
Ticked = Callable[[str, int, int], None]
# Training sets that are trained on before they are rolled out.
_CELLS = 16


@dataclass(frozen=True)
class Cell:
    """A training set with a variant of the observations in a stage, and its policies.

    Attributes:
        stage: of the plan.
        variant: of the observations.
        sets: training seed -> what its policy learns from: the same for all, but for controls
            that are drawn anew for each seed.
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
        """What the plan calls the training set."""
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
    """A study as far as it has come.

    Attributes:
        plan: of it.
        trials: its policies and rollouts.
        pools: by name, scored.
        reference: trusted demonstrations.
        cells: all of the plan, in its order.
        problems: what failed or was not begun, a line each.
        seconds: what took how long, in all runs so far.
        n_reference: trusted demonstrations, how many.
        timelines: id -> demonstration, its phases and stamps alone.
    """

    plan: StudyPlan
    trials: PolicyTrials
    pools: Mapping[str, Pool]
    reference: Dataset
    cells: tuple[Cell, ...]
    problems: tuple[str, ...]
    seconds: tuple[Row, ...]
    n_reference: int
    timelines: Mapping[str, Episode] = field(default_factory=dict)


def run_study(
    plan: StudyPlan,
    folder: Path,
    data: Path,
    *,
    jobs: int = 1,
    backend: str = "loky",
    said: Said = lambda text: None,
    ticked: Ticked = lambda what, done, of: None,
    work: bool = True,
    stages: Sequence[str] = (),
) -> Study:
    """Do what a plan says and an earlier run has not done.

    Args:
        plan: what to do.
        folder: of the study: policies, `units.jsonl`, `seconds.jsonl`.
        data: where the datasets are, or are collected; studies may share them.
        jobs: workers.
        backend: of the workers.
        said: called with a line about each part.
        ticked: called as units are done.
        work: whether to train and roll out; False: only take stock.
        stages: those to do, and to take stock of; none: all.

    Raises:
        ConfigError: if the plan makes no sense or is not the one that the folder was begun with.
        CurationError: if a dataset cannot be completed or scored, or a file cannot be written.
    """
    check_starts(plan)
    if stages:
        plan = plan.only(stages)
    clock = _Clock(folder / "seconds.jsonl", notes=work)
    with clock.measured("collect") as fact:
        datasets, fact["units"] = collect_datasets(
            data, plan, jobs=jobs, backend=backend, said=said
        )
    reference = read_all_episodes(datasets["reference"], "reference")
    timelines = {e.id: timeline_of(e) for e in reference}
    if "more" in datasets:
        further = read_all_episodes(datasets["more"], "more")
        timelines |= {e.id: timeline_of(e) for e in further}
    pools = {}
    with clock.measured("score and audit"):
        for name in plan.pools:
            pools[name] = score_pool(name, datasets[name], reference, plan)
            timelines |= pools[name].timelines
            said(f"pool {name}: {len(plan.scorers)} scorers, {pools[name].facts['n']} scored")
    trials = PolicyTrials(
        folder,
        jobs=jobs,
        backend=backend,
        max_steps=plan.max_steps,
        gives_up=plan.gives_up,
        budget_steps=plan.budget_steps,
    )
    cells = tuple(_cells(plan, pools, datasets["reference"], datasets.get("more")))
    said(
        f"{len(cells)} cells, {len({p for c in cells for p in c.policies.values()})} policies; "
        f"{trials.used_steps} of {plan.budget_steps} simulation steps are used"
    )
    found: list[str] = []
    for label, part in _parts(cells) if work else ():
        found += _train(trials, plan, part, label, clock, said, ticked)
        found += _roll(trials, part, label, clock, said, ticked)
    return Study(
        plan=plan,
        trials=trials,
        pools=pools,
        reference=datasets["reference"],
        cells=cells,
        problems=tuple(dict.fromkeys(found)),
        seconds=tuple(clock.all()),
        n_reference=len(reference),
        timelines=timelines,
    )


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
    """Cells that are trained and then rolled out, and what they are: a run cut short has both."""
    parts: dict[tuple[str, str, str], list[Cell]] = {}
    for cell in cells:
        parts.setdefault((cell.stage.name, cell.pool, cell.variant), []).append(cell)
    for (stage, pool, variant), alike in parts.items():
        for k in range(0, len(alike), _CELLS):
            yield f"{stage}: {pool}, {variant}", alike[k : k + _CELLS]


def _train(
    trials: PolicyTrials,
    plan: StudyPlan,
    cells: list[Cell],
    label: str,
    clock: _Clock,
    said: Said,
    ticked: Ticked,
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

    def tick(row: Row) -> None:
        nonlocal n
        n += 1
        ticked(f"{label}: trained", n, len(units))

    with clock.measured("train", label) as fact:
        work = trials.train(list(units.values()), tick)
        fact["units"] = len(work.done)
    said(f"{label}: {len(work.done)} policies trained, {work.known} known, {len(work.failed)} not")
    return [f"policy {row['policy']}: {row['reason']}" for row in work.failed]


def _roll(
    trials: PolicyTrials, cells: list[Cell], label: str, clock: _Clock, said: Said, ticked: Ticked
) -> list[str]:
    from sim_node.starts import start_names

    units = [
        RolloutUnit(policy, start)
        for cell in cells
        for policy in cell.policies.values()
        for start in start_names(cell.stage.starts)
    ]
    wanted, n = len(set(units)), 0

    def tick(row: Row) -> None:
        nonlocal n
        n += 1
        ticked(f"{label}: rolled out", n, wanted)

    with clock.measured("roll", label) as fact:
        work: Work = trials.roll(units, tick)
        fact["units"] = len(work.done)
        fact["steps"] = sum(int(row["steps"]) for row in work.done)
    said(
        f"{label}: {len(work.done)} rollouts done, {work.known} known, "
        f"{len(work.failed) + len(work.missing)} not"
    )
    failed = [f"rollout of {r['policy']} from {r['start']}: {r['reason']}" for r in work.failed]
    return failed + list(work.missing)


class _Clock:
    """Wall time of each part of each run, in a file."""

    def __init__(self, path: Path, notes: bool) -> None:
        self._path, self._notes = path, notes

    @contextmanager
    def measured(self, what: str, part: str = "") -> Iterator[Row]:
        """Measure a part, and note it where it has done something; facts may be added."""
        row: Row = {"what": what, "part": part}
        began_s = time.monotonic()
        yield row
        row["seconds"] = round(time.monotonic() - began_s, 2)
        if self._notes and row.get("units", 1):
            with named_errors(self._path):
                append_line(self._path, row)

    def all(self) -> list[Row]:
        """What was noted, oldest first."""
        return read_lines(self._path)
