from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streams import record, short_episode

from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.manifest import Entry, Manifest
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.index import IndexedEpisode, file_system
from curation_ros.files import write_atomically

ID = "0197aaaa-0000-7000-8000-000000000001"


def _decision(episode: str = ID, by: str = "curator", **changes: Any) -> Decision:
    values: dict[str, Any] = {
        "verdict": "keep",
        "reason": "good",
        "span": (0, 7),
        "scores": {"knn": -0.5, "length": None},
        "abstained": {"length": "no step"},
        "state_hash": "abc",
        **changes,
    }
    return Decision(episode=episode, name="pick-1", by=by, **values)


def _manifest(name: str = "best", **changes: Any) -> Manifest:
    values: dict[str, Any] = {
        "created_at": "2026-11-22T10:00:00+00:00",
        "dataset": "data",
        "scorer": "knn",
        "rule": "top-k",
        "entries": (Entry(ID, "pick-1"),),
        "kept_of": 3,
        **changes,
    }
    return Manifest(name=name, **values)


def _rows(dataset: Dataset, query: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(dataset.index.path)) as db:
        return db.execute(query).fetchall()


def _tables(dataset: Dataset) -> dict[str, list[tuple[Any, ...]]]:
    return {t: sorted(_rows(dataset, f"SELECT * FROM {t}")) for t in ("episodes", "decisions")}


def _at_once(work: Callable[..., Any], arguments: Sequence[tuple[Any, ...]]) -> list[Any]:
    """Run a function in as many processes, all of which begin at the same moment."""
    context = multiprocessing.get_context("fork")
    gate = context.Barrier(len(arguments))
    with context.Pool(len(arguments), initializer=_set_gate, initargs=(gate,)) as pool:
        return pool.starmap(_begin_together, [(work, *a) for a in arguments], chunksize=1)


def _set_gate(gate: Any) -> None:
    global _gate
    _gate = gate


def _begin_together(work: Callable[..., Any], *arguments: Any) -> Any:
    _gate.wait()
    return work(*arguments)


# --- the folder ---------------------------------------------------------------------------------


def test_folder_without_episodes_is_no_dataset(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path, tmp_path / "none", tmp_path / "file"):
        with pytest.raises(CurationError, match=f"dataset {path}: no folder 'episodes'"):
            Dataset(path)


def test_created_dataset_can_be_opened_again(tmp_path: Path) -> None:
    for _ in range(2):
        Dataset(tmp_path / "a" / "b", create=True)
    assert list(Dataset(str(tmp_path / "a" / "b")).bags()) == []


def test_dataset_that_cannot_be_made_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CurationError, match=f"dataset {tmp_path / 'file' / 'data'}: "):
        Dataset(tmp_path / "file" / "data", create=True)


def test_bags_are_in_the_order_of_recording_and_partial_ones_are_none(dataset: Dataset) -> None:
    ids = [new_episode_id() for _ in range(3)]
    for episode_id in reversed(ids):
        dataset.bag_path(episode_id).mkdir()
    dataset.partials.path("x").mkdir()
    (dataset.path / "episodes" / "notes.txt").write_text("")
    assert [p.name for p in dataset.bags()] == ids


def test_published_bag_has_left_partial(dataset: Dataset) -> None:
    dataset.partials.path(ID).mkdir()
    (dataset.partials.path(ID) / "x").write_text("1")
    assert dataset.partials.publish(ID) == dataset.bag_path(ID)
    assert (dataset.bag_path(ID) / "x").read_text() == "1"
    with pytest.raises(CurationError, match=ID):
        dataset.partials.publish(ID)


def test_published_bag_never_replaces_another(dataset: Dataset) -> None:
    for folder in (dataset.partials.path(ID), dataset.bag_path(ID)):
        folder.mkdir()
        (folder / "x").write_text(folder.parent.name)
    with pytest.raises(CurationError, match=ID):
        dataset.partials.publish(ID)
    assert (dataset.bag_path(ID) / "x").read_text() == "episodes"


