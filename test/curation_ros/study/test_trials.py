"""Trials of a study: nothing is done twice or lost, and one failure stops no other unit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from streams import record

from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset

pytestmark = [pytest.mark.sim, pytest.mark.policy]
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from curation_ros.study.trials import PolicyTrials  # noqa: E402 - needs LIBERO
from curation_ros.study.unit_work import policy_folder  # noqa: E402 - needs LIBERO
from curation_ros.study.units import PolicyUnit, RolloutUnit, start_name  # noqa: E402 - needs LIBERO
from policy_node.policy import load_policy  # noqa: E402 - as above

MAX_STEPS = 6
STARTS = ("generated:5:0", "generated:5:1", "generated-5-002")


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    dataset = Dataset(tmp_path_factory.mktemp("bags"), create=True)
    rng = np.random.default_rng(20260608)
    return tuple(record(dataset, make_episode(rng, name=f"pick-{k}")) for k in range(3))


@pytest.fixture
def units(bags: tuple[Path, ...]) -> list[PolicyUnit]:
    """Two sets, two seeds each."""
    chosen = {"all": bags, "few": bags[:1]}
    return [
        PolicyUnit(name, "relative", seed, tuple((bag, None) for bag in some), steps=5)
        for name, some in chosen.items()
        for seed in (0, 7)
    ]


def rollouts(units: list[PolicyUnit], starts: tuple[str, ...] = STARTS) -> list[RolloutUnit]:
    return [RolloutUnit(unit.key, start) for unit in units for start in starts]


def trials(folder: Path, **options: Any) -> PolicyTrials:
    return PolicyTrials(folder, max_steps=MAX_STEPS, **options)


def results(made: PolicyTrials, kind: str) -> dict[Any, Any]:
    """Key -> row without what differs from run to run; every unit stands in the log once."""
    rows = made.rows(kind)
    found = {(row["policy"], row.get("start")): {**row, "seconds": 0} for row in rows}
    assert len(found) == len(rows)
    return found


@pytest.fixture
def study(tmp_path: Path, units: list[PolicyUnit]) -> PolicyTrials:
    """Whose policies are trained."""
    made = trials(tmp_path / "study")
    assert made.train(units).failed == ()
    return made


# --- work ---------------------------------------------------------------------------------------


def test_rows_say_what_was_done(study: PolicyTrials, units: list[PolicyUnit]) -> None:
    work = study.roll(rollouts(units))
    assert (len(work.done), work.known, work.failed, work.missing) == (12, 0, (), ())
    first = study.rows("policy")[0]
    assert first["policy"] == "all-relative-s0"
    assert {key: first[key] for key in ("set", "variant", "seed", "steps", "status")} == {
        "set": "all",
        "variant": "relative",
        "seed": 0,
        "steps": 5,
        "status": "ok",
    }
    assert first["loss"] > 0.0
    assert load_policy(policy_folder(study.folder, first["policy"])).card.seed == 0
    row = study.rows("rollout")[0]
    assert set(row) == {
        *("kind", "policy", "start", "success", "steps", "stage", "ended", "status", "reason")
    }
    assert (row["policy"], row["start"]) == ("all-relative-s0", STARTS[0])
    assert (row["success"], row["steps"], row["status"]) == (False, MAX_STEPS, "ok")
    assert study.used_steps == 12 * MAX_STEPS


def test_nothing_is_done_twice(study: PolicyTrials, units: list[PolicyUnit]) -> None:
    half = rollouts(units)[:5]
    assert len(study.roll(half).done) == 5
    log = (study.folder / "units.jsonl").read_bytes()
    again = trials(study.folder)
    work = again.train([*units, *units])
    assert (work.done, work.known) == ((), 4)
    assert again.roll(half).known == 5
    assert (study.folder / "units.jsonl").read_bytes() == log
    assert len(again.roll(rollouts(units)).done) == 7
    assert len(results(again, "rollout")) == 12


@pytest.mark.parametrize("backend", ["loky", "ray"])
def test_workers_give_the_same_rows(
    study: PolicyTrials, units: list[PolicyUnit], tmp_path: Path, backend: str
) -> None:
    """A real local Ray cluster among them."""
    pytest.importorskip(backend if backend == "ray" else "joblib")
    study.roll(rollouts(units))
    spread = trials(tmp_path / "spread", jobs=2, backend=backend)
    assert spread.train(units).failed == ()
    assert spread.roll(rollouts(units)).failed == ()
    for kind in ("policy", "rollout"):
        assert results(spread, kind) == results(study, kind)


def test_policy_of_other_bags_or_settings_is_refused(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    for changed in (replace(units[0], bags=units[2].bags), replace(units[0], steps=6)):
        with pytest.raises(ConfigError, match="all-relative-s0 was trained on other bags"):
            study.train([changed])


# --- budget -------------------------------------------------------------------------------------


@pytest.mark.parametrize("jobs", [1, 2])
def test_budget_is_kept_and_what_is_missing_is_named(
    study: PolicyTrials, units: list[PolicyUnit], jobs: int
) -> None:
    tight = trials(study.folder, jobs=jobs, budget_steps=5 * MAX_STEPS + 1)
    asked = rollouts(units)
    work = tight.roll(asked)
    # In whatever order the workers end: the first five of what was asked.
    done = sorted((row["policy"], row["start"]) for row in work.done)
    assert done == sorted(u.key for u in asked[:5])
    assert len(work.missing) == 7
    assert work.missing[0] == (
        f"rollout of {asked[5].policy} from {asked[5].start}: 30 of 31 steps are used, "
        "and it may take 6"
    )
    assert tight.roll(asked).known == 5  # earlier runs count
    more = trials(study.folder, budget_steps=1000)
    assert len(more.roll(asked).done) == 7
    declared = [row["budget_steps"] for row in more.rows("declaration")]
    assert declared == [4_000_000, 31, 1000]


def test_limits_of_a_study_stay(study: PolicyTrials) -> None:
    with pytest.raises(ConfigError, match="max_steps 6, not 7"):
        PolicyTrials(study.folder, max_steps=7)
    with pytest.raises(ConfigError, match="budget_steps -1"):
        trials(study.folder, budget_steps=-1)
    with pytest.raises(ConfigError, match="simulated_task bowl_on_plate, not bowl_from_center"):
        trials(study.folder, simulated_task="bowl_from_center")


def test_log_from_before_tasks_had_names_is_of_the_first_task(tmp_path: Path) -> None:
    old = {"kind": "declaration", "max_steps": MAX_STEPS, "budget_steps": 4_000_000}
    (tmp_path / "units.jsonl").write_text(json.dumps(old) + "\n")
    assert trials(tmp_path).rows("declaration") == [old]
    with pytest.raises(ConfigError, match="simulated_task bowl_on_plate, not bowl_from_center"):
        trials(tmp_path, simulated_task="bowl_from_center")


# --- failures -----------------------------------------------------------------------------------


def test_failed_training_is_named_and_tried_once_more(
    tmp_path: Path, units: list[PolicyUnit], bags: tuple[Path, ...]
) -> None:
    lost = replace(units[0], set_id="lost", bags=((bags[0].parent / "nobody", None),))
    diverging = replace(units[0], set_id="diverging", start_jitter_m=1e60)
    wanted = [lost, diverging, *units]
    study = trials(tmp_path / "study")
    work = study.train(wanted)
    assert len(work.done) == 4
    reasons = {row["set"]: row["reason"] for row in work.failed}
    assert set(reasons) == {"lost", "diverging"}
    assert "nobody" in reasons["lost"]
    assert "loss is nan" in reasons["diverging"] or "loss is inf" in reasons["diverging"]
    for attempts in (2, 2):
        work = study.train(wanted)
        assert (work.known, len(work.failed)) == (4, 2)
        assert sum(row["set"] == "lost" for row in study.rows("policy")) == attempts
    missing = study.roll(rollouts([lost], STARTS[:1])).missing
    assert missing == (f"rollout of lost-relative-s0 from {STARTS[0]}: there is no such policy",)


def test_failed_rollout_is_named_and_the_rest_goes_on(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    spoilt = policy_folder(study.folder, units[1].key) / "policy.safetensors"
    whole = spoilt.read_bytes()
    spoilt.write_bytes(whole[:-8])
    work = study.roll(rollouts(units, STARTS[:1]))
    assert (len(work.done), len(work.failed)) == (3, 1)
    assert work.failed[0]["policy"] == units[1].key
    assert "policy.safetensors" in work.failed[0]["reason"]
    spoilt.write_bytes(whole)
    work = study.roll(rollouts(units, STARTS[:1]))
    assert [row["policy"] for row in work.done] == [units[1].key]
    assert (work.known, work.failed) == (3, ())


def test_diverged_simulation_fails_its_rollout_and_its_steps_count(
    study: PolicyTrials, units: list[PolicyUnit], monkeypatch: pytest.MonkeyPatch
) -> None:
    from sim_node.settings import SIMULATED_TASK
    from sim_node.tasks import process_environment

    simulator = process_environment(SIMULATED_TASK)

    def thrown() -> None:
        """As a contact gone wrong would; the warning is MuJoCo's own."""

        def after_four(row: Any = None) -> None:
            if simulator.n_steps == 4:
                simulator.data.qvel[:] = 1e30

        real = simulator.observe
        monkeypatch.setattr(simulator, "observe", lambda: (after_four(), real())[1])

    thrown()
    work = study.roll(rollouts(units[:1], STARTS[:1]))
    assert [row["steps"] for row in work.failed] == [5]
    assert "diverged in step 5" in work.failed[0]["reason"]
    monkeypatch.undo()
    assert len(study.roll(rollouts(units[:1], STARTS[:1])).done) == 1


