"""A study from its plan to its results, on real simulations that are too short to succeed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import yaml

from curation_ros.core.errors import ConfigError, CurationError

pytestmark = [pytest.mark.sim, pytest.mark.policy]
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from curation_ros.cli.main import main  # noqa: E402 - needs LIBERO
from curation_ros.dataset.dataset import Dataset  # noqa: E402 - as above
from curation_ros.files import append_line  # noqa: E402 - as above
from curation_ros.study.datasets import check_starts  # noqa: E402 - as above
from curation_ros.study.plan import StudyPlan, plan_from  # noqa: E402 - as above
from curation_ros.study.results import results  # noqa: E402 - as above
from curation_ros.study.running import Study, run_study  # noqa: E402 - as above
from curation_ros.study.training_sets import training_set  # noqa: E402 - as above

MAX_STEPS = 5
RAW: dict[str, Any] = {
    "name": "small",
    "question": "which?",
    "max_steps": MAX_STEPS,
    "gradient_steps": 5,
    "budget_steps": 10_000,
    "reference": {"episodes": 2, "seed": 1, "starts": "generated:1:2"},
    "pools": {
        "paired": {
            **{"episodes": 5, "contamination": 0.6, "seed": 2, "starts": "generated:2:2"},
            **{"paired": True, "max_steps_defective": 180},
        }
    },
    "scorers": ["gripper_timing", "knn", "smoothness", "length"],
    "keep_for_audit": 3,
    "stages": [
        {
            **{"name": "look", "kind": "screen", "pools": ["paired"], "variants": ["relative"]},
            **{"seeds": [3, 4], "starts": "generated:3:2"},
            "rows": [
                *("everything", "oracle", "gripper_timing@2", "knn@2", "smoothness@2"),
                *("random@2", "random@2#1", "worst@3", "button%40"),
                *("reference", "reference+knn@2"),
            ],
            "contrasts": [
                {"a": "knn@2", "b": "everything", "pool": "paired", "variant": "relative"},
                {"a": "oracle", "b": "gripper_timing@2", "pool": "paired", "variant": "relative"},
            ],
        }
    ],
}
PLAN = plan_from(RAW)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the datasets are; the first study collects them."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory, data: Path) -> Study:
    return run_study(PLAN, tmp_path_factory.mktemp("study"), data)


@pytest.fixture(scope="module")
def found(study: Study) -> dict[str, Any]:
    made: dict[str, Any] = json.loads(json.dumps(results(study), allow_nan=False))
    return made


def rows_of(found: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {row["row"]: row for row in found["stages"][0]["rows"]}


def test_every_row_has_all_its_counts(found: dict[str, Any]) -> None:
    rows = rows_of(found)
    assert list(rows) == RAW["stages"][0]["rows"]
    for name, row in rows.items():
        seeds = {"random@2#1": ["4"]}.get(name, ["3", "4"])
        assert list(row["outcomes"]) == seeds
        assert all(text == "00" for text in row["outcomes"].values())
        assert [c["n"] for c in row["counts"]] == [2] * len(seeds)
        assert (row["rate"], row["n_missing"]) == (0.0, 0)
        assert row["is_degenerate"]
        assert row["interval"] is None or row["interval"][1] > 0
        assert row["ended"] == {"max_steps": 2 * len(seeds)}
    assert found["problems"] == []


def test_sets_hold_what_their_names_say(study: Study) -> None:
    pool = study.pools["paired"]
    good = {i for i, is_good in pool.good.items() if is_good}
    assert (len(good), len(pool.episodes)) == (2, 5)

    def episodes(row: str, draw: int = 0) -> set[str]:
        made = training_set(pool, row, study.reference, 0, draw)
        assert (made.n_pool, made.n_good) == (
            len({b.name for b, _ in made.bags} & set(pool.episodes)),
            len({b.name for b, _ in made.bags} & good),
        )
        assert all(span is None for _, span in made.bags)
        return {bag.name for bag, _ in made.bags}

    trusted = {bag.name for bag in study.reference.bags()}
    assert episodes("everything") == set(pool.episodes)
    assert episodes("oracle") == episodes("gripper_timing@2") == good
    assert episodes("oracle@4") > good
    assert episodes("worst@3") == set(pool.episodes) - good
    assert episodes("reference") == trusted
    assert episodes("reference+oracle") == trusted | good
    assert len(episodes("button%0") ^ good) == 0
    assert len(episodes("button%40") ^ good) == 2
    draws = [frozenset(episodes("random@2", k)) for k in range(10)]
    assert len(set(draws)) > 1
    assert draws[3] == episodes("random@2#3")
    # A larger draw goes on where the smaller one ended.
    assert all(episodes(f"random@2#{k}") < episodes(f"random@3#{k}") for k in range(10))


def test_equal_sets_are_trained_once(study: Study, found: dict[str, Any]) -> None:
    rows = rows_of(found)
    assert rows["oracle"]["set"] == rows["gripper_timing@2"]["set"]
    trained = [row["policy"] for row in study.trials.rows("policy")]
    assert len(trained) == len(set(trained)) == found["budget"]["policies"]
    assert len(trained) < sum(len(row["outcomes"]) for row in rows.values())
    contrast = found["stages"][0]["contrasts"][1]
    assert (contrast["is_same_set"], contrast["value"]) == (True, 0.0)


def test_rivals_need_no_more_than_the_scorer(found: dict[str, Any]) -> None:
    rows = rows_of(found)
    assert [name for name, row in rows.items() if row["rival"]] == [
        *("gripper_timing@2", "knn@2", "smoothness@2", "reference+knn@2"),
    ]
    assert rows["gripper_timing@2"]["needs"] == ["reference"]
    for row in rows.values():
        if row["rival"] is None:
            continue
        rival = rows_of(found)[row["rival"]["row"]]
        assert "#" not in rival["row"]
        assert set(rival["needs"]) - {"nothing", "dataset"} <= set(row["needs"])
        assert not rival["scorer"]


def test_a_second_run_does_nothing_twice(study: Study, data: Path, found: dict[str, Any]) -> None:
    log = (study.trials.folder / "units.jsonl").read_bytes()
    again = run_study(PLAN, study.trials.folder, data)
    assert (study.trials.folder / "units.jsonl").read_bytes() == log
    fresh = json.loads(json.dumps(results(again)))
    assert {**fresh, "created_at": "", "seconds": []} == {
        **found,
        "created_at": "",
        "seconds": [],
    }


def test_a_study_that_was_killed_goes_on_and_counts_the_same(
    tmp_path: Path, data: Path, study: Study, found: dict[str, Any]
) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump(RAW))
    command = [sys.executable, "-m", "curation_ros.cli.main", "benchmark", "--no-report"]
    command += ["--config", str(plan), "--out", str(tmp_path), "--data", str(data)]
    log = tmp_path / "small" / "units.jsonl"
    run = subprocess.Popen([*command, "--jobs", "2", "--json"], stdout=subprocess.PIPE)
    deadline_s = time.monotonic() + 300
    while not (log.exists() and log.read_bytes().count(b'"rollout"') >= 3):
        assert run.poll() is None, "it was done before it could be killed"
        assert time.monotonic() < deadline_s
        time.sleep(0.02)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    done = subprocess.run([*command, "--json"], capture_output=True, check=True, text=True)
    assert json.loads(done.stdout)["missing"] == 0
    killed = json.loads((tmp_path / "small" / "results.json").read_text())
    for key in ("stages", "pools", "problems"):
        assert killed[key] == found[key]
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    keys = [(row["policy"], row.get("start")) for row in lines if row["kind"] != "declaration"]
    assert len(keys) == len(set(keys))


def test_what_the_budget_does_not_bear_is_missing_and_said(
    tmp_path: Path, data: Path, study: Study
) -> None:
    plan = plan_from({**RAW, "budget_steps": 3 * MAX_STEPS})
    short = results(run_study(plan, tmp_path, data))
    [stage] = short["stages"]
    assert (short["budget"]["rollouts"], short["budget"]["used_steps"]) == (3, 3 * MAX_STEPS)
    # The first row has two seeds from two starts.
    assert [row["n_missing"] for row in stage["rows"]][:2] == [1, 4]
    assert any("15 of 15 steps are used" in problem for problem in short["problems"])
    assert [row for row in stage["rows"] if row["rate"] is None]


# --- bad input ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"reference": {"episodes": 2, "starts": "generated:2:2"}}, "used by reference and by"),
        ({"reference": {"episodes": 2, "starts": "generated:3:2"}}, "'look': start generated-3-0"),
        ({"more": {"episodes": 2, "starts": "generated:1:2"}}, "used by reference and by more"),
        ({"reference": {"episodes": 2, "seeds": 3}}, "dataset 'reference': .*seeds"),
        ({"simulated_task": "dance"}, "simulated task 'dance' is unknown; known: bowl_on_plate"),
    ],
)
def test_starts_that_are_shared_are_refused(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_starts(plan_from({**RAW, **change}))


def test_a_start_is_not_for_choosing_and_for_confirming() -> None:
    stages = [{**RAW["stages"][0]}, {**RAW["stages"][0], "name": "sure", "kind": "confirm"}]
    with pytest.raises(ConfigError, match="used by stages of kind screen and confirm"):
        check_starts(plan_from({**RAW, "stages": stages}))


def test_an_episode_without_an_outcome_is_named(tmp_path: Path, data: Path, study: Study) -> None:
    import shutil

    spoilt = tmp_path / "data"
    shutil.copytree(data, spoilt)
    [name] = [t["name"] for t in Dataset(spoilt / "paired").truth().values()][:1]
    truth = Dataset(spoilt / "paired").truth()
    one = next(i for i, t in truth.items() if t["name"] == name)
    append_line(spoilt / "paired" / "truth.jsonl", {"episode": one, "outcome": "aborted"})
    with pytest.raises(CurationError, match=f"no outcome in truth.jsonl of {name}"):
        run_study(PLAN, tmp_path / "study", spoilt)


def test_a_dry_run_says_how_much_is_done(
    tmp_path: Path, data: Path, study: Study, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump(RAW))
    command = ["benchmark", "--dry-run", "--config", str(plan), "--data", str(data), "--json"]
    assert main([*command, "--out", str(tmp_path)]) == 0
    said = json.loads(capsys.readouterr().out)
    n = len({row["policy"] for row in study.trials.rows("policy")})
    assert said == {"policies": n, "trained": 0, "rollouts": 0}
    assert not (tmp_path / "small" / "results.json").exists()


def test_the_command_names_a_plan_that_is_none(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["benchmark", "--config", str(tmp_path / "none.yaml")]) == 2
    assert "none.yaml: No such file" in capsys.readouterr().err


def test_a_study_of_other_rules_is_not_mixed_in(data: Path, study: Study) -> None:
    plan: StudyPlan = plan_from({**RAW, "gives_up": False})
    with pytest.raises(ConfigError, match="have gives_up True, not False"):
        run_study(plan, study.trials.folder, data)


# --- what the curator decides -------------------------------------------------------------------

CURATED: dict[str, Any] = {
    **RAW,
    "name": "curated",
    "more": {"episodes": 1, "seed": 5, "starts": "generated:5:1"},
    "stages": [
        {
            **RAW["stages"][0],
            "rows": ["decided", "decided+salvaged", "decided+salvaged-5", "decided+random_cut"],
            "contrasts": [],
        },
        {
            **{"name": "sure", "kind": "confirm", "pools": ["paired"], "variants": ["relative"]},
            **{"seeds": [3, 4], "starts": "generated:4:2"},
            "rows": ["decided+salvaged", "oracle+more@1"],
        },
    ],
}


def test_a_study_of_what_is_salvaged_is_run_stage_by_stage(
    tmp_path: Path, data: Path, study: Study
) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(yaml.safe_dump(CURATED))
    command = ["benchmark", "--config", str(plan), "--out", str(tmp_path), "--data", str(data)]
    assert main([*command, "--no-report", "--jobs", "1", "--stage", "look"]) == 0
    found = json.loads((tmp_path / "curated" / "results.json").read_text())
    assert [stage["name"] for stage in found["stages"]] == ["look"]
    assert (found["stages_left_out"], found["problems"]) == (["sure"], [])
    rows = rows_of(found)
    truth = Dataset(data / "paired").truth()
    facts = found["pools"]["paired"]["curator"]
    assert facts["verdicts"]["keep"] == {"good": 2, "defective": 0}
    assert facts["verdicts"]["salvage"] == {"good": 0, "defective": 3}
    assert facts["cut_minus_release"]["max"] < 0
    assert rows["decided+salvaged"]["n_salvaged"] == 3
    assert rows["decided"]["phases"]["RELEASE"]["demonstrations"] == 2
    assert rows["decided+salvaged"]["phases"]["RELEASE"]["demonstrations"] == 2
    assert rows["decided+salvaged"]["phases"]["LIFT"]["demonstrations"] > 2
    for i, (first, last) in rows["decided+salvaged-5"]["spans"].items():
        assert (first, truth[i]["defect"]) == (0, "early_release")
        assert last > rows["decided+salvaged"]["spans"][i][1]
    assert "+" in rows["decided+random_cut"]["set"]
    example = found["salvaged_example"]
    assert (example["pool"], example["decision"]["verdict"]) == ("paired", "salvage")
    assert "bowl_position" in example["fields"]

    assert main([*command, "--no-report", "--jobs", "1"]) == 0
    found = json.loads((tmp_path / "curated" / "results.json").read_text())
    assert (found["stages_left_out"], found["problems"]) == ([], [])
    more = found["stages"][1]["rows"][1]
    assert (more["n"], more["n_pool"], more["n_more"]) == (3, 2, 1)
    trained = [
        json.loads(line)["policy"]
        for line in (tmp_path / "curated" / "units.jsonl").read_text().splitlines()
        if json.loads(line)["kind"] == "policy"
    ]
    assert len(trained) == len(set(trained)) == 10
