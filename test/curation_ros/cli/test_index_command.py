from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streams import record, short_episode

from curation_ros.dataset.dataset import Dataset

DONE, USAGE, NOTHING = 0, 2, 3
KEYS = ["episode", "name", "path", "decision", "by", "reason", "recovered"]
Run = Callable[..., Any]


def test_every_episode_is_listed_with_the_decision_in_force(curation: Run, folder: Path) -> None:
    data = folder / "data"
    options = ["--reference", folder / "reference", "--config", folder / "curation.yaml"]
    curation("score", data, *options, "--write", "--json")
    curation("override", data, "pick-2", "keep", "--by", "Ada", "--reason", "I was there")
    told = curation("index", data, "--json")
    assert told.code == DONE
    assert all(list(row) == KEYS for row in told.rows)
    listed = {row["name"]: row for row in told.rows}
    assert {name: row["decision"] for name, row in listed.items()} == {
        "pick-0": "keep",
        "pick-1": "keep",
        "pick-2": "keep",
        "pick-3": "discard",
        "pick-4": "review",
    }
    assert (listed["pick-2"]["by"], listed["pick-2"]["reason"]) == ("Ada", "Ada: I was there")
    assert listed["pick-0"]["by"] == "curator"
    assert [row["episode"] for row in told.rows] == sorted(row["episode"] for row in told.rows)
    assert all(Path(row["path"]).is_dir() and row["recovered"] is False for row in told.rows)
    table = curation("index", data)
    assert table.code == DONE
    assert all(name in table.out for name in listed)


def test_undecided_episodes_are_listed_as_such(curation: Run, folder: Path) -> None:
    told = curation("index", folder / "data", "--json")
    assert {(row["decision"], row["by"], row["reason"]) for row in told.rows} == {(None, None, "")}
    assert "undecided" in curation("index", folder / "data").out


def test_rebuilt_index_says_the_same(curation: Run, folder: Path) -> None:
    data = folder / "data"
    before = curation("index", data, "--json")
    Dataset(data).index.path.write_bytes(b"spoilt")
    assert curation("index", data, "--rebuild", "--json").rows == before.rows
    Dataset(data).index.path.write_bytes(b"spoilt again")
    assert curation("index", data, "--json").rows == before.rows


@pytest.mark.parametrize("rebuild", [True, False])
def test_what_cannot_be_read_is_a_warning(curation: Run, folder: Path, rebuild: bool) -> None:
    spoilt = folder / "data" / "episodes" / "spoilt"
    spoilt.mkdir()
    (spoilt / "spoilt_0.mcap").write_bytes(b"")
    options = ["--rebuild"] if rebuild else []
    told = curation("index", folder / "data", *options, "--json")
    assert (told.code, len(told.rows)) == (DONE, 5)
    assert "warning: " in told.err
    assert str(spoilt) in told.err


def test_names_and_reasons_are_shown_as_they_are(
    curation: Run, dataset: Dataset, rng: np.random.Generator
) -> None:
    name = "[/red] [bold]x"
    record(dataset, short_episode(rng, 3, name=name))
    curation("override", dataset.path, name, "keep", "--reason", "[/]", "--by", "[/a]")
    for command in ("index", "score"):
        told = curation(command, dataset.path)
        assert told.code == DONE, told.err
        assert name in told.out
    assert "[/a]: [/]" in curation("index", dataset.path).out


def test_empty_dataset_is_an_empty_list(curation: Run, dataset: Dataset) -> None:
    told = curation("index", dataset.path, "--json")
    assert (told.code, told.rows) == (DONE, [])


def test_folder_that_is_no_dataset_is_told(curation: Run, folder: Path) -> None:
    for path in (folder / "none", folder / "curation.yaml"):
        told = curation("index", path, "--json")
        assert (told.code, told.out) == (NOTHING, "")
        assert str(path) in told.err


def test_spoilt_decision_log_is_told_by_its_name(curation: Run, folder: Path) -> None:
    log = folder / "data" / "decisions" / "x.jsonl"
    log.parent.mkdir()
    log.write_text('{"episode": "x"}\n')
    told = curation("index", folder / "data", "--json")
    assert (told.code, told.out) == (NOTHING, "")
    assert str(log) in told.err


def test_quarantined_and_partial_bags_are_not_listed(curation: Run, folder: Path) -> None:
    data = folder / "data"
    bag = next((data / "episodes").glob("*-*"))
    shutil.copytree(bag, data / "quarantine" / bag.name)
    shutil.copytree(bag, data / "episodes" / ".partial" / bag.name)
    assert len(curation("index", data, "--json").rows) == 5
