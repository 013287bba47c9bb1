from __future__ import annotations

import getpass
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from curation_ros.core.decision.decision import Decision
from curation_ros.dataset.dataset import Dataset

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]


def test_decision_of_a_person_is_logged_and_told(curation: Run, folder: Path) -> None:
    data = folder / "data"
    told = curation(
        "override", data, "pick-2", "keep", "--reason", "it is fine [/b]", "--by", "Ada", "--json"
    )
    assert told.code == DONE
    [row] = told.rows
    decision = Decision.from_json(row)
    assert (decision.name, decision.verdict, decision.by) == ("pick-2", "keep", "Ada")
    assert decision.reason == "Ada: it is fine [/b]"
    assert Dataset(data).latest_decisions()[decision.episode] == decision


def test_user_of_the_machine_decides_where_nobody_is_named(curation: Run, folder: Path) -> None:
    told = curation("override", folder / "data", "pick-2", "review")
    assert told.code == DONE
    assert told.out.startswith("review pick-2 (revision 1): ")
    [decision] = Dataset(folder / "data").latest_decisions().values()
    assert decision.by == getpass.getuser()


def test_person_may_keep_the_beginning_and_later_all_of_it(curation: Run, folder: Path) -> None:
    data = folder / "data"
    told = curation("override", data, "pick-2", "salvage", "--until", 4.15, "--by", "Ada")
    assert told.code == DONE
    assert told.out.startswith("salvage pick-2 (revision 1): Ada decided; kept until 4.15 s of ")
    [row] = curation("select", data, "--json").rows
    [entry] = json.loads(Path(row["manifest"]).read_text())["entries"]
    assert (entry["name"], entry["span"]) == ("pick-2", [0, 4_150_000_000])
    [row] = curation("override", data, "pick-2", "keep", "--json").rows
    assert (row["revision"], row["span"]) == (2, [0, 11_960_000_000])
    [row] = curation("select", data, "--json").rows
    [entry] = json.loads(Path(row["manifest"]).read_text())["entries"]
    assert entry["span"] is None


def test_beginning_of_an_id_is_enough(curation: Run, folder: Path) -> None:
    dataset = Dataset(folder / "data")
    episode_id = dataset.find("pick-3")
    told = curation("override", folder / "data", episode_id[:8], "discard", "--json")
    assert told.rows[0]["episode"] == episode_id


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["nobody", "keep"], NOTHING, "no episode has the id or name 'nobody'; 5 are known"),
        (["", "keep"], NOTHING, "no episode has the id or name ''"),
        (["pick-0", "salvage"], USAGE, "salvage needs --until SECONDS"),
        (["pick-0", "keep", "--until", "3"], USAGE, "--until belongs to salvage"),
        (["pick-0", "salvage", "--until", "soon"], USAGE, "soon"),
        (["pick-0", "salvage", "--until", "nan"], NOTHING, "until nan s: expected from 1 s"),
        (["pick-0", "salvage", "--until", "0.5"], NOTHING, "expected from 1 s to less than 11.96"),
        (["pick-0", "salvage", "--until", "11.96"], NOTHING, "11.96 s, the whole episode"),
        (["pick-0"], USAGE, "verdict"),
        (["pick-0", "keep", "--by", "curator"], NOTHING, "expected the name of a person"),
    ],
)
def test_wrong_override_is_one_line_and_a_code(
    curation: Run, folder: Path, arguments: list[str], code: int, said: str
) -> None:
    told = curation("override", folder / "data", *arguments, "--json")
    assert (told.code, told.out) == (code, "")
    assert said in told.err
    assert not Dataset(folder / "data").latest_decisions()


def test_override_that_cannot_be_written_is_told(curation: Run, folder: Path) -> None:
    (folder / "data" / "decisions").write_text("in the way")
    told = curation("override", folder / "data", "pick-0", "keep", "--json")
    assert (told.code, told.out) == (NOTHING, "")
    assert "internal error" not in told.err


def test_folder_that_is_no_dataset_is_told(curation: Run, folder: Path) -> None:
    told = curation("override", folder / "none", "pick-0", "keep", "--json")
    assert (told.code, told.out) == (NOTHING, "")
