from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from streams import record, short_episode

from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.rules import RULES
from curation_ros.dataset.dataset import Dataset

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
    assert list(row) == ["manifest", "kept", "of", "rule", "phases", "warnings"]
    assert (row["kept"], row["of"], row["rule"]) == (2, 5, "decisions")
    assert row["phases"] == json.loads(Path(row["manifest"]).read_text())["phases"]
    assert row["phases"]["shown"]["RELEASE"]["demonstrations"] == 2
    assert row["warnings"] == []
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
    for rule in (name for name, kind in RULES.items() if kind.selects):
        options = ["--scorer", "gripper_timing", "--value", values[rule]] if rule in values else []
        if rule == "gap":
            told = curation("select", data, "--rule", rule, "--scorer", "gripper_timing")
            assert told.code == NOTHING
            assert "the rule needs 8 scored episodes; there are 4" in told.err
            continue
        told = curation("select", data, "--rule", rule, *options, "--json")
        assert told.code == DONE, told.err
        expected = {"decisions": 2, "all": 5, "top-k": 3, "top-fraction": 2, "threshold": 2}
        assert told.rows[0]["kept"] == expected[rule]


def test_scorer_without_a_rule_that_does_not_separate_selects_nothing(
    curation: Run, data: Path
) -> None:
    told = curation("select", data, "--scorer", "gripper_timing", "--json")
    assert (told.code, told.out) == (NOTHING, "")
    assert "rule 'gap': the rule needs 8 scored episodes; there are 4; " in told.err
    assert (
        "nothing is selected: have a person review the episodes, or choose by another" in told.err
    )
    assert not (data / "selections").exists()


def test_scorer_without_a_rule_keeps_the_upper_group(curation: Run, data: Path) -> None:
    dataset = Dataset(data)
    rng = np.random.default_rng(1)
    for k in range(7):
        episode = short_episode(rng, name=f"more-{k}")
        record(dataset, episode)
        dataset.append_decision(
            Decision(episode.id, episode.name, "review", "r", (0, 1), {"gripper_timing": 0.1})
        )
    told = curation("select", data, "--scorer", "gripper_timing", "--json")
    assert told.code == DONE, told.err
    assert told.rows[0]["rule"] == "gap"
    assert not any(name.startswith("more") for name in _names(told.rows[0]["manifest"]))


def test_phase_that_few_show_is_a_warning(curation: Run, data: Path) -> None:
    dataset = Dataset(data)
    for name in ("pick-0", "pick-1"):
        episode_id = dataset.find(name)
        decision = dataset.latest_decisions()[episode_id]
        cut = replace(decision, verdict="salvage", span=(0, 6_500_000_000))
        dataset.append_decision(cut)
    said = "is shown by 0 of 2 demonstrations kept: a policy sees little of it"
    [row] = curation("select", data, "--json").rows
    assert [line.split()[0] for line in row["warnings"]] == ["TRANSPORT", "RELEASE"]
    assert all(said in line for line in row["warnings"])
    assert row["phases"]["shown"]["TRANSPORT"] == {"demonstrations": 0, "steps": 0}
    told = curation("select", data)
    assert "kept 2 of 5, 2 of them in part: " in told.out
    assert "phases shown by 2 demonstrations: PREGRASP 2" in told.out
    assert f"warning: RELEASE {said}" in told.err
    told = curation("select", data, "--rule", "all")
    assert "2 of these are marked salvage: this selection keeps them whole" in told.out


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
        (["--rule", "top-k"], USAGE, "reads the scores of a scorer"),
        (["--rule", "all", "--scorer", "knn"], USAGE, "reads no scores"),
        (["--rule", "threshold", "--scorer", "knn"], USAGE, "give --value"),
        (["--rule", "top-k", "--scorer", "knn", "--value", "many"], USAGE, "many"),
        (["--rule", "all", "--value", "3"], USAGE, "takes no value, found 3"),
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
    assert "internal error" not in told.err


def test_folder_that_is_no_dataset_is_told(curation: Run, folder: Path) -> None:
    for path in (folder / "none", folder / "curation.yaml", folder):
        told = curation("select", path, "--json")
        assert (told.code, told.out) == (NOTHING, "")
        assert f"dataset {path}" in told.err
