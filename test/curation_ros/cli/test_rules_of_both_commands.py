"""`curation score --rule R` and `curation select --rule R` give the same answer."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from streams import record

from curation_ros.core.decision.rules import RULES
from curation_ros.dataset.dataset import Dataset

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]

#: Steps of each episode. It opens three steps before its end, so that its `gripper_timing` is
#: 1 - 3 / steps: 20 -> 0.85, 24 -> 0.875, 30 -> 0.9. None never closes, and has no score.
POOLS: dict[str, tuple[int | None, ...]] = {
    "one": (20,),
    "two": (20, 24),
    "three": (20, 24, 30),
    "four": (20, 24, 30, 60),
    "five, two of them equal": (20, 24, 24, 30, 60),
    "six, all equal": (24,) * 6,
    "six, one without a score": (20, None, 24, 30, 40, 60),
    "two, neither with a score": (None, None),
    "eight in two groups": (8, 8, 8, 8, 200, 200, 200, 200),
}
RULE_OPTIONS: dict[str, tuple[object, ...]] = {
    "best half": ("top-fraction", "--value", 0.5),
    "best tenth": ("top-fraction", "--value", 0.1),
    "all of them as a share": ("top-fraction", "--value", 1),
    "default share": ("top-fraction",),
    "best one": ("top-k", "--value", 1),
    "best five": ("top-k", "--value", 5),
    "default number": ("top-k",),
    "at a score": ("threshold", "--value", 0.875),
    "above all": ("threshold", "--value", 2),
    "groups": ("gap",),
    "groups by another method": ("gap", "--method", "largest-gap"),
}
#: How many are kept, pool by pool; None: the rule has no basis, and nothing is selected.
KEPT: dict[str, tuple[int | None, ...]] = {
    "best half": (1, 1, 2, 2, 3, 3, 3, None, 4),
    "best tenth": (0, 0, 0, 0, 1, 1, 1, None, 1),
    "all of them as a share": (1, 2, 3, 4, 5, 6, 5, None, 8),
    "default share": (1, 2, 2, 3, 4, 5, 4, None, 6),
    "best one": (1, 1, 1, 1, 1, 1, 1, None, 1),
    "best five": (1, 2, 3, 4, 5, 5, 5, None, 5),
    "default number": (1, 2, 3, 4, 5, 6, 5, None, 8),
    "at a score": (0, 1, 2, 3, 4, 6, 4, 0, 4),
    "above all": (0, 0, 0, 0, 0, 0, 0, 0, 0),
    "groups": (None,) * 8 + (4,),
    "groups by another method": (None,) * 8 + (4,),
}


def record_pool(folder: Path, steps: Sequence[int | None]) -> Path:
    rng = np.random.default_rng(1)
    dataset = Dataset(folder, create=True)
    for k, n in enumerate(steps):
        close_at = None if n is None else 2
        record(dataset, make_episode(rng, n or 20, name=f"e{k}", close_at=close_at))
    return folder


@pytest.fixture(scope="module")
def pools(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Name -> dataset; what is logged in it changes no score."""
    folder = tmp_path_factory.mktemp("pools")
    (folder / "curation.yaml").write_text("scorers: [gripper_timing]\nrule: none\n")
    return {name: record_pool(folder / name, steps) for name, steps in POOLS.items()}


def scored(curation: Run, data: Path, options: Sequence[object]) -> list[dict[str, Any]]:
    config = data.parent / "curation.yaml"
    told = curation("score", data, "--config", config, "--rule", *options, "--write", "--json")
    assert told.code == DONE, told.err
    return list(told.rows)


def kept_by_score(rows: Sequence[dict[str, Any]]) -> set[str]:
    return {row["episode"] for row in rows if row["decision"] == "keep"}


def kept_by_select(curation: Run, data: Path, options: Sequence[object]) -> set[str] | str:
    """What is selected, or the error if nothing is."""
    told = curation("select", data, "--scorer", "gripper_timing", "--rule", *options, "--json")
    if told.code != DONE:
        return str(told.err)
    entries = json.loads(Path(told.rows[0]["manifest"]).read_text())["entries"]
    return {entry["episode"] for entry in entries}