def test_file_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "a" / "file.json"
    write_atomically(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "new \ud800")
    assert path.read_text() == "old"
    assert [p.name for p in path.parent.iterdir()] == ["file.json"]


# --- decisions ----------------------------------------------------------------------------------


def test_log_gives_the_revision_and_gives_back_every_field(dataset: Dataset) -> None:
    first = dataset.append_decision(_decision(revision=17, evidence={"seen": {"span": [1, 2]}}))
    second = dataset.append_decision(_decision(by="Ada", verdict="discard"))
    assert (first.revision, second.revision) == (1, 2)
    assert dataset.decisions(ID) == [first, second]
    assert dataset.decisions("unknown") == []
    assert first.scores == {"knn": -0.5, "length": None}


def test_amended_decision_keeps_its_revision(dataset: Dataset) -> None:
    first = dataset.append_decision(_decision())
    amended = dataset.append_decision(_decision(evidence={"bag": "equal"}), amend=True)
    assert amended.revision == first.revision == 1
    assert dataset.append_decision(_decision()).revision == 2
    assert _rows(dataset, "SELECT COUNT(*) FROM decisions") == [(2,)]
    assert dataset.latest_decisions()[ID].revision == 2


def test_amending_a_decision_does_not_take_the_number_of_a_later_one(dataset: Dataset) -> None:
    first = dataset.append_decision(_decision())
    person = dataset.append_decision(_decision(by="Ada", verdict="discard"))
    amended = dataset.append_decision(
        _decision(revision=first.revision, evidence={"bag": "equal"}), amend=True
    )
    assert amended.revision == 1
    assert dataset.latest_decisions() == {ID: person}
    assert dataset.append_decision(_decision()).revision == 3
    by = {d.revision: d.by for d in dataset.decisions(ID)}
    assert by == {1: "curator", 2: "Ada", 3: "curator"}
    assert len(_rows(dataset, "SELECT * FROM decisions")) == 3


def test_decision_of_a_person_is_in_force_whatever_comes_later(dataset: Dataset) -> None:
    dataset.append_decision(_decision())
    dataset.append_decision(_decision(by="Ada", verdict="discard"))
    dataset.append_decision(_decision(reason="the bag differs"))
    assert dataset.latest_decisions()[ID].verdict == "discard"


def _decide_often(path: Path, by: str, n: int) -> list[int]:
    dataset = Dataset(path)
    return [dataset.append_decision(_decision(by=by)).revision for _ in range(n)]


def test_processes_that_decide_at_once_get_consecutive_revisions(dataset: Dataset) -> None:
    n_processes, n = 4, 15
    numbers = _at_once(
        _decide_often, [(dataset.path, f"person-{k}", n) for k in range(n_processes)]
    )
    assert all(own == sorted(own) for own in numbers)
    assert sorted(r for own in numbers for r in own) == list(range(1, n_processes * n + 1))
    lines = dataset.decision_log(ID).read_text().splitlines()
    assert [json.loads(line)["revision"] for line in lines] == list(range(1, n_processes * n + 1))
    assert _rows(dataset, "SELECT COUNT(*) FROM decisions") == [(n_processes * n,)]


@pytest.mark.parametrize("cut", [1, 2, 40])
def test_torn_last_line_costs_nothing_but_itself(dataset: Dataset, cut: int) -> None:
    first = dataset.append_decision(_decision())
    dataset.append_decision(_decision(by="Ada"))
    log = dataset.decision_log(ID)
    log.write_bytes(log.read_bytes()[:-cut])
    whole = 2 if cut == 1 else 1  # only the end of the line is missing
    assert len(dataset.decisions(ID)) == whole
    again = dataset.append_decision(_decision(by="Bob"))
    assert again.revision == whole + 1
    assert dataset.decisions(ID)[0] == first
    assert dataset.decisions(ID)[-1] == again
    assert dataset.latest_decisions()[ID] == again


