"""Plans of studies: what they may contain, and what is refused before any work is done."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import yaml

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS
from curation_ros.study.plan import plan_from, read_plan
from curation_ros.study.terms import parse_row

CONFIG = Path(__file__).parents[3] / "config"

RAW: dict[str, Any] = {
    "name": "small",
    "question": "which?",
    "reference": {"episodes": 2},
    "pools": {"paired": {"episodes": 4}},
    "scorers": ["knn", "length"],
    "stages": [
        {
            "name": "look",
            "kind": "screen",
            "pools": ["paired"],
            "variants": ["relative"],
            "seeds": [1, 2, 3],
            "starts": "generated:1:2",
            "rows": ["everything", "knn@{2,3}", "random@2#{0..3}"],
        }
    ],
}


def changed(change: Callable[[dict[str, Any]], None]) -> dict[str, Any]:
    raw = deepcopy(RAW)
    change(raw)
    return raw


@pytest.mark.parametrize("name", ["paper", "question", "salvage"])
def test_plans_of_the_repository_are_valid(name: str) -> None:
    plan = read_plan(CONFIG / f"{name}.yaml")
    assert plan.name == name
    assert all(stage.cells() for stage in plan.stages)


def test_the_paper_protocol_is_that_of_the_paper() -> None:
    [stage] = read_plan(CONFIG / "paper.yaml").stages
    assert stage.seeds == (42, 0, 7)
    assert {t.keep for r in stage.rows for t in parse_row(r)} == {None, 60}
    # Two pools, two variants, and ten conditions: seven metrics, length, everything, oracle.
    assert len(stage.cells()) == 2 * 2 * 10


def test_braces_expand_to_several_rows() -> None:
    [stage] = plan_from(RAW).stages
    assert stage.rows[:3] == ("everything", "knn@2", "knn@3")
    assert stage.rows[3:] == tuple(f"random@2#{k}" for k in range(4))
    # A draw has one of the seeds, and draws share them out.
    assert [stage.seeds_of(r) for r in stage.rows[3:]] == [(1,), (2,), (3,), (1,)]
    assert stage.seeds_of("random@2") == stage.seeds_of("knn@2") == (1, 2, 3)


def test_sets_of_contrasts_are_cells_and_none_is_there_twice() -> None:
    contrast = {"a": "knn@2", "b": "reference", "pool": "paired", "variant": "relative"}
    raw = changed(lambda r: r["stages"][0].update(contrasts=[contrast]))
    cells = plan_from(raw).stages[0].cells()
    assert cells[-1] == ("paired", "relative", "reference")
    assert len(set(cells)) == len(cells) == 8


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r.pop("pools"), "plan: no key 'pools'"),
        (lambda r: r.update(speed=3), "unknown key 'speed'; known are name, question"),
        (lambda r: r.update(name="a/b"), "name 'a/b'"),
        (lambda r: r.update(scorers=["knm"]), "no scorer 'knm'"),
        (lambda r: r.update(scorers="knn"), "scorers is 'knn', expected a list of names"),
        (lambda r: r["stages"][0].pop("seeds"), "stage: no key 'seeds'"),
        (lambda r: r["stages"][0].update(seeds=[1, 1]), "expected at least one, each only once"),
        (lambda r: r["stages"][0].update(kind="final"), "kind 'final' is none of protocol"),
        (lambda r: r["stages"][0].update(pools=["other"]), "no pool 'other'; there are paired"),
        (lambda r: r["stages"][0].update(rows=["knn@5"]), "keeps more than the 4 of paired"),
        (
            lambda r: r["stages"][0].update(rows=["entropy@2"]),
            "entropy is none of the plan's scorers",
        ),
        (lambda r: r["stages"][0].update(rows=[3]), "row 3: expected a text"),
        (lambda r: r["stages"].append(r["stages"][0]), "two of them have the same name"),
        (lambda r: r["stages"][0].update(contrasts=[{"a": "oracle"}]), "contrast: no key 'b'"),
        (lambda r: r["stages"][0].update(draw_seeds=4), "draw_seeds 4 of 3 seeds"),
        (lambda r: r["stages"][0].update(rows=["more@2"]), "the plan has no dataset 'more'"),
        (
            lambda r: (r.update(more={"episodes": 2}), r["stages"][0].update(rows=["more@3"])),
            "keeps more than the 2 of more",
        ),
        (lambda r: r["pools"].update(more={"episodes": 2}), "a pool cannot be called 'more'"),
    ],
)
def test_invalid_plans_are_refused(
    tmp_path: Path, change: Callable[[dict[str, Any]], None], message: str
) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(changed(change)))
    with pytest.raises(ConfigError, match=message) as caught:
        read_plan(path)
    assert str(path) in str(caught.value)


def test_too_many_contrasts_are_refused() -> None:
    one = {"a": "oracle", "b": "everything", "pool": "paired", "variant": "relative"}
    with pytest.raises(ConfigError, match="13 contrasts, at most 12"):
        plan_from(changed(lambda r: r["stages"][0].update(contrasts=[one] * 13)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "is not YAML, line 1"),
        ("- 1", "expected a mapping"),
        (None, "No such file"),
    ],
)
def test_files_without_a_plan_are_named(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "plan.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_plan(path)


def test_a_plan_without_scorers_takes_all() -> None:
    assert plan_from(changed(lambda r: r.pop("scorers"))).scorers == tuple(SCORERS)


def test_every_change_of_a_plan_changes_its_hash() -> None:
    other = changed(lambda r: r["stages"][0].update(seeds=[1, 2, 4]))
    assert plan_from(RAW).hash == plan_from(deepcopy(RAW)).hash != plan_from(other).hash


def test_salvage_plan_chooses_the_margin_before_its_twelve_contrasts() -> None:
    margins, confirmation = read_plan(CONFIG / "salvage.yaml").stages
    assert (margins.kind, len(margins.contrasts)) == ("screen", 0)
    assert (confirmation.kind, len(confirmation.contrasts)) == ("confirm", 12)
    assert "official" not in margins.starts
    # Contrasts add no training set to those that are listed; independent starts come first.
    assert len(confirmation.cells()) == 4 * len(confirmation.rows)
    pools = list(dict.fromkeys(pool for pool, _, _ in confirmation.cells()))
    assert pools == ["independent_16", "independent_6", "paired_16", "paired_6"]


def test_plan_with_only_some_stages_has_only_their_pools() -> None:
    plan = read_plan(CONFIG / "salvage.yaml")
    some = plan.only(["margins"])
    assert [stage.name for stage in some.stages] == ["margins"]
    assert list(some.pools) == ["independent_16", "independent_6"]
    assert some.hash == plan.hash
    with pytest.raises(ConfigError, match="no stage 'margin'; there are margins, confirmation"):
        plan.only(["margin"])
