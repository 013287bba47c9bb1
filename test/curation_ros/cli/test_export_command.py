from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]


@pytest.fixture
def data(curation: Run, folder: Path) -> Path:
    """The dataset with its decisions written."""
    options = ["--reference", folder / "reference", "--config", folder / "curation.yaml"]
    assert curation("score", folder / "data", *options, "--write", "--json").code == DONE
    return folder / "data"


def test_keep_json_is_the_default_and_is_told(curation: Run, data: Path, tmp_path: Path) -> None:
    told = curation("export", data, "--out", tmp_path / "keep.json", "--json")
    assert told.code == DONE, told.err
    [row] = told.rows
    assert list(row) == ["out", "format", "episodes", "selected"]
    assert (row["format"], row["episodes"], row["selected"]) == ("keep-json", 5, 2)
    kept = json.loads((tmp_path / "keep.json").read_text())
    assert sorted(kept["names"].values()) == ["pick-0", "pick-1"]
    told = curation("export", data, "--out", tmp_path / "keep2.json")
    assert told.out == f"2 of 5 episodes selected: {tmp_path / 'keep2.json'}\n"


def test_selection_that_was_made_is_exported(curation: Run, data: Path, tmp_path: Path) -> None:
    curation("select", data, "--rule", "top-k", "--value", 3, "--scorer", "knn", "--name", "mine")
    out = tmp_path / "keep.json"
    assert curation("export", data, "--selection", "mine", "--out", out).code == DONE
    kept = json.loads(out.read_text())
    manifest = json.loads((data / "selections" / "mine.json").read_text())
    assert kept["episodes"] == [entry["episode"] for entry in manifest["entries"]]
    assert (kept["selection"], kept["rule"]["name"]) == ("mine", "top-k")


def test_csv_says_what_score_says(curation: Run, folder: Path, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "all.csv"
    assert curation("export", data, "--format", "csv", "--out", out).code == DONE
    options = ["--reference", folder / "reference", "--config", folder / "curation.yaml"]
    scored = {r["episode"]: r for r in curation("score", data, *options, "--json").rows}
    with out.open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert len(rows) == len(scored) == 5
    for row in rows:
        told = scored[row["episode"]]
        assert (row["name"], row["decision"]) == (told["name"], told["decision"])
        assert row["reason"] == told["reason"]
        assert int(row["steps"]) == told["length"]
        assert row["findings"].split() == [f["id"] for f in told["findings"]]
        for scorer, value in told["scores"].items():
            assert row[f"score/{scorer}"] == ("" if value is None else repr(value))


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ([], USAGE, "--out"),
        (["--out", "new", "--format", "nose"], USAGE, "nose"),
        (["--out", "new", "--format", "csv", "--selection", "nose"], USAGE, "nose.json"),
        (["--out", "taken", "--format", "csv"], NOTHING, "taken exists: --force overwrites it"),
        (["--out", "new.txt"], USAGE, "none of .json, .csv, .parquet; name a --format"),
        (["--out", "new.csv", "--format", "parquet"], USAGE, "is not --format parquet"),
        (["--out", "nowhere/new.csv"], USAGE, "there is no folder"),
    ],
)
def test_wrong_export_is_one_line_and_a_code(
    curation: Run,
    data: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("taken").write_text("precious")
    told = curation("export", data, *arguments, "--json")
    assert (told.code, told.out) == (code, "")
    assert said in told.err
    assert "internal error" not in told.err
    assert Path("taken").read_text() == "precious"
    assert not Path("new").exists()


def test_force_overwrites(curation: Run, data: Path, tmp_path: Path) -> None:
    out = tmp_path / "keep.json"
    out.write_text("old")
    assert curation("export", data, "--out", out, "--force").code == DONE
    assert len(json.loads(out.read_text())["episodes"]) == 2


def test_dataset_without_decisions_or_episodes_is_nothing(
    curation: Run, folder: Path, tmp_path: Path
) -> None:
    told = curation("export", folder / "data", "--out", tmp_path / "x.json", "--json")
    assert (told.code, told.out) == (NOTHING, "")
    assert "no decision yet" in told.err
    (tmp_path / "empty" / "episodes").mkdir(parents=True)
    told = curation("export", tmp_path / "empty", "--out", tmp_path / "x.csv", "--json")
    assert told.code == NOTHING
    assert "no episode to export" in told.err