@pytest.mark.parametrize("options", RULE_OPTIONS)
@pytest.mark.parametrize("pool", POOLS)
def test_both_commands_keep_the_same_episodes(
    curation: Run, pools: dict[str, Path], pool: str, options: str
) -> None:
    rows = scored(curation, pools[pool], RULE_OPTIONS[options])
    selected = kept_by_select(curation, pools[pool], RULE_OPTIONS[options])
    expected = KEPT[options][list(POOLS).index(pool)]
    if expected is None:
        assert {row["decision"] for row in rows} == {"review"}
        assert isinstance(selected, str)
        if any(row["scores"]["gripper_timing"] is not None for row in rows):
            assert rows[0]["reason"] in selected
        return
    assert selected == kept_by_score(rows)
    assert len(selected) == expected


@pytest.mark.parametrize("options", RULE_OPTIONS)
def test_neither_command_answers_for_an_empty_dataset(
    curation: Run, tmp_path: Path, options: str
) -> None:
    data = record_pool(tmp_path / "empty", ())
    arguments = ["--rule", *RULE_OPTIONS[options], "--json"]
    assert curation("score", data, *arguments).code != DONE
    assert curation("select", data, "--scorer", "gripper_timing", *arguments).code != DONE


@pytest.mark.parametrize("options", [n for n, kept in KEPT.items() if kept[5] is not None])
def test_episode_that_a_person_discards_is_as_if_it_were_not_there(
    curation: Run, pools: dict[str, Path], tmp_path: Path, options: str
) -> None:
    less, more = tmp_path / "less", tmp_path / "more"
    for target in (less, more):
        shutil.copytree(pools["six, one without a score"], target)
    shutil.copy(pools["one"].parent / "curation.yaml", tmp_path)
    best = Dataset(more).find("e5")
    shutil.rmtree(Dataset(less).bag_path(best))
    rows = scored(curation, less, RULE_OPTIONS[options])
    assert curation("override", more, best, "discard", "--by", "Ada").code == DONE
    written = scored(curation, more, RULE_OPTIONS[options])
    selected = kept_by_select(curation, more, RULE_OPTIONS[options])
    assert selected == kept_by_score(rows)
    # A score never reads what a person decided; only the decision in force is the person's.
    assert best not in kept_by_score(written)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("top-k", "--value", 1.5), "rule 'top-k': value is 1.5, expected a whole number from 1"),
        (("top-k", "--value", 0), "rule 'top-k': value is 0.0, expected a whole number from 1"),
        (("top-fraction", "--value", 1.1), "rule 'top-fraction': value is 1.1, expected a share"),
        (("threshold", "--value", "nan"), "rule 'threshold': threshold is nan, expected a finite"),
        (("gap", "--value", 3), "rule 'gap' takes no value, found 3"),
        (("top-k", "--method", "mixture"), "rule 'top-k' takes no method, found 'mixture'"),
        (("gap", "--method", "nose"), "nose"),
        (("nose",), "nose"),
    ],
)
def test_both_commands_refuse_alike(
    curation: Run, pools: dict[str, Path], options: Sequence[object], said: str
) -> None:
    data = pools["three"]
    for told in (
        curation("score", data, "--rule", *options, "--json"),
        curation("select", data, "--scorer", "gripper_timing", "--rule", *options, "--json"),
    ):
        assert (told.code, told.out) == (USAGE, "")
        assert said in told.err


@pytest.mark.parametrize("name", [n for n, rule in RULES.items() if not rule.decides])
def test_rule_that_only_selects_is_refused_by_score(
    curation: Run, pools: dict[str, Path], name: str
) -> None:
    told = curation("score", pools["three"], "--rule", name, "--json")
    assert (told.code, told.out) == (USAGE, "")
    assert f"rule '{name}': " in told.err
    assert "it is for curation select" in told.err


@pytest.mark.parametrize("name", [n for n, rule in RULES.items() if not rule.selects])
def test_rule_that_only_decides_is_refused_by_select(
    curation: Run, pools: dict[str, Path], name: str
) -> None:
    told = curation("select", pools["three"], "--rule", name, "--json")
    assert (told.code, told.out) == (USAGE, "")
    assert f"rule '{name}': " in told.err


def test_both_commands_describe_the_same_rules(curation: Run) -> None:
    texts = [" ".join(curation(command, "--help").out.split()) for command in ("score", "select")]
    for name, rule in RULES.items():
        for text in texts:
            assert f"{name}: {rule.summary}".replace("%", "%%") in text.replace("- ", "-")
