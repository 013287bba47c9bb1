"""The trials of a study: policies are trained and rolled out, within a budget, each once.

Each result is a line of `units.jsonl`, written and synced before the next one. A run that was
killed continues from there. A unit that failed is tried once more by the next run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from curation_ros.batch.workers import WorkerDiedError, check_workers, in_flight, spread
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import JsonObject
from curation_ros.files import append_line, named_errors, read_lines, try_lock
from curation_ros.study.plan import StudyPlan
from curation_ros.study.unit_work import roll_units, train_units
from curation_ros.study.units import PolicyUnit, Progress, RolloutUnit, Unit, start_name
from sim_node.settings import MAX_STEPS, SIMULATED_TASK

#: Runs that try a unit before it stays failed.
ATTEMPTS = 2
# Rollouts and policies that a worker gets at once: all of them are lost if it is killed.
_ROLLOUTS, _POLICIES = 10, 8
_DIED = "its worker died (killed, or out of memory)"


@dataclass(frozen=True)
class Work:
    """Results for the units that were asked for.

    Attributes:
        done: rows of this run that succeeded.
        known: how many an earlier run had done.
        failed: the last row of each unit that failed, in this run or for good.
        missing: what was not begun, and why; one line per unit.
    """

    done: tuple[JsonObject, ...]
    known: int
    failed: tuple[JsonObject, ...]
    missing: tuple[str, ...]


class PolicyTrials:
    """Trains and rolls out the policies of one study, in a folder.

    `units.jsonl` is its log, `policies/<id>` has the weights. Workers on other machines must see
    the same folder.

    Attributes:
        folder: of the study.
        max_steps: most commands per rollout.
        gives_up: whether a rollout that is as good as lost is ended early, see
            `policy_node.rollouts.GiveUp`.
        budget_steps: simulation steps that all rollouts together may take, earlier runs included.
            Steps are commands executed; the ten settling steps of a reset do not count.
        simulated_task: the task of all rollouts, a key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map of all rollouts; empty: the default one.
    """

    def __init__(
        self,
        folder: Path,
        *,
        jobs: int = 1,
        backend: str = "loky",
        max_steps: int = MAX_STEPS,
        gives_up: bool = False,
        budget_steps: int = StudyPlan.budget_steps,
        simulated_task: str = SIMULATED_TASK,
        topic_map: str = "",
    ) -> None:
        """Open or begin a study; its limits are declared in the log before anything runs.

        Args:
            folder: made if it does not exist.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: of the workers, see `curation_ros.batch.workers`.
            max_steps: most commands per rollout; the same for the whole study.
            gives_up: whether lost rollouts are ended early; the same for the whole study.
            budget_steps: another number than before is declared anew, and stays on record.
            simulated_task: the task of all rollouts; the same for the whole study.
            topic_map: YAML file of the topic map of all rollouts; empty: the default one.

        Raises:
            ConfigError: if a number is out of range, or the study has other limits.
            CurationError: if the folder cannot be written.
        """
        check_workers(jobs, backend)
        if max_steps < 1 or budget_steps < 0:
            raise ConfigError(
                f"study: max_steps {max_steps} and budget_steps {budget_steps}, expected at "
                "least 1 and 0"
            )
        self.folder, self.max_steps, self.budget_steps = Path(folder), max_steps, budget_steps
        self.gives_up, self.simulated_task, self.topic_map = gives_up, simulated_task, topic_map
        self._jobs, self._backend = jobs, backend
        self._log = self.folder / "units.jsonl"
        declared = [row for row in read_lines(self._log) if row.get("kind") == "declaration"]
        limits = {
            "max_steps": max_steps,
            "gives_up": gives_up,
            "budget_steps": budget_steps,
            "simulated_task": simulated_task,
        }
        # Old logs declare neither.
        before = {"gives_up": False, "simulated_task": SIMULATED_TASK}
        before |= declared[-1] if declared else limits
        for key in ("max_steps", "gives_up", "simulated_task"):
            if before[key] != limits[key]:
                raise ConfigError(
                    f"{self._log}: rollouts of this study have {key} {before[key]}, "
                    f"not {limits[key]}"
                )
        if not declared or declared[-1]["budget_steps"] != budget_steps:
            self._append({"kind": "declaration", **limits})

    def rows(self, kind: str) -> list[JsonObject]:
        """Lines of the log, `policy` or `rollout`, oldest first; failed attempts included."""
        return [row for row in read_lines(self._log) if row.get("kind") == kind]

    @property
    def used_steps(self) -> int:
        """Simulation steps of all rollouts so far; max_steps where the worker died."""
        return sum(int(row["steps"]) for row in self.rows("rollout"))

    def train(self, units: Sequence[PolicyUnit], progress: Progress | None = None) -> Work:
        """Train the policies that do not exist yet.

        Args:
            units: in order; a policy that is named twice is trained once.
            progress: called with each row when it is logged.

        Raises:
            ConfigError: if a policy of the same id was trained on something else.
            CurationError: if the log cannot be written, or another process runs this study.
        """
        units = list({unit.key: unit for unit in units}.values())
        with self._alone():
            past = _Past(self.rows("policy"), lambda row: row["policy"])
            for unit in units:
                found = past.last.get(unit.key)
                if found is not None and found["content"] != unit.content:
                    raise ConfigError(
                        f"{self._log}: policy {unit.key} was trained on other bags or with other "
                        "settings: name the set otherwise"
                    )
            todo = past.todo(units)
            # Workers get about as much each; policies of one variant are computed together.
            rounds = max(1, -(-len(todo) // (_POLICIES * self._n_workers)))
            size = max(1, -(-len(todo) // (rounds * self._n_workers)))
            alike = sorted(todo, key=lambda u: (u.variant, u.steps, u.start_jitter_m))
            groups = groupby(alike, key=lambda u: (u.variant, u.steps, u.start_jitter_m))
            tasks = [part for _, group in groups for part in _parts(list(group), size)]
            rows = self._run(train_units, tasks, {}, progress)
            return past.work(units, rows, ())

    def roll(self, units: Sequence[RolloutUnit], progress: Progress | None = None) -> Work:
        """Roll out policies that were trained, as far as the budget goes.

        A unit is begun only if the budget has max_steps left after all units before it. So the
        number of workers does not change which units are done.

        Args:
            units: in order; a rollout that is named twice is done once.
            progress: called with each row when it is logged.

        Raises:
            ConfigError: if a start is none.
            CurationError: if the log cannot be written, or another process runs this study.
        """
        units = list({unit.key: unit for unit in units}.values())
        for start in {unit.start for unit in units}:
            start_name(start, self.simulated_task)
        with self._alone():
            past = _Past(self.rows("rollout"), lambda row: (row["policy"], row["start"]))
            trained = {row["policy"] for row in self.rows("policy") if row["status"] == "ok"}
            missing = [
                f"rollout of {unit.policy} from {unit.start}: there is no such policy"
                for unit in units
                if unit.policy not in trained and unit.key not in past.done
            ]
            todo = [unit for unit in past.todo(units) if unit.policy in trained]
            used, rows = self.used_steps, list[JsonObject]()
            # Each pass begins as many units as the budget allows in the worst case, and the next
            # pass takes what they have left of it.
            while todo and (n := (self.budget_steps - used) // self.max_steps) > 0:
                now, todo = todo[:n], todo[n:]
                groups = groupby(now, key=lambda unit: unit.policy)
                tasks = [part for _, group in groups for part in _parts(list(group), _ROLLOUTS)]
                settings = {
                    "max_steps": self.max_steps,
                    "gives_up": self.gives_up,
                    "simulated_task": self.simulated_task,
                    "topic_map": self.topic_map,
                }
                fresh = self._run(roll_units, tasks, settings, progress)
                rows += fresh
                used += sum(int(row["steps"]) for row in fresh)
            missing += [
                f"rollout of {unit.policy} from {unit.start}: {used} of {self.budget_steps} steps "
                f"are used, and it may take {self.max_steps}"
                for unit in todo
            ]
            return past.work(units, rows, missing)

    # --- workers ----------------------------------------------------------------------------

    @property
    def _n_workers(self) -> int:
        from joblib import effective_n_jobs

        return int(effective_n_jobs(self._jobs)) if self._jobs < 0 else self._jobs

    def _run(
        self,
        function: Callable[..., list[JsonObject]],
        tasks: Sequence[Sequence[Unit]],
        settings: JsonObject,
        progress: Progress | None,
    ) -> list[JsonObject]:
        """Do tasks of several units each, and log each row; units of a dead worker have failed."""
        waiting: dict[int, Sequence[Unit]] = dict(enumerate(tasks))
        logged: list[JsonObject] = []

        def finish(k: int, rows: Iterable[JsonObject]) -> None:
            del waiting[k]
            for row in rows:
                self._append(row)
                logged.append(row)
                if progress is not None:
                    progress(row)

        def done(
            chosen: Iterable[tuple[int, Sequence[Unit]]], jobs: int
        ) -> Iterator[tuple[int, list[JsonObject]]]:
            return spread(
                _numbered,
                [(function, k, self.folder, units, settings) for k, units in chosen],
                jobs=jobs,
                backend=self._backend,
                in_order=False,
                ray_ahead=1,
            )

        while waiting:
            try:
                for k, rows in done(waiting.items(), self._jobs):
                    finish(k, rows)
            except WorkerDiedError:
                # One unit of those that were handed out has killed its worker. Each of them runs
                # alone to find out which; with two workers, so that it is not in this process.
                n = in_flight(self._n_workers, self._backend, ray_ahead=1)
                for k, units in list(waiting.items())[:n]:
                    found: list[JsonObject] = []
                    for unit in units:
                        try:
                            found += [row for _, rows in done([(k, [unit])], 2) for row in rows]
                        except WorkerDiedError:
                            found.append(_died(unit, settings))
                    finish(k, found)
        return logged

    # --- the log ----------------------------------------------------------------------------

    def _append(self, row: JsonObject) -> None:
        with named_errors(self._log):
            append_line(self._log, row)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Two processes at once would do the same units."""
        with named_errors(self._log):
            lock = try_lock(self.folder / ".trials.lock")
        if lock is None:
            raise CurationError(f"{self.folder}: another process runs this study")
        with lock:
            yield


