"""The section on salvage shows what the curator decided, and what came of it."""

from __future__ import annotations

import html
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from reading import MOST_BYTES, cells, same  # noqa: E402 - after the checks

from curation_ros.core.errors import ConfigError  # noqa: E402 - as above
from curation_ros.reporting import write_report  # noqa: E402 - as above
from curation_ros.reporting.answers import answers  # noqa: E402 - as above
from curation_ros.reporting.blocks import Figure, Points, Table  # noqa: E402 - as above
from curation_ros.reporting.salvage_section import salvage_blocks  # noqa: E402 - as above


def test_study_without_salvage_rows_has_no_section_on_salvage(report: list[Path]) -> None:
    assert "Salvage</h2>" not in report[0].read_text()


def test_salvage_is_shown_against_the_truth(salvaged: dict[str, Any]) -> None:
    verdicts, *_ = (b for b in salvage_blocks(salvaged) if isinstance(b, Table))
    [cell] = cells(verdicts)
    assert (cell["keep"], cell["salvage"]) == ("3 good, 0 defective", "0 good, 3 defective")
    assert cell["cut minus release, steps"] == "-15 / -15 / -15"
    [message] = [text for text in answers(salvaged) if "salvages" in text]
    assert "keeps 3 of 3 good demonstrations and 0 of 3 defective ones" in message
    assert "a beginning of 0 and 3." in message


def test_the_margin_sweep_is_drawn_and_listed(salvaged: dict[str, Any]) -> None:
    blocks = salvage_blocks(salvaged)
    [sweep] = [b for b in blocks if isinstance(b, Figure) and b.name == "figure-margins-margins"]
    rows = {row["row"]: row for row in salvaged["stages"][0]["rows"]}
    for margin in (0, 5, 15):
        rate = rows[f"decided+salvaged-{margin}"]["rate"]
        assert f"{margin} steps: {rate:.0%}" in sweep.panels[0].alt
    [table] = [b for b in blocks if isinstance(b, Table) and "how far before" in b.caption]
    listed = {cell["row"]: cell for cell in cells(table)}
    assert list(listed) == list(rows)
    for name, row in rows.items():
        assert same(listed[name]["success"], row["rate"], 100)
    assert listed["decided+salvaged-5"]["margin"] == "5"
    assert listed["decided+salvaged"]["good"] == "3 of 3, and 3 parts"


def test_phases_of_every_set_are_shown_and_rare_ones_named(salvaged: dict[str, Any]) -> None:
    blocks = salvage_blocks(salvaged)
    [table] = [b for b in blocks if isinstance(b, Table) and b.caption.startswith("Phases")]
    listed = {cell["training set"]: cell for cell in cells(table)}
    assert listed["oracle, decided of some"]["release"].startswith("3 (")
    both = "decided+salvaged, decided+salvaged-15 of some"
    assert listed[both]["n"] == "6"
    # Half is enough: one good demonstration less, and RELEASE is rare.
    few = [item for b in blocks if isinstance(b, Points) for item in b.items]
    assert not [item for item in few if item.startswith(both)]
    spoilt = deepcopy(salvaged)
    for stage in spoilt["stages"]:
        for row in stage["rows"]:
            if row["row"].startswith("decided+salvaged"):
                row["phases"]["RELEASE"]["demonstrations"] = 2
    few = [item for b in salvage_blocks(spoilt) if isinstance(b, Points) for item in b.items]
    assert f"{both}: of 6 demonstrations, RELEASE by 2" in few


def test_one_salvaged_episode_is_drawn(salvaged: dict[str, Any], tmp_path: Path) -> None:
    written = {path.name: path for path in write_report(salvaged, tmp_path)}
    assert "kept until" in written["figure-salvaged.svg"].read_text()
    page = html.unescape(written["report.html"].read_text())
    assert "Salvage</h2>" in page
    # It ranks by no scorer, so nothing about scorers is missing.
    assert "Missing" not in page
    assert len(page.encode()) < MOST_BYTES


def test_broken_example_is_refused_in_one_line(salvaged: dict[str, Any], tmp_path: Path) -> None:
    spoilt = deepcopy(salvaged)
    spoilt["salvaged_example"]["decision"].pop("span")
    with pytest.raises(ConfigError, match="salvaged_example: EpisodeError: decision: KeyError"):
        write_report(spoilt, tmp_path)
