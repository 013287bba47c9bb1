"""Many bags: the same results however the work is spread, kept, interrupted or taken up again."""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from episodes import make_episode, make_reference
from streams import record

from curation_ros.batch.examine import Examined, Examiner
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.fitted_scorers import FittedScorers, Looks
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.errors import BagError, ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset

pytestmark = pytest.mark.slow

SCORERS = ("gripper_timing", "knn", "length")
N_BAGS = 40


@pytest.fixture(scope="module")
def fitted() -> Curation:
    return Curation.fit(
        CurationSettings(scorers=SCORERS), make_reference(np.random.default_rng(7))
    )


@pytest.fixture(scope="module")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("many")
    dataset = Dataset(folder / "data", create=True)
    rng = np.random.default_rng(11)
    for k in range(N_BAGS):
        record(dataset, make_episode(rng, open_at=140 if k % 4 == 3 else -1, name=f"pick-{k}"))
    return folder / "data"


@pytest.fixture
def data(_recorded: Path, tmp_path: Path) -> Path:
    shutil.copytree(_recorded, tmp_path / "data")
    return tmp_path / "data"


def bags_of(data: Path) -> list[Path]:
    return list(Dataset(data).bags())


def texts(results: Iterator[Examined]) -> list[tuple[str, object]]:
    return [
        (e.path.name, e.result.to_json() if isinstance(e.result, Examination) else str(e.result))
        for e in results
    ]


# --- kept ---------------------------------------------------------------------------------------


def test_second_run_reads_nothing_and_says_the_same(data: Path, fitted: Curation) -> None:
    first = list(Examiner(fitted.scorers).run(bags_of(data)))
    second = list(Examiner(fitted.scorers).run(bags_of(data)))
    assert [e.is_known for e in first] == [False] * N_BAGS
    assert [e.is_known for e in second] == [True] * N_BAGS
    assert [e.result for e in first] == [e.result for e in second]


def test_only_what_is_new_or_has_changed_is_scored(data: Path, fitted: Curation) -> None:
    list(Examiner(fitted.scorers).run(bags_of(data)))
    changed, *_ = bags_of(data)
    os.utime(next(changed.glob("*.mcap")), ns=(1, 1))
    added = record(Dataset(data), make_episode(np.random.default_rng(99), name="new"))
    fresh = [e.path for e in Examiner(fitted.scorers).run(bags_of(data)) if not e.is_known]
    assert sorted(fresh) == sorted([changed, added])


def test_other_scorers_are_other_results(data: Path, fitted: Curation) -> None:
    list(Examiner(fitted.scorers).run(bags_of(data)))
    other = Curation.fit(
        CurationSettings(scorers=SCORERS), make_reference(np.random.default_rng(8))
    )
    assert not any(e.is_known for e in Examiner(other.scorers).run(bags_of(data)))
    again = Curation.fit(
        CurationSettings(scorers=SCORERS, rule="none"), make_reference(np.random.default_rng(7))
    )
    assert all(
        e.is_known for e in Examiner(again.scorers).run(bags_of(data))
    )  # a rule needs no reading


def test_fresh_examines_again_but_each_bag_once(data: Path, fitted: Curation) -> None:
    list(Examiner(fitted.scorers).run(bags_of(data)))
    examiner = Examiner(fitted.scorers, fresh=True)
    assert not any(e.is_known for e in examiner.run(bags_of(data)))
    assert all(e.is_known for e in examiner.run(bags_of(data)))


def test_interrupted_run_goes_on_where_it_stopped(data: Path, fitted: Curation) -> None:
    running = Examiner(fitted.scorers).run(bags_of(data))
    seen = [next(running).path for _ in range(20)]
    running.close()
    again = list(Examiner(fitted.scorers).run(bags_of(data)))
    known = [e.path for e in again if e.is_known]
    assert set(seen) <= set(known)
    assert len(known) < N_BAGS