#: Kills each process that reads a pipe.
KILLER = """
import os, signal, sys
from pathlib import Path
while True:
    pipe = os.open(sys.argv[1], os.O_WRONLY)
    for process in Path("/proc").glob("[0-9]*"):
        try:
            files = [os.readlink(fd) for fd in (process / "fd").iterdir()]
        except OSError:
            continue
        if sys.argv[1] in files and int(process.name) != os.getpid():
            os.kill(int(process.name), signal.SIGKILL)
    os.close(pipe)
"""


def test_worker_that_dies_costs_its_own_unit_alone(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    """A policy that is a pipe: a worker that opens it waits, and is killed meanwhile."""
    card = policy_folder(study.folder, units[0].key) / "card.json"
    text = card.read_bytes()
    card.unlink()
    os.mkfifo(card)
    with subprocess.Popen([sys.executable, "-c", KILLER, str(card)]) as killer:
        work = trials(study.folder, jobs=2).roll(rollouts(units, STARTS[:1]))
        killer.terminate()
    assert (len(work.done), len(work.failed)) == (3, 1)
    assert work.failed[0]["policy"] == units[0].key
    assert "its worker died" in work.failed[0]["reason"]
    card.unlink()
    card.write_bytes(text)
    assert len(trials(study.folder).roll(rollouts(units, STARTS[:1])).done) == 1


def test_full_disk_ends_the_run_and_the_next_goes_on(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    import resource

    log = study.folder / "units.jsonl"
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (log.stat().st_size + 300, before[1]))
    try:
        with pytest.raises(CurationError, match=r"units\.jsonl"):
            study.roll(rollouts(units))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    study.roll(rollouts(units))
    assert len(results(study, "rollout")) == 12


# --- killed -------------------------------------------------------------------------------------

RUN = """
import json, sys
from pathlib import Path
from curation_ros.study.trials import PolicyTrials
from curation_ros.study.units import PolicyUnit, RolloutUnit
folder, bags = sys.argv[1], [Path(p) for p in sys.argv[3:]]
units = [
    PolicyUnit(name, "relative", seed, tuple((bag, None) for bag in some), steps=5)
    for name, some in {"all": bags, "few": bags[:1]}.items()
    for seed in (0, 7)
]
starts = [f"generated:5:{k}" for k in range(12)]
study = PolicyTrials(Path(folder), jobs=int(sys.argv[2]), max_steps=6)
study.train(units)
study.roll([RolloutUnit(unit.key, start) for unit in units for start in starts])
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_run_goes_on_with_nothing_done_twice(
    tmp_path: Path, bags: tuple[Path, ...], jobs: int
) -> None:
    command = [sys.executable, "-c", RUN, str(tmp_path / "study"), str(jobs), *map(str, bags)]
    log = tmp_path / "study" / "units.jsonl"
    with subprocess.Popen(command) as process:
        while b'"rollout"' not in (log.read_bytes() if log.exists() else b""):
            assert process.poll() is None
            time.sleep(0.005)
        os.kill(process.pid, signal.SIGKILL)
    whole = log.read_bytes()
    before = whole[: whole.rfind(b"\n") + 1]
    assert before.count(b'"rollout"') < 48
    subprocess.run(command, check=True)
    assert log.read_bytes().startswith(before)
    study = trials(tmp_path / "study")
    assert len(results(study, "policy")) == 4
    assert len(results(study, "rollout")) == 48
    steps = sum(row["steps"] for row in study.rows("rollout"))
    assert study.used_steps == steps == 48 * MAX_STEPS


def test_torn_line_is_no_unit(study: PolicyTrials, units: list[PolicyUnit]) -> None:
    study.roll(rollouts(units))
    log = study.folder / "units.jsonl"
    log.write_bytes(log.read_bytes()[:-20])
    assert len(study.roll(rollouts(units)).done) == 1
    assert len(results(study, "rollout")) == 12


def test_policy_saved_but_not_logged_is_taken_as_it_is(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    log = study.folder / "units.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    log.write_text("".join(lines[:-1]))
    weights = policy_folder(study.folder, units[-1].key) / "policy.safetensors"
    before = weights.stat().st_mtime_ns
    [row] = study.train(units).done
    assert row == json.loads(lines[-1])
    assert weights.stat().st_mtime_ns == before


def test_two_runs_of_a_study_at_once_are_refused(
    study: PolicyTrials, units: list[PolicyUnit]
) -> None:
    def again(_: Any) -> None:
        with pytest.raises(CurationError, match="another process runs this study"):
            trials(study.folder).roll(rollouts(units))

    assert len(study.roll(rollouts(units, STARTS[:1]), progress=again).done) == 4


# --- starts -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("official:3", "official-03"),
        ("official-03", "official-03"),
        ("generated:7:12", "generated-7-012"),
        ("generated-7-012", "generated-7-012"),
    ],
)
def test_starts_have_names(text: str, name: str) -> None:
    assert start_name(text) == name


@pytest.mark.parametrize("text", ["official:50", "official:0:3", "somewhere", "", "official-50"])
def test_start_that_is_none_is_refused_before_anything_runs(
    study: PolicyTrials, units: list[PolicyUnit], text: str
) -> None:
    with pytest.raises(ConfigError, match="start"):
        study.roll(rollouts(units, (STARTS[0], text)))
    assert study.rows("rollout") == []
