from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from made_study import made_results, small_plan  # noqa: E402 - needs LIBERO

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    path = folder / "results.json"
    path.write_text(json.dumps(made_results(folder, small_plan(), share=0.9)))
    return path


def test_the_report_is_written_where_it_is_asked_for(
    curation: Run, results: Path, tmp_path: Path
) -> None:
    answer = curation("report", results, "--out", tmp_path / "out")
    assert answer.code == DONE
    assert answer.out.splitlines()[0] == str(tmp_path / "out" / "report.html")
    assert {p.name for p in (tmp_path / "out").iterdir()} >= {"report.html", "report.md"}
    assert "outcomes are missing; the report names them" in answer.out


@pytest.mark.parametrize("of", ["folder", "file"])
def test_the_report_is_written_to_the_folder_of_the_results(
    curation: Run, results: Path, of: str
) -> None:
    answer = curation("report", results if of == "file" else results.parent, "--json")
    assert answer.code == DONE
    [row] = answer.rows
    assert row["report"] == str(results.parent / "report.html")
    assert all(Path(p).is_file() for p in row["written"])
    found = json.loads(results.read_text())
    assert row["missing"] == sum(s["missing"] for s in found["stages"]) > 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("{", "not JSON"),
        ("[1]", "no results of a study"),
        ('{"format": 99}', "results of format 99"),
        ('{"format": 1, "name": NaN}', "NaN is no JSON"),
    ],
)
def test_wrong_results_are_refused_in_one_line(
    curation: Run, tmp_path: Path, text: str, complaint: str
) -> None:
    path = tmp_path / "results.json"
    path.write_text(text)
    answer = curation("report", path)
    assert answer.code == USAGE
    assert answer.err.startswith(f"error: {path}: ")
    assert complaint in answer.err
    assert len(answer.err.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == [path]


def test_a_missing_file_is_named(curation: Run, tmp_path: Path) -> None:
    answer = curation("report", tmp_path / "none.json")
    assert answer.code == NOTHING
    assert str(tmp_path / "none.json") in answer.err
    assert len(answer.err.splitlines()) == 1
