"""`curation demo`: what it selects, shows and claims; and the whole of it, small, on a graph."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from streams import record

from curation_ros.cli.demo import _compared, _Demo, _lead
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.status import (
    EpisodeEvent,
    Status,
    alert_to_status,
    decision_to_status,
)
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_manifest

ALL = ("everything", "kept", "kept-and-salvaged")
DROPS_AT = 140


def _demo(folder: Path, as_json: bool = False) -> _Demo:
    return _Demo(argparse.Namespace(json=as_json), folder)


def _demonstrated(folder: Path, *open_at: int, salvage: bool = True) -> dict[str, Decision]:
    """What the demo leaves behind of such episodes, bags and decisions; decisions by name."""
    rng = np.random.default_rng(5)
    curation = Curation(
        scorers=["object_coupling", "grip_consistency", "phase_events", "gripper_timing"],
        salvage_margin_s=0.75 if salvage else None,
    ).fit([])
    dataset = Dataset(folder / "demonstrations", create=True)
    decisions = {}
    for k, step in enumerate(open_at):
        episode = make_episode(rng, name=f"demo-{k}", open_at=step)
        record(dataset, episode)
        decisions[episode.name] = curation.decide(episode)
        dataset.append_decision(decisions[episode.name])
    return decisions


def _result(successes: int, rollouts: int = 10) -> dict[str, Any]:
    return {
        "successes": successes,
        "rollouts": rollouts,
        "rate": successes / rollouts,
        "ci95": [0.0, 1.0],
    }


# --- selecting ------------------------------------------------------------------------------


def test_three_selections_differ_by_what_was_discarded_and_salvaged(tmp_path: Path) -> None:
    decisions = _demonstrated(tmp_path, -1, DROPS_AT, -1)
    manifests = _demo(tmp_path).select()
    assert tuple(manifests) == ALL
    found = {
        name: {e.name: e.span for e in read_manifest(path)[0].entries}
        for name, path in manifests.items()
    }
    assert found["everything"] == {"demo-0": None, "demo-1": None, "demo-2": None}
    assert found["kept"] == {"demo-0": None, "demo-2": None}
    assert found["kept-and-salvaged"] == {**found["kept"], "demo-1": decisions["demo-1"].span}


def test_selection_says_how_much_is_salvaged_and_what_decided(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    decisions = _demonstrated(tmp_path, -1, DROPS_AT, -1)
    _demo(tmp_path).select()
    first_ns, last_ns = decisions["demo-1"].span
    said = " ".join(capsys.readouterr().out.split())
    assert "2 of 3 demonstrations are kept whole" in said
    assert f"of 1 more the beginning is salvaged, {(last_ns - first_ns) / 1e9:.1f} s" in said
    assert "object_coupling (3)" in said


def test_without_anything_salvaged_there_is_no_third_selection(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _demonstrated(tmp_path, -1, DROPS_AT, salvage=False)
    demo = _demo(tmp_path)
    assert tuple(demo.select()) == ALL[:2]
    demo.draw()
    assert demo.pictures == ()
    demo.conclude({"everything": _result(0), "kept": _result(9)}, 60.0)
    said = " ".join(capsys.readouterr().out.split())
    assert "nothing is salvaged" in said
    assert "trained on kept + salvaged nothing was salvaged, so there is no such policy" in said
    assert "kept + salvaged against" not in said
    assert "picture" not in said


def test_nothing_kept_ends_the_demo(tmp_path: Path) -> None:
    _demonstrated(tmp_path, DROPS_AT, DROPS_AT)
    with pytest.raises(CurationError, match="kept nothing"):
        _demo(tmp_path).select()


def test_the_picture_is_of_the_first_that_was_salvaged(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    _demonstrated(tmp_path, -1, DROPS_AT, DROPS_AT - 5)
    demo = _demo(tmp_path)
    demo.draw()
    assert demo.pictures == (tmp_path / "salvaged.png", tmp_path / "salvaged.svg")
    assert demo.pictures[0].stat().st_size > 0
    svg = demo.pictures[1].read_text()
    assert "demo-1: salvage" in svg


# --- what is shown --------------------------------------------------------------------------


def test_alert_and_decision_are_rows_of_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lost = Finding("object-lost", "bowl left the effector at 8.50 s in LIFT", (8_500, 8_700))
    demo = _demo(tmp_path)
    bar = demo._progress()
    demo._show_alert(bar, alert_to_status("id", "demo-3", lost))
    decision = decision_to_status(
        episode_id="id",
        name="demo-3",
        verdict="salvage",
        reason="it fell",
        span=(0, 5),
        revision=1,
        scores={},
    )
    demo._show_decision(bar, decision, {"alert_before_s": 2.34, "alert_before_end_s": 8.91})
    alert, told = (" ".join(row.split()) for row in capsys.readouterr().out.splitlines()[:2])
    assert alert == "demo-3 ALERT bowl left the effector at 8.50 s in LIFT"
    assert told.startswith("demo-3 salvage it fell (alert 2.3 s ago, 8.9 s before the end")


def test_an_alert_leads_by_the_wall_clock_and_by_the_clock_of_the_episode() -> None:
    start_ns = 1_000_000_000_000
    alert = Status(2, "demo-1", "object-lost", "id", {"span_end": "8750000000"})
    end = EpisodeEvent("id", "demo-1", "ended", start_ns, start_ns + 17_450_000_000)
    assert _lead(alert, 2.5, end) == {"alert_before_s": 2.5, "alert_before_end_s": 8.7}
    assert _lead(alert, 2.5, None) == {"alert_before_s": 2.5}


@pytest.mark.parametrize(
    ("kept", "everything", "said"),
    [
        (10, 0, "kept against everything: better (p = 1.1e-05"),
        (0, 10, "kept against everything: WORSE, it did harm here (p = 1.1e-05"),
        # Below 0.05, but there are two comparisons.
        (10, 5, "kept against everything: no difference is shown"),
        (3, 3, "kept against everything: no difference is shown"),
    ],
)
def test_no_more_is_claimed_than_the_counts_can_bear(
    kept: int, everything: int, said: str
) -> None:
    results = {"kept": _result(kept), "everything": _result(everything)}
    assert _compared("kept", "everything", results).startswith(said)


def test_the_end_compares_with_everything_and_with_what_was_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    demo = _demo(tmp_path)
    demo.pictures = (tmp_path / "salvaged.png", tmp_path / "salvaged.svg")
    demo.conclude(dict(zip(ALL, map(_result, (0, 8, 9)), strict=True)), 60.0)
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
