from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from other_packages import install

from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS, registry
from curation_ros.version import __version__

Run = Callable[..., Any]

CODE = '''
from curation_ros.core.scorers import Look, Scorer


class Steady(Scorer):
    """How evenly the arm moves.

    In more words.
    """

    needs = "reference"
    version = 4
    choices = {"over": ("all", "arm")}

    def __init__(self, *, over: str = "all", limit: float = float("inf")) -> None:
        self.over = over
        self.limit = limit

    def look(self, episode):
        return Look(1.0)
'''


def test_ours_are_listed_with_what_each_needs(curation: Run) -> None:
    rows = curation("scorers", "--json").rows
    assert [row["scorer"] for row in rows] == list(SCORERS)
    for row in rows:
        scorer = SCORERS[row["scorer"]]()
        assert row["needs"] == scorer.needs
        assert row["version"] == scorer.version
        assert row["package"] == f"curation_ros {__version__}"
        assert row["is_default"] == (row["scorer"] in DEFAULT_SCORERS)
        assert row["is_length_controlled"] == scorer.length_controlled
        assert {k: p["default"] for k, p in row["parameters"].items()} == scorer.params()
        assert row["summary"].endswith(".")


def test_list_for_people_has_the_same(curation: Run) -> None:
    told = curation("scorers")
    assert (told.code, told.err) == (0, "")
    for name, kind in SCORERS.items():
        assert f"\n{name}: " in f"\n{told.out}"
        for key, value in kind().params().items():
            assert f"{key}={value}" in told.out
    assert "  needs object pose, version 2, package curation_ros" in told.out


def test_other_packages_are_listed_and_bad_ones_named(
    curation: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    offered = {"steady": "hand_scorers:Steady", "lost": "hand_scorers:Lost"}
    folder = install(tmp_path, "hand-scorers", {"curation_ros.scorers": offered}, CODE)
    monkeypatch.syspath_prepend(str(folder))
    registry._foreign.cache_clear()
    try:
        told = curation("scorers", "--json")
    finally:
        registry._foreign.cache_clear()
        sys.modules.pop("hand_scorers", None)
    assert told.code == 2
    assert "package hand-scorers 0.3: scorer 'lost': AttributeError" in " ".join(told.err.split())
    assert [row["scorer"] for row in told.rows] == [*SCORERS, "steady"]
    assert told.rows[-1] == {
        "scorer": "steady",
        "package": "hand-scorers 0.3",
        "needs": "reference",
        "version": 4,
        "is_default": False,
        "is_length_controlled": True,
        "resolution": 0.0,
        "parameters": {
            "over": {"default": "all", "choices": ["all", "arm"]},
            "limit": {"default": "inf", "choices": []},
        },
        "summary": "How evenly the arm moves.",
    }
