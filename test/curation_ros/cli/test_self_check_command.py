from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from peeking import Peeker

from curation_ros.core.scorers import SCORERS
from curation_ros.dataset.dataset import Dataset

pytestmark = pytest.mark.slow

PROVEN, DIFFERS, USAGE, NOTHING = 0, 1, 2, 3
Run = Callable[..., Any]


@pytest.fixture
def labelled_data(folder: Path) -> Path:
    """The dataset, with a truth for each episode."""
    dataset = Dataset(folder / "data")
    for k, bag in enumerate(dataset.bags()):
        outcome = "succeeded" if k % 2 else "failed"
        dataset.append_truth({"episode": bag.name, "outcome": outcome, "steps": 240})
    return folder / "data"


def test_proof_as_json(curation: Run, folder: Path, labelled_data: Path) -> None:
    options = ["--reference", folder / "reference", "--json"]
    done = curation("self-check", labelled_data, *options)
    assert done.code == PROVEN, done.err
    [row] = done.rows
    assert set(row) == {
        "labels", "overrides", "episodes", "scores", "unreadable", "differences"
    }  # fmt: skip
    assert (row["labels"], row["episodes"], row["differences"]) == (10, 5, 0)
    assert row["scores"] > 5 * 5


def test_proof_as_text(curation: Run, labelled_data: Path) -> None:
    done = curation("self-check", labelled_data)
    assert done.code == PROVEN, done.err
    assert done.out.startswith("flipped 10 labels and 0 decisions of people; compared ")
    assert done.out.endswith("all are equal to the last bit\n")


def test_differences_are_listed_with_code_1(
    curation: Run, labelled_data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCORERS, "peeker", Peeker)
    done = curation("self-check", labelled_data, "--json")
    assert done.code == DIFFERS
    *differences, last = done.rows
    assert last["differences"] == len(differences) >= 5
    assert list(differences[0]) == ["episode", "name", "field", "original", "turned"]
    assert "score/peeker" in {d["field"] for d in differences}
    done = curation("self-check", labelled_data)
    assert done.code == DIFFERS
    assert "score/peeker" in done.out
    assert "something reads labels" in done.out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["data"], NOTHING, "there is no label to flip"),
        (["none"], NOTHING, "no folder 'episodes' in it"),
        (["data", "--config", "none.yaml"], USAGE, "none.yaml"),
        (["data", "--reference", "none"], NOTHING, "none"),
        ([], USAGE, "dataset"),
    ],
)
def test_nothing_to_check_is_one_line_and_a_code(
    curation: Run,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    code: int,
    message: str,
) -> None:
    monkeypatch.chdir(folder)
    if "--reference" in arguments:
        [bag, *_] = Dataset(folder / "data").bags()
        Dataset(folder / "data").append_truth({"episode": bag.name, "outcome": "failed"})
    done = curation("self-check", *arguments, "--json")
    assert (done.code, done.out) == (code, "")
    assert message in done.err
    assert "internal error" not in done.err
