from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from curation_ros.bags import open_bag
from curation_ros.dataset.episodes import find_episodes

Run = Callable[..., Any]


def test_damaged_bag_is_saved_and_scored_with_its_finding(
    curation: Run, folder: Path, tmp_path: Path
) -> None:
    bag = find_episodes([folder / "data"])[0]
    whole = sum(topic.count for topic in open_bag(bag).topics.values())
    torn = next(bag.glob("*.mcap"))
    torn.write_bytes(torn.read_bytes()[: torn.stat().st_size // 2])
    left = torn.read_bytes()
    told = curation("score", bag, "--json")
    assert [row["finding"] for row in told.rows] == ["truncated"]
    assert "curation recover" in told.rows[0]["error"]
    told = curation("recover", bag, tmp_path / "saved", "--json")
    assert told.code == 0
    assert 0 < sum(told.rows[0]["messages"].values()) < whole
    assert torn.read_bytes() == left
    [row] = curation("score", tmp_path / "saved", "--json").rows
    assert "recovered" in [f["id"] for f in row["findings"]]
    assert row["decision"] == "review"


def test_what_cannot_be_recovered_is_one_line(curation: Run, tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"")
    told = curation("recover", tmp_path / "x.mcap", tmp_path / "saved")
    assert told.code == 3
    assert told.err.startswith("error: ")
    assert told.err.count("\n") == 1
    assert not (tmp_path / "saved").exists()
