"""`import curation_ros as cr`: what a notebook sees."""

from __future__ import annotations

import doctest
import importlib
import importlib.util
import inspect
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
from episodes import make_episode, make_reference
from streams import record

import curation_ros as cr
from curation_ros.cli.main import main
from curation_ros.dataset.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]
SAMPLE = ROOT / "bags" / "sample"
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def load(path: Path) -> ModuleType:
    """A script of the docs, as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def few(dataset: Dataset) -> Dataset:
    """A dataset with three episodes."""
    rng = np.random.default_rng(5)
    for k in range(3):
        record(dataset, make_episode(rng, name=f"pick-{k}"))
    return dataset


@pytest.fixture
def no_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a machine without pandas."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name: None if name == "pandas" else find(name)
    )


# --- the names ----------------------------------------------------------------------------------


def test_every_name_is_there_documented_and_listed() -> None:
    assert sorted(cr.__all__) == cr.__all__ == dir(cr)
    for name in cr.__all__:
        value = getattr(cr, name)
        if name != "__version__":
            assert inspect.getdoc(value), name


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="'curation_ros' has no attribute 'opne'"):
        _ = cr.opne  # type: ignore[attr-defined]


def test_import_loads_no_library() -> None:
    code = (
        "import sys; before = set(sys.modules); import curation_ros;"
        "print(*sorted(set(sys.modules) - before))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    ours = {"curation_ros", "curation_ros.version"}
    others = {m for m in done.stdout.split() if m.partition(".")[0] not in sys.stdlib_module_names}
    assert others == ours


@pytest.mark.parametrize(
    "module", ["curation_ros", "curation_ros.api", "curation_ros.core.episode.episode"]
)
def test_examples_in_the_docstrings_run(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    loaded = importlib.import_module(module)
    result = doctest.testmod(loaded, extraglobs={"np": np}, optionflags=FLAGS)
    assert result.attempted > 0
    assert result.failed == 0


def test_page_of_the_api_is_current() -> None:
    assert load(ROOT / "docs" / "make_api.py").main(["--check"]) == 0


# --- opening ------------------------------------------------------------------------------------


def test_open_reads_nothing_until_an_episode_is_asked_for(few: Dataset) -> None:
    collection = cr.open(few.path)
    [first, *_] = few.bags()
    for file in first.iterdir():
        file.unlink()
    assert len(collection.episodes) == 3
    assert collection.episodes[2].id == collection.episodes[1:][1].id
    assert len({e.name for e in collection.episodes[1:]} & {"pick-0", "pick-1", "pick-2"}) == 2
    with pytest.raises(cr.CurationError, match=first.name):
        collection.episodes[0]


def test_open_of_nothing_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(cr.CurationError, match="nowhere: no such path"):
        cr.open(tmp_path / "nowhere")
    with pytest.raises(cr.CurationError, match="nowhere: no such path"):
        cr.score([SAMPLE, tmp_path / "nowhere"])


def test_several_paths_are_one_collection(few: Dataset) -> None:
    collection = cr.open([str(SAMPLE), few.path])
    assert len(collection.episodes) == 4
    assert not collection.is_dataset
    assert repr(collection) == f"Collection({str(SAMPLE)!r}, {str(few.path)!r}, 4 episodes)"


# --- scoring ------------------------------------------------------------------------------------


def test_scores_are_those_of_the_command(few: Dataset, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(few.path), "--json", "--rule", "gap", "--rule-scorer", "knn"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    result = cr.score(few.path, rule="gap", rule_scorer="knn")
    assert [one.to_json() for one in result] == rows
    assert len(result) == 3


def test_episodes_in_memory_score_as_on_disk(few: Dataset) -> None:
    reference = make_reference(np.random.default_rng(8))
    on_disk = cr.score(few.path, reference=reference, rule="top-k", value=2, rule_scorer="knn")
    in_memory = cr.score(
        cr.open(few.path).episodes, reference=reference, rule="top-k", value=2, rule_scorer="knn"
    )
    assert [dict(one.scores) for one in in_memory] == [dict(one.scores) for one in on_disk]
    assert sorted(one.verdict for one in in_memory) == sorted(one.verdict for one in on_disk)
    assert in_memory[0].scores["knn"] is not None


def test_copy_in_memory_is_found() -> None:
    episode = cr.read_episode(SAMPLE)
    first, second = cr.score([episode, episode])
    assert first.verdict == "keep"
    assert [f.id for f in second.decision.findings] == ["duplicate"]


def test_arrays_are_scored_without_a_bag() -> None:
    rng = np.random.default_rng(3)
    hand = np.cumsum(rng.normal(0.0, 0.01, (80, 3)), axis=0)
    episode = cr.Episode.from_arrays(
        {"hand": hand, "velocity": np.gradient(hand, axis=0)},
        {"hand": "effector", "velocity": "action"},
        rate_hz=20.0,
        name="by-hand",
    )
    [one] = cr.score(episode, scorers=["smoothness", "length"])
    assert one.decision.name == "by-hand"
    assert one.scores["length"] == -80.0
    assert one.scores["smoothness"] is not None


def test_unreadable_recording_is_listed_and_the_rest_is_scored(few: Dataset) -> None:
    [first, *_] = few.bags()
    for file in first.iterdir():
        file.write_bytes(b"")
    result = cr.score(few.path)
    assert len(result) == 2
    [lost] = result.unreadable
    assert lost.path == first
    assert repr(result).endswith(", 1 unreadable)")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scorers": ["smoothnes"]}, "no scorer 'smoothnes'"),
        ({"rule": "best"}, "no rule 'best'"),
        ({"value": 0.5}, "belongs to a rule"),
        ({"config": "/nowhere.yaml"}, "/nowhere.yaml"),
        ({"reference": "/nowhere"}, "/nowhere"),
    ],
)
def test_wrong_settings_are_refused_by_name(settings: dict[str, object], message: str) -> None:
    with pytest.raises(cr.CurationError, match=message):
        cr.score(SAMPLE, **settings)  # type: ignore[arg-type]


def test_paths_and_episodes_do_not_mix() -> None:
    with pytest.raises(cr.CurationError, match="found both"):
        cr.score([SAMPLE, cr.read_episode(SAMPLE)])
    with pytest.raises(cr.CurationError, match="episodes in memory"):
        cr.score(cr.read_episode(SAMPLE), write=True)


# --- tables -------------------------------------------------------------------------------------


def test_tables_are_frames_with_pandas(few: Dataset) -> None:
    result = cr.score(few.path)
    scores = result.scores()
    assert isinstance(scores, pd.DataFrame)
    assert list(scores.columns)[:3] == ["episode", "name", "steps"]
    assert scores["smoothness"].tolist() == [one.scores["smoothness"] for one in result]
    assert np.isnan(scores["knn"]).all()  # no reference
    assert result.decisions()["verdict"].tolist() == [one.verdict for one in result]


@pytest.mark.usefixtures("no_pandas")
def test_tables_are_plain_rows_without_pandas(few: Dataset) -> None:
    rows = cr.open(few.path).scores(scorers=["smoothness"])
    assert {row["name"] for row in rows} == {"pick-0", "pick-1", "pick-2"}
    assert all(isinstance(row["smoothness"], float) for row in rows)


# --- decisions and selections -------------------------------------------------------------------


@pytest.mark.usefixtures("no_pandas")
def test_decisions_are_those_that_were_logged(few: Dataset) -> None:
    collection = cr.open(few.path)
    assert collection.decisions() == []
    cr.score(collection, write=True)
    main(["override", str(few.path), "pick-1", "discard", "--reason", "dropped", "--by", "ada"])
    rows = {row["name"]: row for row in collection.decisions()}
    assert set(rows) == {"pick-0", "pick-1", "pick-2"}
    assert (rows["pick-1"]["verdict"], rows["pick-1"]["by"]) == ("discard", "ada")
    assert rows["pick-1"]["reason"] == "ada: dropped"


def test_selection_is_written_for_training(few: Dataset) -> None:
    collection = cr.open(few.path)
    cr.score(collection, write=True)
    manifest, path = collection.select(rule="top-k", value=2, scorer="smoothness", name="two")
    assert path == few.path / "selections" / "two.json"
    assert len(manifest.entries) == 2
    assert json.loads(path.read_text())["rule"] == "top-k"


def test_bags_that_are_no_dataset_have_no_log() -> None:
    with pytest.raises(cr.CurationError, match="expected one dataset"):
        cr.open(SAMPLE).decisions()
    with pytest.raises(cr.CurationError, match="expected one dataset"):
        cr.open(SAMPLE).select()