def test_line_that_is_no_decision_is_reported_with_its_file(dataset: Dataset) -> None:
    dataset.append_decision(_decision())
    log = dataset.decision_log(ID)
    log.write_text(log.read_text() + '\n[1, 2]\nnonsense\n{"episode": "x"}\n')
    with pytest.raises(EpisodeError, match="decision") as refused:
        dataset.decisions(ID)
    assert str(log) in str(refused.value)


def test_decision_that_cannot_be_logged_is_an_error_of_ours_by_name(dataset: Dataset) -> None:
    (dataset.path / "decisions").write_text("in the way")
    with pytest.raises(CurationError, match=str(dataset.path / "decisions")):
        dataset.append_decision(_decision())
    shutil.rmtree(dataset.path)
    dataset.path.write_text("in the way")
    with pytest.raises(CurationError, match=str(dataset.path)):
        dataset.append_truth({"episode": ID})


# --- names --------------------------------------------------------------------------------------


def test_episodes_are_found_by_name_and_prefix_from_bags_and_logs(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first = short_episode(rng, 3, name="pick-1")
    second = short_episode(rng, 3, name="pick-2")
    for episode in (first, second):
        record(dataset, episode)
    dataset.append_decision(_decision(episode=ID))  # decided, its bag is elsewhere
    assert dataset.names() == sorted([(first.id, "pick-1"), (second.id, "pick-2"), (ID, "pick-1")])
    assert dataset.find("pick-2") == second.id
    assert dataset.find(second.id[:8]) == second.id
    assert dataset.find(ID[:8]) == ID
    with pytest.raises(EpisodeError, match="means 2 episodes"):
        dataset.find("pick-1")
    with pytest.raises(EpisodeError, match="3 are known"):
        dataset.find("pick-3")


# --- truth --------------------------------------------------------------------------------------


def test_truth_of_an_episode_is_merged_and_later_lines_win(dataset: Dataset) -> None:
    assert dataset.truth() == {}
    dataset.append_truth({"episode": "a", "start": "official-01", "outcome": "failed"})
    dataset.append_truth({"episode": "b", "task": "t", "start": "official-02", "repetition": 3})
    dataset.append_truth({"episode": "a", "outcome": "succeeded"})
    dataset.append_truth({"episode": "c", "button": "keep"})
    assert dataset.truth()["a"] == {
        "episode": "a",
        "start": "official-01",
        "outcome": "succeeded",
    }
    assert dataset.truth_log.starts() == {
        "a": ("", "official-01", 0),
        "b": ("t", "official-02", 3),
    }


def _tell_often(path: Path, who: str, n: int) -> None:
    for k in range(n):
        Dataset(path).append_truth({"episode": f"{who}-{k}", "text": "x" * 3000})


def test_processes_that_append_at_once_tear_no_line(dataset: Dataset) -> None:
    _at_once(_tell_often, [(dataset.path, f"p{k}", 20) for k in range(3)])
    lines = (dataset.path / "truth.jsonl").read_text().splitlines()
    assert {json.loads(line)["episode"] for line in lines} == {
        f"p{k}-{j}" for k in range(3) for j in range(20)
    }
    assert len(lines) == 60


# --- selections ---------------------------------------------------------------------------------


def test_selection_is_never_overwritten(dataset: Dataset) -> None:
    path = dataset.save_manifest(_manifest())
    before = path.read_bytes()
    for again in (_manifest(), _manifest(kept_of=9)):
        with pytest.raises(CurationError, match=f"{path} exists"):
            dataset.save_manifest(again)
    assert path.read_bytes() == before
    assert Manifest.from_json(json.loads(before)) == _manifest()


def _save(path: Path, kept_of: int) -> int:
    try:
        Dataset(path).save_manifest(_manifest(kept_of=kept_of))
    except CurationError:
        return 0
    return kept_of


def test_of_processes_that_save_one_name_at_once_one_wins(dataset: Dataset) -> None:
    for trial in range(5):
        saved = _at_once(_save, [(dataset.path, 10 + k) for k in range(4)])
        [winner] = [n for n in saved if n]
        path = dataset.path / "selections" / "best.json"
        assert json.loads(path.read_text())["kept_of"] == winner, trial
        assert [p.name for p in path.parent.glob("*.json*")] == ["best.json"]
        path.unlink()


# --- the index ----------------------------------------------------------------------------------


def _filled(dataset: Dataset, rng: np.random.Generator) -> list[str]:
    episodes = [short_episode(rng, 3, name=f"pick-{k}") for k in range(3)]
    for episode in episodes:
        record(dataset, episode)
        dataset.append_decision(_decision(episode=episode.id))
    dataset.append_decision(_decision(episode=episodes[0].id, by="Ada", scores={"knn": 1.0}))
    dataset.append_decision(_decision(episode=episodes[1].id, evidence={"a": 1}), amend=True)
    dataset.save_manifest(_manifest())
    return [e.id for e in episodes]


def test_rebuilt_index_equals_the_one_that_grew(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _filled(dataset, rng)
    assert dataset.refresh() == []
    grown = _tables(dataset)
    assert {k: len(v) for k, v in grown.items()} == {"episodes": 3, "decisions": 4}
    assert dataset.rebuild() == []
    assert _tables(dataset) == grown
    dataset.index.path.unlink()
    assert dataset.rebuild() == []
    assert _tables(dataset) == grown


def test_index_row_of_an_episode_says_what_its_bag_says(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng, 3, name="pick-7")
    record(dataset, episode)
    dataset.refresh()
    row = IndexedEpisode(
        episode.id,
        "pick-7",
        f"episodes/{episode.id}",
        episode.start_ns,
        episode.end_ns,
        event="ended",
        source="live",
        is_recovered=False,
    )
    assert dataset.index.episodes() == [row]
    assert dataset.index.episode(episode.id) == row
    assert dataset.index.episode("another") is None


def test_refresh_follows_bags_that_come_and_go(dataset: Dataset, rng: np.random.Generator) -> None:
    ids = _filled(dataset, rng)
    dataset.refresh()
    shutil.rmtree(dataset.bag_path(ids[1]))
    dataset.refresh()
    assert [e.id for e in dataset.index.episodes()] == sorted([ids[0], ids[2]])


def test_unreadable_bag_is_a_problem_of_its_own(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng, 3)
    record(dataset, episode)
    spoilt = dataset.bag_path("spoilt")
    spoilt.mkdir()
    (spoilt / "spoilt_0.mcap").write_bytes(b"")
    for problems in (dataset.refresh(), dataset.refresh(), dataset.rebuild()):
        assert len(problems) == 1
        assert str(spoilt) in problems[0]
    assert [e.id for e in dataset.index.episodes()] == [episode.id]


def test_spoilt_log_is_a_problem_and_stops_nothing(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _filled(dataset, rng)
    dataset.refresh()
    grown = _tables(dataset)
    (dataset.path / "decisions" / "x.jsonl").write_text('{"episode": "x"}\n')
    [problem] = dataset.rebuild()
    assert "x.jsonl" in problem
    assert _tables(dataset) == grown


def test_spoilt_index_is_made_anew(dataset: Dataset, rng: np.random.Generator) -> None:
    _filled(dataset, rng)
    dataset.refresh()
    grown = _tables(dataset)
    dataset.index.path.write_bytes(b"this is no database at all" * 100)
    with pytest.raises(CurationError, match="--rebuild"):
        dataset.index.episodes()
    dataset.append_decision(_decision())  # the log is the truth: it does not need the index
    assert len(dataset.decisions(ID)) == 1
    dataset.decision_log(ID).unlink()
    assert dataset.rebuild() == []
    assert _tables(dataset) == grown


def _refresh(path: Path, rebuild: bool) -> list[str]:
    dataset = Dataset(path)
    problems = dataset.rebuild() if rebuild else dataset.refresh()
    return problems + [e.id for e in dataset.index.episodes()]


@pytest.mark.parametrize("rebuild", [False, True])
def test_processes_that_index_at_once_agree(
    dataset: Dataset, rng: np.random.Generator, rebuild: bool
) -> None:
    ids = sorted(_filled(dataset, rng))
    for _ in range(4):
        dataset.index.path.unlink(missing_ok=True)
        _at_once(_refresh, [(dataset.path, rebuild)] * 4)
        assert [e.id for e in dataset.index.episodes()] == ids
        with sqlite3.connect(dataset.index.path) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)


def test_slow_reader_of_the_index_holds_up_no_decision(dataset: Dataset) -> None:
    dataset.refresh()
    with sqlite3.connect(dataset.index.path) as reader:
        reader.execute("BEGIN")
        reader.execute("SELECT * FROM episodes").fetchall()
        assert dataset.append_decision(_decision()).revision == 1
    assert _rows(dataset, "SELECT COUNT(*) FROM decisions") == [(1,)]


# --- where the index cannot be in the dataset ---------------------------------------------------

_MOUNTS = r"""
/dev/vda / ext4 rw 0 0
server:/home /home nfs4 rw 0 0
/dev/vdb /home/me/local ext4 rw 0 0
me@server: /home/me/with\040space fuse.sshfs rw 0 0
overlay /data overlay rw 0 0
//server/share /data cifs rw 0 0
"""


@pytest.mark.parametrize(
    ("path", "kind"),
    [
        ("/", "ext4"),
        ("/home", "nfs4"),
        ("/home/me/data", "nfs4"),
        ("/homework", "ext4"),
        ("/home/me/local/data", "ext4"),
        ("/home/me/with space/data", "fuse.sshfs"),
        ("/data/x", "cifs"),
    ],
)
def test_file_system_is_that_of_the_nearest_mount(tmp_path: Path, path: str, kind: str) -> None:
    (tmp_path / "mounts").write_text(_MOUNTS.strip() + "\n")
    assert file_system(Path(path), tmp_path / "mounts") == kind
    assert file_system(Path(path), tmp_path / "none") == ""


def test_index_of_a_local_dataset_is_in_it(dataset: Dataset) -> None:
    assert dataset.index.elsewhere == ""
    assert dataset.index.path == dataset.path / "index.sqlite"


_ON_READ_ONLY_DISK = """
import sys
from curation_ros.core.decision.decision import Decision
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
dataset = Dataset(sys.argv[1])
print(dataset.index.path)
print(dataset.index.elsewhere)
print(len(dataset.names()), dataset.rebuild())
decision = Decision(episode="x", name="n", verdict="keep", reason="r", span=(0, 1))
for write in (lambda: dataset.append_decision(decision), lambda: dataset.append_truth({})):
    try:
        write()
    except CurationError as err:
        print("refused", err)
"""


def test_index_of_a_read_only_dataset_is_in_the_cache(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    record(dataset, short_episode(rng, 3))
    folder = dataset.path
    script = 'mount --bind "$1" "$1" && mount -o remount,bind,ro "$1" && ! touch "$1/x" || exit 77'
    command = ["unshare", "--mount", "--map-root-user", "sh", "-c"]
    if (
        shutil.which("unshare") is None
        or subprocess.run(
            [*command, script, "sh", str(folder)], capture_output=True, check=False
        ).returncode
    ):
        pytest.skip("no read-only mount can be made here (unshare, mount)")
    run = f'{script}; exec "$2" -c "$3" "$1"'
    done = subprocess.run(
        [*command, run, "sh", str(folder), sys.executable, _ON_READ_ONLY_DISK],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    index, why, counted, *refused = done.stdout.splitlines()
    assert why == "the dataset cannot be written"
    assert Path(index).parent == tmp_path / "cache" / "curation_ros"
    assert Path(index).is_file()
    assert counted == "1 []"
    assert [line.split(":")[0] for line in refused] == [
        f"refused {folder / 'decisions'}",
        f"refused {folder / 'truth.jsonl'}",
    ]
    assert not (folder / "index.sqlite").exists()