def test_killed_run_goes_on_where_it_stopped(data: Path, fitted: Curation, tmp_path: Path) -> None:
    for bag in bags_of(data) * 3:  # so many lines do not fit into the pipe
        shutil.copytree(bag, data / "episodes" / new_episode_id())
    config = tmp_path / "curation.yaml"
    config.write_text(f"scorers: [{', '.join(SCORERS)}]\nrule: none\nrule_scorer: length\n")
    command = [sys.executable, "-m", "curation_ros.cli.main", "score", str(data), "--json"]
    command += ["--config", str(config)]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()  # the first batch is kept; nobody reads on
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    with closing(sqlite3.connect(Dataset(data).index.path)) as db:
        [kept] = db.execute("SELECT count(*) FROM examinations").fetchone()
    assert 0 < kept < 4 * N_BAGS
    done = subprocess.run(command[:-3] + command[-2:], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert f"{4 * N_BAGS} scored ({kept} cached), 0 unreadable" in done.stderr


def test_rebuilding_the_index_forgets_what_was_examined(data: Path, fitted: Curation) -> None:
    list(Examiner(fitted.scorers).run(bags_of(data)))
    assert Dataset(data).rebuild() == []
    assert not any(e.is_known for e in Examiner(fitted.scorers).run(bags_of(data)))


def test_unreadable_bag_is_an_error_each_time_and_the_rest_is_scored(
    data: Path, fitted: Curation
) -> None:
    bad = bags_of(data)[5]
    next(bad.glob("*.mcap")).write_bytes(b"")
    for _ in range(2):
        results = list(Examiner(fitted.scorers).run(bags_of(data)))
        wrong = [e for e in results if isinstance(e.result, CurationError)]
        assert [e.path for e in wrong] == [bad]
        assert isinstance(wrong[0].result, BagError)
        assert len(results) == N_BAGS


def test_folder_that_is_no_dataset_stays_as_it_is(
    data: Path, fitted: Curation, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "bags"
    shutil.move(data / "episodes", folder)
    bags = sorted(p for p in folder.iterdir() if p.name[0] != ".")
    before = sorted(folder.rglob("*"))
    assert not any(e.is_known for e in Examiner(fitted.scorers).run(bags))
    assert all(e.is_known for e in Examiner(fitted.scorers).run(bags))
    assert sorted(folder.rglob("*")) == before


def test_index_that_cannot_be_written_costs_no_result(
    data: Path, fitted: Curation, tmp_path: Path
) -> None:
    good = texts(Examiner(fitted.scorers).run(bags_of(data)))
    Dataset(data).index.path.unlink()
    Dataset(data).index.path.mkdir()  # even root cannot open that as a database
    examiner = Examiner(fitted.scorers)
    assert texts(examiner.run(bags_of(data))) == good
    assert "index" in examiner.problem


# --- spread -------------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["loky", "ray", "dask"])
def test_workers_give_the_same_results_in_the_same_order(
    data: Path, fitted: Curation, backend: str
) -> None:
    if backend == "ray":
        pytest.importorskip("ray", reason="the extra 'ray' is not installed")
    if backend == "dask":
        pytest.importorskip("distributed", reason="the extra 'dask' is not installed")
    alone = texts(Examiner(fitted.scorers).run(bags_of(data)))
    Dataset(data).index.path.unlink()
    spread = Examiner(fitted.scorers, jobs=2, backend=backend)
    assert texts(spread.run(bags_of(data))) == alone
    assert all(e.is_known for e in Examiner(fitted.scorers).run(bags_of(data)))


def test_worker_that_dies_is_told_in_one_line(data: Path, fitted: Curation) -> None:
    class Deadly(FittedScorers):
        def look(self, episode: object) -> Looks:
            os.kill(os.getpid(), signal.SIGKILL)
            raise AssertionError

    deadly = Deadly(**{f.name: getattr(fitted.scorers, f.name) for f in fields(FittedScorers)})
    with pytest.raises(CurationError, match="a worker died"):
        list(Examiner(deadly, jobs=2).run(bags_of(data)))


@pytest.mark.parametrize("options", [{"backend": "slurm"}, {"jobs": 0}, {"jobs": -2}])
def test_bad_options_are_refused(fitted: Curation, options: dict[str, object]) -> None:
    with pytest.raises(ConfigError):
        Examiner(fitted.scorers, **options)  # type: ignore[arg-type]


# --- several at once ----------------------------------------------------------------------------


def test_processes_that_score_at_once_agree(data: Path, tmp_path: Path) -> None:
    config = tmp_path / "curation.yaml"
    config.write_text(f"scorers: [{', '.join(SCORERS)}]\nrule: none\nrule_scorer: length\n")
    command = [sys.executable, "-m", "curation_ros.cli.main", "score", str(data), "--json"]
    command += ["--config", str(config)]
    rebuild = [sys.executable, "-m", "curation_ros.cli.main", "index", str(data), "--rebuild"]
    running = [
        subprocess.Popen(c, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for c in (command, command, rebuild, command)
    ]
    outputs = [process.communicate() for process in running]
    assert [process.returncode for process in running] == [0] * 4, outputs
    assert [err for _, err in outputs] == [""] * 4
    scored = {outputs[k][0] for k in (0, 1, 3)}
    assert len(scored) == 1
    assert scored.pop().count("\n") == N_BAGS
