from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from curation_ros.core.selection import KEEP_RULES
from curation_ros.dataset import Dataset

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]


@pytest.fixture
def data(curation: Run, folder: Path) -> Path:
    """The dataset with its decisions written."""
    options = ["--reference", folder / "reference", "--config", folder / "curation.yaml"]
    told = curation("score", folder / "data", *options, "--write", "--json")
    assert told.code == DONE
    return folder / "data"


def _names(path: str) -> list[str]:
    return [entry["name"] for entry in json.loads(Path(path).read_text())["entries"]]


def test_selection_is_written_and_told(curation: Run, data: Path) -> None:
    told = curation("select", data, "--json")
    assert told.code == DONE
    [row] = told.rows
    assert list(row) == ["manifest", "kept", "of"]
    assert (row["kept"], row["of"]) == (2, 5)
    assert Path(row["manifest"]).parent == data / "selections"
    assert sorted(_names(row["manifest"])) == ["pick-0", "pick-1"]


def test_selection_is_told_to_people(curation: Run, data: Path) -> None:
    told = curation("select", data, "--name", "mine")
    path = data / "selections" / "mine.json"
    assert " ".join(told.out.split()).startswith("kept 2 of 5: ")
    assert str(path) in told.out
    told = curation("select", data, "--rule", "top-k", "--value", 1, "--scorer", "knn")
    assert "kept 1 of 5" in told.out


def test_every_rule_can_be_asked_for(curation: Run, data: Path) -> None:
    values = {"top-k": "3", "top-fraction": "0.4", "threshold": "0.9"}
    for rule in KEEP_RULES:
        options = ["--scorer", "gripper_timing", "--value", values[rule]] if rule in values else []
        if rule == "gap":
            told = curation("select", data, "--rule", rule, "--scorer", "gripper_timing")
            assert told.code == 2
            assert "no two groups" in told.err
            assert "5 scores are too few" in told.err
            continue
        told = curation("select", data, "--rule", rule, *options, "--json")
        assert told.code == DONE, told.err
        expected = {"decisions": 2, "all": 5, "top-k": 3, "top-fraction": 2, "threshold": 3}
        assert told.rows[0]["kept"] == expected[rule]


def test_seed_orders_equal_scores(curation: Run, data: Path) -> None:
    options = ["--rule", "top-k", "--value", 2, "--scorer", "length", "--json"]
    chosen = {
        tuple(_names(curation("select", data, *options, "--seed", seed).rows[0]["manifest"]))
        for seed in range(8)
    }
    assert len(chosen) > 1


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["--rule", "nose"], USAGE, "nose"),
        (["--rule", "top-k"], USAGE, "ranks by a scorer"),
        (["--rule", "top-k", "--scorer", "knn"], USAGE, "value None"),
        (["--rule", "top-k", "--scorer", "knn", "--value", "9"], USAGE, "only 5 of 5"),
        (["--rule", "top-k", "--scorer", "knn", "--value", "many"], USAGE, "many"),
        (["--rule", "all", "--value", "3"], USAGE, "value 3.0"),
        (["--rule", "top-k", "--scorer", "nose", "--value", "1"], USAGE, "--write"),
        (["--name", "../evil"], USAGE, "../evil"),
        (["--name", "taken"], NOTHING, "taken.json exists"),
    ],
)
def test_wrong_selection_is_one_line_and_a_code(
    curation: Run, data: Path, arguments: list[str], code: int, said: str
) -> None:
    curation("select", data, "--name", "taken")
    told = curation("select", data, *arguments, "--json")
    assert (told.code, told.out) == (code, "")
    assert said in told.err
    assert "fault of ours" not in told.err


def test_folder_that_is_no_dataset_is_told(curation: Run, folder: Path) -> None:
    for path in (folder / "none", folder / "curation.yaml", folder):
        told = curation("select", path, "--json")
        assert (told.code, told.out) == (NOTHING, "")
        assert f"dataset {path}" in told.err


def test_selection_is_in_the_index(curation: Run, data: Path) -> None:
    curation("select", data, "--name", "mine")
    [row] = Dataset(data).rows("SELECT name, kept, total FROM selections")
    assert tuple(row) == ("mine", 2, 5)
