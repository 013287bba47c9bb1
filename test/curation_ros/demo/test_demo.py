"""What the demo selects, draws and compares. The whole of it runs in test_demo_command.py."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from decided import decide_on
from episodes import make_episode
from streams import record

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.status import EpisodeEvent, Status
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_manifest
from curation_ros.demo.events import EVERYTHING, KEPT, KEPT_AND_SALVAGED, Drawn
from curation_ros.demo.run import comparisons, draw, lead_of, select

DROPS_AT = 140


def _demonstrated(path: Path, *open_at: int, salvage: bool = True) -> dict[str, Decision]:
    """Bags and decisions of episodes that open the gripper at these steps; decisions by name."""
    rng = np.random.default_rng(5)
    curation = Curation.fit(
        CurationSettings(
            scorers=["object_coupling", "grip_consistency", "phase_events", "gripper_timing"],
            salvage_margin_s=0.75 if salvage else None,
        )
    )
    dataset = Dataset(path, create=True)
    decisions = {}
    for k, step in enumerate(open_at):
        episode = make_episode(rng, name=f"demo-{k}", open_at=step)
        record(dataset, episode)
        decisions[episode.name] = decide_on(curation, episode)
        dataset.append_decision(decisions[episode.name])
    return decisions


# --- selecting ------------------------------------------------------------------------------


def test_selections_differ_by_discarded_and_salvaged_episodes(tmp_path: Path) -> None:
    decisions = _demonstrated(tmp_path, -1, DROPS_AT, -1)
    manifests = select(tmp_path).manifests
    assert tuple(manifests) == (EVERYTHING, KEPT, KEPT_AND_SALVAGED)
    found = {
        name: {e.name: e.span for e in read_manifest(path)[0].entries}
        for name, path in manifests.items()
    }
    assert found[EVERYTHING] == {"demo-0": None, "demo-1": None, "demo-2": None}
    assert found[KEPT] == {"demo-0": None, "demo-2": None}
    assert found[KEPT_AND_SALVAGED] == {**found[KEPT], "demo-1": decisions["demo-1"].span}


def test_selection_counts_kept_and_salvaged_episodes_and_deciding_scorers(tmp_path: Path) -> None:
    decisions = _demonstrated(tmp_path, -1, DROPS_AT, -1)
    selected = select(tmp_path)
    start_ns, end_ns = decisions["demo-1"].span or (0, 0)
    assert (selected.n_kept, selected.n_all) == (2, 3)
    assert selected.salvaged_s == ((end_ns - start_ns) / 1e9,)
    assert selected.decided_by == {"object_coupling": 3}


def test_without_a_salvaged_episode_there_is_no_third_selection(tmp_path: Path) -> None:
    _demonstrated(tmp_path, -1, DROPS_AT, salvage=False)
    selected = select(tmp_path)
    assert tuple(selected.manifests) == (EVERYTHING, KEPT)
    assert selected.salvaged_s == ()
    assert draw(tmp_path, tmp_path) == Drawn(())


def test_nothing_kept_ends_the_demo(tmp_path: Path) -> None:
    _demonstrated(tmp_path, DROPS_AT, DROPS_AT)
    with pytest.raises(CurationError, match="kept nothing"):
        select(tmp_path)


# --- drawing --------------------------------------------------------------------------------


def test_picture_is_of_the_first_salvaged_episode(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    _demonstrated(tmp_path / "data", -1, DROPS_AT, DROPS_AT - 5)
    drawn = draw(tmp_path / "data", tmp_path)
    assert drawn == Drawn((tmp_path / "salvaged.png", tmp_path / "salvaged.svg"))
    assert drawn.pictures[0].stat().st_size > 0
    assert "demo-1: salvage" in drawn.pictures[1].read_text()


def test_without_matplotlib_there_is_no_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _demonstrated(tmp_path / "data", DROPS_AT)
    for name in [m for m in sys.modules if m.startswith("curation_ros.reporting")]:
        monkeypatch.delitem(sys.modules, name)
    for name in [m for m in sys.modules if m.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "meta_path", [_Hidden(), *sys.meta_path])
    assert draw(tmp_path / "data", tmp_path) == Drawn((), missing="matplotlib")


class _Hidden:
    """Hides matplotlib from imports."""

    def find_spec(self, name: str, path: Any = None, target: Any = None) -> None:
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError(f"No module named {name!r}", name="matplotlib")


# --- alerts and comparisons -----------------------------------------------------------------


def test_alert_leads_by_the_wall_clock_and_by_the_clock_of_the_episode() -> None:
    start_ns = 1_000_000_000_000
    alert = Status(2, "demo-1", "object-lost", "id", {"span_end": "8750000000"})
    end = EpisodeEvent("id", "demo-1", "ended", start_ns, start_ns + 17_450_000_000)
    assert lead_of(alert, 2.5, end) == {"alert_before_s": 2.5, "alert_before_end_s": 8.7}
    assert lead_of(alert, 2.5, None) == {"alert_before_s": 2.5}


def _result(successes: int, rollouts: int = 10) -> dict[str, Any]:
    return {"successes": successes, "rollouts": rollouts, "rate": successes / rollouts}


@pytest.mark.parametrize(
    ("kept", "everything", "is_shown", "is_better"),
    [
        (10, 0, True, True),
        (0, 10, True, False),
        (10, 5, False, True),  # below 0.05, but there are two comparisons
        (3, 3, False, False),
    ],
)
def test_difference_is_shown_if_the_counts_bear_it(
    kept: int, everything: int, is_shown: bool, is_better: bool
) -> None:
    [one] = comparisons({KEPT: _result(kept), EVERYTHING: _result(everything)})
    assert (one.first, one.second) == (KEPT, EVERYTHING)
    assert (one.is_shown, one.is_better) == (is_shown, is_better)


def test_salvage_is_compared_with_kept() -> None:
    results = {name: _result(5) for name in (EVERYTHING, KEPT, KEPT_AND_SALVAGED)}
    pairs = [(one.first, one.second) for one in comparisons(results)]
    assert pairs == [(KEPT, EVERYTHING), (KEPT_AND_SALVAGED, KEPT)]
