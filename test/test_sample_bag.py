"""The committed sample bag keeps its scores."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from curation_ros.cli.main import main

_BAGS = Path(__file__).resolve().parents[1] / "bags"
#: Scores are sums over floats whose order a BLAS or FFT of another version may change.
_RELATIVE_TOLERANCE = 1e-9


def test_sample_bag_has_its_golden_scores(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(_BAGS / "sample"), "--json"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    row = json.loads(line)
    golden = json.loads((_BAGS / "sample.scores.json").read_text())
    assert {k: row[k] for k in ("episode", "name", "length", "findings")} == {
        k: golden[k] for k in ("episode", "name", "length", "findings")
    }
    assert row["scores"].keys() == golden["scores"].keys()
    for scorer, score in golden["scores"].items():
        if score is None:
            assert row["scores"][scorer] is None, scorer
        else:
            assert row["scores"][scorer] == pytest.approx(score, rel=_RELATIVE_TOLERANCE), scorer
    assert row["decision"] == "keep"
    assert row["reason"].startswith("object_coupling: ")
