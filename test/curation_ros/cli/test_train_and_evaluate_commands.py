from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

DONE, USAGE, NOTHING = 0, 2, 3
Run = Callable[..., Any]


def _selection(curation: Run, folder: Path) -> Path:
    [row] = curation("select", folder / "data", "--rule", "all", "--json").rows
    return Path(row["manifest"])


@pytest.mark.parametrize("content", [None, "{", "", "5", "{}", "not json"])
def test_selection_that_is_none_is_refused(
    curation: Run, folder: Path, content: str | None
) -> None:
    path = folder / "data" / "selections" / "bad.json"
    if content is not None:
        path.parent.mkdir()
        path.write_text(content)
    answer = curation("train", "--selection", path, "--json")
    assert (answer.code, answer.out) == (USAGE, "")
    assert str(path) in answer.err
    assert len(answer.err.splitlines()) == 1


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        ({"entries": [{"episode": "nobody", "name": "x", "span": None}]}, NOTHING, "nobody"),
        ({"entries": []}, USAGE, "nothing to train on"),
        ({"entries": [{"episode": "a", "name": "x", "span": [5, 1]}]}, USAGE, "span (5, 1)"),
        ({"name": "../evil"}, USAGE, "../evil"),
        ({"kept_of": "many"}, USAGE, "many"),
    ],
)
def test_selection_that_makes_no_sense_is_refused(
    curation: Run, folder: Path, change: dict[str, Any], code: int, words: str
) -> None:
    path = _selection(curation, folder)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    answer = curation("train", "--selection", path, "--json")
    assert (answer.code, answer.out) == (code, "")
    assert words in answer.err
    assert len(answer.err.splitlines()) == 1


@pytest.mark.parametrize("content", [None, "{", "5", "{}"])
def test_policy_that_is_none_is_refused(
    curation: Run, tmp_path: Path, content: str | None
) -> None:
    pytest.importorskip("safetensors")
    folder = tmp_path / "policy"
    if content is not None:
        folder.mkdir()
        (folder / "card.json").write_text(content)
    answer = curation("evaluate", "--policy", folder, "--json")
    assert (answer.code, answer.out) == (NOTHING, "")
    assert str(folder) in answer.err
    assert len(answer.err.splitlines()) == 1


@pytest.mark.policy
def test_path_from_bags_to_a_policy(curation: Run, folder: Path) -> None:
    pytest.importorskip("torch")
    path = _selection(curation, folder)
    answer = curation("train", "--selection", path, "--steps", 5, "--seed", 3, "--json")
    assert answer.code == DONE, answer.err
    [row] = answer.rows
    assert list(row) == ["policy", "loss", "steps", "seconds", "variant", "clipped"]
    assert (row["steps"], row["variant"]) == (5, "relative")
    assert list(row["clipped"]) == ["twist"]
    card = json.loads((Path(row["policy"]) / "card.json").read_text())
    manifest = json.loads(path.read_text())
    assert Path(row["policy"]).parent == folder / "data" / "policies"
    assert card["selection_name"] == manifest["name"]
    assert sorted(e["id"] for e in card["episodes"]) == sorted(
        e["episode"] for e in manifest["entries"]
    )
    for arguments, words in (
        (["--steps", "0"], "steps"),
        (["--variant", "nose"], "nose"),
        (["--seed", "-1"], "seed"),
        (["--out", row["policy"]], row["policy"]),
        (["--out", path / "x"], str(path)),
        (["--report", path / "x"], str(path)),
    ):
        wrong = curation("train", "--selection", path, "--steps", "5", *arguments, "--json")
        assert wrong.code in (USAGE, NOTHING), wrong.err
        assert (wrong.out, len(wrong.err.splitlines())) == ("", 1)
        assert words in wrong.err


@pytest.mark.sim
@pytest.mark.policy
def test_starts_that_make_no_sense_are_refused(curation: Run, folder: Path) -> None:
    pytest.importorskip("torch")
    pytest.importorskip("mujoco")
    path = _selection(curation, folder)
    [row] = curation("train", "--selection", path, "--steps", 2, "--json").rows
    for starts in ("nonsense", "official:0:0", "official:0:51", "0:50", "", "official:5:2"):
        answer = curation("evaluate", "--policy", row["policy"], "--starts", starts, "--json")
        assert (answer.code, answer.out) == (USAGE, ""), starts
        assert f"starts {starts!r}" in answer.err
    other = ["--simulated-task", "dance", "--json"]
    answer = curation("evaluate", "--policy", row["policy"], *other)
    assert (answer.code, answer.out) == (USAGE, "")
    assert answer.err.startswith(
        "error: simulated task 'dance' is unknown; known: bowl_on_plate, "
    )
    for more in ([], ["--graph"]):
        steps = ["--starts", "official:0:1", "--max-steps", "0", *more]
        answer = curation("evaluate", "--policy", row["policy"], *steps, "--json")
        assert (answer.code, answer.out) == (USAGE, "")
        assert answer.err == "error: --max-steps 0: expected 1 to 100000\n"
