"""The judge: trains policies and rolls them out, and never does anything twice.

Everything that was done is a line of `units.jsonl`, written and synced before the next one. A run
that was killed goes on from there; a unit that failed is tried once more by the next run.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, TypeVar

from curation_ros.batch.workers import WorkerDiedError, check_workers, in_flight, spread
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError, PolicyError
from curation_ros.core.types import Span
from curation_ros.dataset.episodes import read_episode
from curation_ros.files import append_line, named_errors, read_lines, try_lock
from policy_node.policy import Policy
from policy_node.rollouts import Rollout, rollout
from sim_node.env import process_env
from sim_node.episodes import MAX_STEPS
from sim_node.starts import start_by_name, start_names

#: Simulation steps that a study may take unless it declares another number.
BUDGET_STEPS = 4_000_000
#: Runs that try a unit before it stays failed.
ATTEMPTS = 2
# Rollouts and policies that a worker gets at once: what a kill may cost.
_ROLLOUTS, _POLICIES = 10, 8
_DIED = "its worker died (killed, or out of memory)"

Row = dict[str, Any]
Progress = Callable[[Row], None]


@dataclass(frozen=True)
class PolicyUnit:
    """A policy to train.

    Attributes:
        set_id: name of the training set; equal sets have equal names, and are trained on once.
        variant: of the observations.
        seed: of the training.
        bags: what to train on, each with the span or None for all of it.
        steps: gradient steps.
        start_jitter_m: see `policy_node.train.train`.
        selection: name and hash of the manifest, for the card.
    """

    set_id: str
    variant: str
    seed: int
    bags: tuple[tuple[Path, Span | None], ...]
    steps: int = 4000
    start_jitter_m: float = 0.0
    selection: tuple[str, str] = ("", "")

    @property
    def key(self) -> str:
        """Id of the policy."""
        return f"{self.set_id}-{self.variant}-s{self.seed}"

    @property
    def content(self) -> str:
        """Hash of all that the weights depend on; bags count by name, which is their episode."""
        bags = sorted([bag.name, list(span or ())] for bag, span in self.bags)
        text = json.dumps([bags, self.variant, self.seed, self.steps, self.start_jitter_m])
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def row(self, **result: Any) -> Row:
        """Its line of `units.jsonl`."""
        return {
            "kind": "policy",
            "policy": self.key,
            "set": self.set_id,
            "variant": self.variant,
            "seed": self.seed,
            "steps": self.steps,
            "loss": None,
            "seconds": None,
            "content": self.content,
            **result,
        }


@dataclass(frozen=True)
class RolloutUnit:
    """A rollout.

    Attributes:
        policy: id of the policy.
        start: such as official:3 or generated:7:12, or a name such as official-03.
    """

    policy: str
    start: str

    @property
    def key(self) -> tuple[str, str]:
        """What tells it from others."""
        return (self.policy, self.start)

    def row(self, **result: Any) -> Row:
        """Its line of `units.jsonl`."""
        return {"kind": "rollout", "policy": self.policy, "start": self.start, **result}


Unit = TypeVar("Unit", PolicyUnit, RolloutUnit)


@dataclass(frozen=True)
class Work:
    """What became of the units that were asked for.

    Attributes:
        done: rows of this run that succeeded.
        known: how many an earlier run had done.
        failed: the last row of each unit that failed, in this run or for good.
        missing: what was not begun, and why; a line a unit.
    """

    done: tuple[Row, ...]
    known: int
    failed: tuple[Row, ...]
    missing: tuple[str, ...]


class Judge:
    """Policies and rollouts of one study, in a folder.

    `units.jsonl` is its log, `policies/<id>` has the weights. Workers on other machines must see
    the same folder.

    Attributes:
        folder: of the study.
        max_steps: most commands of a rollout.
        gives_up: whether rollouts that are as good as lost are ended, see
            `policy_node.rollouts.GiveUp`.
        budget_steps: simulation steps that all rollouts together may take, earlier runs included.
            Steps are commands executed; the ten settling steps of a reset are none.
    """

    def __init__(
        self,
        folder: Path,
        *,
        jobs: int = 1,
        backend: str = "loky",
        max_steps: int = MAX_STEPS,
        gives_up: bool = False,
        budget_steps: int = BUDGET_STEPS,
    ) -> None:
        """Open a study, or begin one; its limits are declared in the log before anything runs.

        Args:
            folder: made where it does not exist.
            jobs: workers; 1 works in this process, -1 takes all cores.
            backend: of the workers, see `curation_ros.batch.workers`.
            max_steps: most commands of a rollout; the same for the whole study.
            gives_up: whether lost rollouts are ended; the same for the whole study.
            budget_steps: another number than before is declared anew, and stays on record.

        Raises:
            ConfigError: if a number makes no sense, or the study has another max_steps.
            CurationError: if the folder cannot be written.
        """
        check_workers(jobs, backend)
        if max_steps < 1 or budget_steps < 0:
            raise ConfigError(
                f"judge: max_steps {max_steps} and budget_steps {budget_steps}, expected at "
                "least 1 and 0"
            )
        self.folder, self.max_steps, self.budget_steps = Path(folder), max_steps, budget_steps
        self.gives_up = gives_up
        self._jobs, self._backend = jobs, backend
        self._log = self.folder / "units.jsonl"
        declared = [row for row in read_lines(self._log) if row.get("kind") == "declaration"]
        limits = {"max_steps": max_steps, "gives_up": gives_up, "budget_steps": budget_steps}
        for key in ("max_steps", "gives_up") if declared else ():
            if declared[-1].get(key, False) != limits[key]:
                raise ConfigError(
                    f"{self._log}: rollouts of this study have {key} "
                    f"{declared[-1].get(key, False)}, not {limits[key]}"
                )
        if not declared or declared[-1]["budget_steps"] != budget_steps:
            self._append({"kind": "declaration", **limits})

    def rows(self, kind: str) -> list[Row]:
        """Lines of the log, `policy` or `rollout`, oldest first; failed attempts included."""
        return [row for row in read_lines(self._log) if row.get("kind") == kind]

    def policy_folder(self, policy_id: str) -> Path:
        """Where a policy is kept."""
        return self.folder / "policies" / policy_id

    @property
    def used_steps(self) -> int:
        """Simulation steps of all rollouts so far; of one whose worker died, max_steps."""
        return sum(int(row["steps"]) for row in self.rows("rollout"))

    def train(self, units: Sequence[PolicyUnit], progress: Progress | None = None) -> Work:
        """Train the policies that are not there yet.

        Args:
            units: in order; a policy that is named twice is trained once.
            progress: called with every row as it is logged.

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
            rows = self._run(_train, tasks, {}, progress)
            return past.work(units, rows, ())

    def roll(self, units: Sequence[RolloutUnit], progress: Progress | None = None) -> Work:
        """Roll policies out that were trained, as far as the budget goes.

        A unit is begun only where the budget would bear max_steps of it after all units before
        it; so which ones are done does not depend on the workers.

        Args:
            units: in order; one that is named twice is done once.
            progress: called with every row as it is logged.

        Raises:
            ConfigError: if a start makes no sense.
            CurationError: if the log cannot be written, or another process runs this study.
        """
        units = list({unit.key: unit for unit in units}.values())
        for start in {unit.start for unit in units}:
            start_name(start)
        with self._alone():
            past = _Past(self.rows("rollout"), lambda row: (row["policy"], row["start"]))
            trained = {row["policy"] for row in self.rows("policy") if row["status"] == "ok"}
            missing = [
                f"rollout of {unit.policy} from {unit.start}: there is no such policy"
                for unit in units
                if unit.policy not in trained and unit.key not in past.done
            ]
            todo = [unit for unit in past.todo(units) if unit.policy in trained]
            used, rows = self.used_steps, list[Row]()
            # Each pass begins what the budget bears whatever happens, and the next one what is
            # left of it.
            while todo and (n := (self.budget_steps - used) // self.max_steps) > 0:
                now, todo = todo[:n], todo[n:]
                groups = groupby(now, key=lambda unit: unit.policy)
                tasks = [part for _, group in groups for part in _parts(list(group), _ROLLOUTS)]
                settings = {"max_steps": self.max_steps, "gives_up": self.gives_up}
                fresh = self._run(_roll, tasks, settings, progress)
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
        function: Callable[..., list[Row]],
        tasks: Sequence[Sequence[Unit]],
        settings: Row,
        progress: Progress | None,
    ) -> list[Row]:
        """Do tasks, units each, and log every row; a unit whose worker died has failed."""
        waiting: dict[int, Sequence[Unit]] = dict(enumerate(tasks))
        logged: list[Row] = []

        def finish(k: int, rows: Iterable[Row]) -> None:
            del waiting[k]
            for row in rows:
                self._append(row)
                logged.append(row)
                if progress is not None:
                    progress(row)

        def done(
            chosen: Iterable[tuple[int, Sequence[Unit]]], jobs: int
        ) -> Iterator[tuple[int, list[Row]]]:
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
                # One of those that were handed out has killed it: each unit of them alone shows
                # which. Two workers, so that it is not done in this process.
                n = in_flight(self._n_workers, self._backend, ray_ahead=1)
                for k, units in list(waiting.items())[:n]:
                    found: list[Row] = []
                    for unit in units:
                        try:
                            found += [row for _, rows in done([(k, [unit])], 2) for row in rows]
                        except WorkerDiedError:
                            found.append(_died(unit, settings))
                    finish(k, found)
        return logged

    # --- the log ----------------------------------------------------------------------------

    def _append(self, row: Row) -> None:
        with named_errors(self._log):
            append_line(self._log, row)

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Two processes at once would do the same units."""
        with named_errors(self._log):
            lock = try_lock(self.folder / ".judge.lock")
        if lock is None:
            raise CurationError(f"{self.folder}: another process runs this study")
        with lock:
            yield


class _Past:
    """What the log says about units of one kind."""

    def __init__(self, rows: Iterable[Row], key: Callable[[Row], Any]) -> None:
        self._key = key
        self.last: dict[Any, Row] = {}
        self._failures: dict[Any, int] = {}
        for row in rows:
            self.last[key(row)] = row
            self._failures[key(row)] = self._failures.get(key(row), 0) + (row["status"] != "ok")
        self.done = {k for k, row in self.last.items() if row["status"] == "ok"}

    def todo(self, units: Iterable[Unit]) -> list[Unit]:
        """Units that were never done, or failed less often than they are tried."""
        return [
            unit
            for unit in units
            if unit.key not in self.done and self._failures.get(unit.key, 0) < ATTEMPTS
        ]

    def work(self, units: Sequence[Unit], rows: Sequence[Row], missing: Iterable[str]) -> Work:
        """The report, with the rows of this run."""
        last = {**self.last, **{self._key(row): row for row in rows}}
        found = (last.get(unit.key) for unit in units)
        return Work(
            done=tuple(row for row in rows if row["status"] == "ok"),
            known=sum(unit.key in self.done for unit in units),
            failed=tuple(row for row in found if row is not None and row["status"] != "ok"),
            missing=tuple(missing),
        )


def start_name(start: str) -> str:
    """Name of a start as `Start` has it, for official:3 and generated:7:12, too.

    Raises:
        ConfigError: if it is no single start.
    """
    if found := re.fullmatch(r"(official|generated:[0-9]{1,9}):([0-9]{1,9})", start):
        [name] = start_names(f"{found[1]}:{found[2]}:{int(found[2]) + 1}")
        return name
    if re.fullmatch(r"official-[0-4][0-9]|generated-[0-9]{1,9}-[0-9]{3,9}", start):
        return start
    raise ConfigError(
        f"start {start!r} is none; expected official:3, generated:7:12 or a name of a start"
    )


def roll_policy(policy: Path, start: str, max_steps: int) -> Rollout:
    """One rollout, in the environment of this process.

    Args:
        policy: folder of the policy.
        start: its name.
        max_steps: most commands.

    Raises:
        ConfigError, PolicyError, SimError: as `policy_node.rollouts.rollout` does.
    """
    return rollout(process_env(), start_by_name(start), Policy.load(policy), max_steps)


# --- what workers do ----------------------------------------------------------------------------


def _numbered(
    function: Callable[..., list[Row]], k: int, folder: Path, units: Sequence[Unit], settings: Row
) -> tuple[int, list[Row]]:
    return k, function(folder, units, **settings)


def _roll(folder: Path, units: Sequence[RolloutUnit], max_steps: int, gives_up: bool) -> list[Row]:
    """Rollouts of one policy."""
    rows = []
    for unit in units:
        steps = 0
        try:
            policy = Policy.load(folder / "policies" / unit.policy)
            start = start_by_name(start_name(unit.start))
            try:
                made = rollout(process_env(), start, policy, max_steps, gives_up=gives_up)
            except CurationError:
                steps = max(0, process_env().n_steps)
                raise
        except CurationError as err:
            ended = {"success": False, "steps": steps, "stage": "", "ended": ""}
            rows.append(unit.row(**ended, status="failed", reason=str(err)))
        else:
            how = {key: getattr(made, key) for key in ("success", "steps", "stage", "ended")}
            rows.append(unit.row(**how, status="ok", reason=""))
    return rows


def _train(folder: Path, units: Sequence[PolicyUnit]) -> list[Row]:
    """Policies of one variant and equal settings, as one computation."""
    # Only here: torch takes a second to load, and rollouts need none of it.
    from policy_node.batch_training import FailedTraining, TrainingJob, train_many

    rows: dict[str, Row] = {}
    jobs = []
    episodes: dict[Path, Episode] = {}
    for unit in units:
        if (row := _adopted(folder, unit)) is not None:
            rows[unit.key] = row
            continue
        try:
            for bag, _ in unit.bags:
                if bag not in episodes:
                    episodes[bag] = read_episode(bag)
        except CurationError as err:
            rows[unit.key] = unit.row(status="failed", reason=str(err))
            continue
        chosen = [(episodes[bag], span) for bag, span in unit.bags]
        jobs.append(TrainingJob(unit.key, chosen, unit.seed, unit.variant, unit.selection))
    by_key = {unit.key: unit for unit in units}
    steps, start_jitter_m = units[0].steps, units[0].start_jitter_m
    try:
        trained = train_many(jobs, steps=steps, start_jitter_m=start_jitter_m)
        for job, made in zip(jobs, trained, strict=True):
            unit = by_key[job.key]
            if isinstance(made, FailedTraining):
                rows[job.key] = unit.row(status="failed", reason=made.reason)
                continue
            try:
                made.policy.save(folder / "policies" / job.key)
            except PolicyError as err:
                failed = unit.row(status="failed", reason=str(err))
                rows[job.key] = _adopted(folder, unit) or failed
            else:
                figures = {"loss": made.loss, "seconds": made.seconds}
                rows[job.key] = unit.row(**figures, status="ok", reason="")
    except PolicyError as err:  # a setting that all of them share
        for job in jobs:
            rows.setdefault(job.key, by_key[job.key].row(status="failed", reason=str(err)))
    return [rows[unit.key] for unit in units]


def _adopted(folder: Path, unit: PolicyUnit) -> Row | None:
    """Row of a policy that was saved, but not logged before its run was killed."""
    with suppress(PolicyError):
        card = Policy.load(folder / "policies" / unit.key).card
        trained_on = sorted((str(e["id"]), tuple(e["span"] or ())) for e in card.episodes)
        wanted = sorted((bag.name, span or ()) for bag, span in unit.bags)
        settings = (card.variant, card.seed, card.steps, card.start_jitter_m)
        asked = (unit.variant, unit.seed, unit.steps, unit.start_jitter_m)
        if trained_on == wanted and settings == asked:
            figures = {"loss": card.curve[-1][1], "seconds": card.seconds}
            return unit.row(**figures, status="ok", reason="")
    return None


def _died(unit: PolicyUnit | RolloutUnit, settings: Row) -> Row:
    if isinstance(unit, PolicyUnit):
        return unit.row(status="failed", reason=_DIED)
    ended = {"success": False, "steps": settings["max_steps"], "stage": "", "ended": ""}
    return unit.row(**ended, status="failed", reason=_DIED)


def _parts(units: list[Unit], size: int) -> list[list[Unit]]:
    return [units[k : k + size] for k in range(0, len(units), size)]
