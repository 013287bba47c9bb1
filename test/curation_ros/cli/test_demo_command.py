"""`curation demo`: what it shows for each event, and the whole of it, small, on a graph."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from curation_ros.cli.demo import JsonLines, Screen, compared
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.status import alert_to_status, decision_to_status
from curation_ros.dataset.dataset import Dataset
from curation_ros.demo.events import (
    EVERYTHING,
    KEPT,
    KEPT_AND_SALVAGED,
    Alerted,
    Decided,
    DemoSettings,
    Drawn,
    Driving,
    Finished,
    Recording,
    Selected,
    Training,
)
from curation_ros.demo.run import comparisons

ALL = (EVERYTHING, KEPT, KEPT_AND_SALVAGED)
ALERT = Alerted(
    alert_to_status(
        "id", "demo-3", Finding("object-lost", "bowl left the effector at 8.50 s", (8_500, 8_700))
    )
)
DECIDED = Decided(
    decision_to_status(
        episode_id="id",
        name="demo-3",
        verdict="salvage",
        reason="it fell",
        span=(0, 5),
        revision=1,
        scores={},
    ),
    {"alert_before_s": 2.34, "alert_before_end_s": 8.91},
)


def _result(successes: int, rollouts: int = 10) -> dict[str, Any]:
    return {
        "successes": successes,
        "rollouts": rollouts,
        "rate": successes / rollouts,
        "ci95": [0.0, 1.0],
    }


def _selected(*salvaged_s: float) -> Selected:
    return Selected({}, 2, 3, salvaged_s, {"object_coupling": 3})


@pytest.fixture
def screen(tmp_path: Path) -> Screen:
    return Screen(tmp_path, DemoSettings(train_steps=4000))


def _text(capsys: pytest.CaptureFixture[str]) -> str:
    return " ".join(capsys.readouterr().out.split())


# --- on the screen --------------------------------------------------------------------------


def test_alert_and_decision_are_rows(screen: Screen, capsys: pytest.CaptureFixture[str]) -> None:
    screen.show(ALERT)
    screen.show(DECIDED)
    alert, decision = (" ".join(row.split()) for row in capsys.readouterr().out.splitlines()[:2])
    assert alert == "demo-3 ALERT bowl left the effector at 8.50 s"
    assert decision.startswith("demo-3 salvage it fell (alert 2.3 s ago, 8.9 s before the end")


def test_each_step_begins_with_one_paragraph(
    screen: Screen, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, n in (("", 0), ("demo-1", 0), ("demo-1", 1)):
        screen.show(Recording(name, n))
    screen.show(_selected(8.25))
    for step in (0, 100):
        screen.show(Training(dict.fromkeys(ALL, step)))
    for outcomes in ((), (True,), (True, False)):
        screen.show(Driving(dict.fromkeys(ALL, outcomes)))
    screen.close()
    text = _text(capsys)
    for heading in ("1. Demonstrations.", "2. Selection.", "3. Training.", "4. Test."):
        assert text.count(heading) == 1
    assert "trained on kept + salvaged: 1 succeeded" in text


def test_selection_is_told_in_counts(screen: Screen, capsys: pytest.CaptureFixture[str]) -> None:
    screen.show(_selected(8.0, 8.25, 9.0))
    text = _text(capsys)
    assert "2 of 3 demonstrations are kept whole" in text
    assert "The beginning of 3 more is salvaged, 8.2 s in the median" in text
    assert "Decided by object_coupling (3)" in text


def test_without_salvage_there_is_no_third_policy(
    screen: Screen, capsys: pytest.CaptureFixture[str]
) -> None:
    screen.show(_selected())
    screen.show(Drawn(()))
    screen.show(Finished({EVERYTHING: _result(0), KEPT: _result(9)}))
    text = _text(capsys)
    assert "Nothing is salvaged" in text
    assert "trained on kept + salvaged no policy, because nothing was salvaged" in text
    assert "kept + salvaged against" not in text
    assert "picture" not in text


def test_missing_module_of_the_picture_is_named(
    screen: Screen, capsys: pytest.CaptureFixture[str]
) -> None:
    screen.show(Drawn((), missing="matplotlib"))
    assert "it needs matplotlib: pip install '.[report]'" in _text(capsys)


def test_results_are_compared(
    screen: Screen, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    screen.show(Drawn((tmp_path / "salvaged.png", tmp_path / "salvaged.svg")))
    screen.show(Finished(dict(zip(ALL, map(_result, (0, 8, 9)), strict=True))))
    out = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in out.splitlines()]
    assert [line for line in lines if line.startswith("trained on")] == [
        "trained on everything 0 of 10 (0%, 95 % interval 0% to 100%)",
        "trained on kept 8 of 10 (80%, 95 % interval 0% to 100%)",
        "trained on kept + salvaged 9 of 10 (90%, 95 % interval 0% to 100%)",
    ]
    flat = " ".join(out.split())
    assert "kept against everything: better" in flat
    assert "kept + salvaged against kept: no difference is shown" in flat
    assert f"{tmp_path}/salvaged.png" in "".join(out.split())


@pytest.mark.parametrize(
    ("kept", "everything", "text"),
    [
        (10, 0, "kept against everything: better (p = 1.1e-05"),
        (0, 10, "kept against everything: WORSE: curation did harm here (p = 1.1e-05"),
        (10, 5, "kept against everything: no difference is shown"),
    ],
)
def test_comparison_claims_no_more_than_the_counts_show(
    kept: int, everything: int, text: str
) -> None:
    [one] = comparisons({KEPT: _result(kept), EVERYTHING: _result(everything)})
    assert compared(one).startswith(text)


@pytest.mark.parametrize("option", ["--demonstrations", "--rollouts", "--train-steps"])
def test_size_below_one_is_refused(curation: Any, tmp_path: Path, option: str) -> None:
    told = curation("demo", "--out", str(tmp_path), option, "0")
    assert told.code == 2
    assert (
        told.err
        == f"error: demo: {option.lstrip('-').replace('-', '_')} is 0, expected at least 1\n"
    )
    assert list(tmp_path.iterdir()) == []


# --- as JSON --------------------------------------------------------------------------------


def test_json_has_a_line_per_alert_decision_result_and_picture(
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = JsonLines()
    events = (
        Recording("demo-3", 0),
        ALERT,
        DECIDED,
        _selected(),
        Drawn((Path("a.png"),)),
        Training({KEPT: 1}),
        Driving({KEPT: ()}),
        Finished({KEPT: _result(9)}),
    )
    for event in events:
        lines.show(event)
    alert, decision, result, picture = map(json.loads, capsys.readouterr().out.splitlines())
    assert (alert["alert"], alert["episode"], alert["name"]) == ("object-lost", "id", "demo-3")
    assert (decision["verdict"], decision["alert_before_s"]) == ("salvage", 2.34)
    assert result == {"condition": KEPT, **_result(9)}
    assert picture == {"picture": "a.png"}


# --- the whole ------------------------------------------------------------------------------


@pytest.mark.ros
@pytest.mark.sim
@pytest.mark.policy
def test_the_whole_demo_small(tmp_path: Path, no_process_left: None) -> None:
    for module in ("rclpy", "mujoco", "torch", "matplotlib"):
        pytest.importorskip(module)
    command = [sys.executable, "-m", "curation_ros.cli.main", "demo", "--json"]
    command += ["--out", str(tmp_path), "--demonstrations", "2", "--rollouts", "1"]
    command += ["--train-steps", "20"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    [folder] = tmp_path.iterdir()
    truth = Dataset(folder / "demonstrations").truth()
    [dropped] = [i for i, row in truth.items() if row["defect"] == "early_release"]

    [alert_at] = [k for k, row in enumerate(rows) if "alert" in row]
    alert = rows[alert_at]
    assert (alert["alert"], alert["episode"]) == ("object-lost", dropped)
    decided = {row["episode"]: (k, row) for k, row in enumerate(rows) if "verdict" in row}
    assert set(decided) == set(truth)
    at, salvaged = decided[dropped]
    assert at > alert_at
    assert salvaged["verdict"] == "salvage"
    assert salvaged["alert_before_s"] > 0
    assert salvaged["alert_before_end_s"] > 1
    [clean] = [row for i, (_, row) in decided.items() if i != dropped]
    assert clean["verdict"] == "keep"
    assert "alert_before_s" not in clean

    results = [row for row in rows if "condition" in row]
    assert [row["condition"] for row in results] == list(ALL)
    assert all(row["rollouts"] == 1 for row in results)
    assert len({row["policy"] for row in results}) == len(ALL)
    pictures = [Path(row["picture"]) for row in rows if "picture" in row]
    assert pictures == [folder / "salvaged.png", folder / "salvaged.svg"]
    assert all(p.stat().st_size > 0 for p in pictures)