class _Past:
    """Units of one kind as the log has them."""

    def __init__(self, rows: Iterable[JsonObject], key: Callable[[JsonObject], Any]) -> None:
        self._key = key
        self.last: dict[Any, JsonObject] = {}
        self._failures: dict[Any, int] = {}
        for row in rows:
            self.last[key(row)] = row
            self._failures[key(row)] = self._failures.get(key(row), 0) + (row["status"] != "ok")
        self.done = {k for k, row in self.last.items() if row["status"] == "ok"}

    def todo(self, units: Iterable[Unit]) -> list[Unit]:
        """Units that were never done, and failed fewer than ATTEMPTS times."""
        return [
            unit
            for unit in units
            if unit.key not in self.done and self._failures.get(unit.key, 0) < ATTEMPTS
        ]

    def work(
        self, units: Sequence[Unit], rows: Sequence[JsonObject], missing: Iterable[str]
    ) -> Work:
        """The report, with the rows of this run."""
        last = {**self.last, **{self._key(row): row for row in rows}}
        found = (last.get(unit.key) for unit in units)
        return Work(
            done=tuple(row for row in rows if row["status"] == "ok"),
            known=sum(unit.key in self.done for unit in units),
            failed=tuple(row for row in found if row is not None and row["status"] != "ok"),
            missing=tuple(missing),
        )


def _numbered(
    function: Callable[..., list[JsonObject]],
    k: int,
    folder: Path,
    units: Sequence[Unit],
    settings: JsonObject,
) -> tuple[int, list[JsonObject]]:
    return k, function(folder, units, **settings)


def _died(unit: PolicyUnit | RolloutUnit, settings: JsonObject) -> JsonObject:
    if isinstance(unit, PolicyUnit):
        return unit.row(status="failed", reason=_DIED)
    ended = {"success": False, "steps": settings["max_steps"], "stage": "", "ended": ""}
    return unit.row(**ended, status="failed", reason=_DIED)


def _parts(units: list[Unit], size: int) -> list[list[Unit]]:
    return [units[k : k + size] for k in range(0, len(units), size)]
