from __future__ import annotations

import csv
import json
import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from streams import record, short_episode

from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.manifest import Entry, Manifest
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_override
from curation_ros.dataset.export import COLUMNS, FORMATS, export, keep_json
from curation_ros.dataset.manifests import save_selection

VERDICTS = ("keep", "salvage", "review", "discard")
SPAN = (1, 50_000_000)
WHOLE = (0, 110_000_000)


@pytest.fixture
def decided(dataset: Dataset, rng: np.random.Generator) -> list[Episode]:
    """A dataset with an episode of each verdict, and one that is not decided."""
    episodes = [short_episode(rng, 3, name=f"pick-{k}") for k in range(5)]
    for episode in episodes:
        record(dataset, episode)
    for k, (episode, verdict) in enumerate(zip(episodes, VERDICTS, strict=False)):
        dataset.append_decision(
            Decision(
                episode=episode.id,
                name=episode.name,
                verdict=verdict,
                reason=f'because, "{k}"',
                span=SPAN if verdict == "salvage" else WHOLE,
                scores={"knn": -0.1 * k, "gripper_timing": None},
                abstained={"gripper_timing": "it never closed"},
                findings=(Finding("gap", "silent", (0, 1)),) if k == 2 else (),
                state_hash="fitted",
            )
        )
    return episodes


def _rows(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="") as text:
        return {row["name"]: row for row in csv.DictReader(text)}


def test_keep_json_without_a_selection_is_what_the_decisions_keep(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    done = export(dataset, tmp_path / "keep.json", "keep-json")
    kept = json.loads((tmp_path / "keep.json").read_text())
    keep, salvage = decided[:2]
    assert kept == {
        "episodes": sorted([keep.id, salvage.id]),
        "names": {keep.id: "pick-0", salvage.id: "pick-1"},
        "spans": {salvage.id: [list(SPAN)]},
        "selection": None,
        "rule": {"name": "decisions", "scorer": ""},
    }
    assert done == {
        "out": str(tmp_path / "keep.json"),
        "format": "keep-json",
        "episodes": 5,
        "selected": 2,
    }


def test_keep_json_of_a_selection_is_its_manifest_in_its_order(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    best, second = decided[3], decided[0]
    spans = [(0, 10), (20, 30)]
    manifest = Manifest(
        name="mine",
        created_at="2026-11-24T08:00:00+00:00",
        dataset=str(dataset.path),
        scorer="knn",
        rule="top-k",
        rule_params={"value": 2, "seed": 7},
        entries=(
            *(Entry(best.id, best.name, span) for span in spans),
            Entry(second.id, second.name),
        ),
        kept_of=5,
    )
    dataset.save_manifest(manifest)
    export(dataset, tmp_path / "keep.json", "keep-json", selection="mine")
    kept = json.loads((tmp_path / "keep.json").read_text())
    assert kept["episodes"] == [best.id, second.id]
    assert kept["spans"] == {best.id: [[0, 10], [20, 30]]}
    assert kept["selection"] == "mine"
    assert kept["rule"] == {"name": "top-k", "scorer": "knn", "value": 2, "seed": 7}
    export(dataset, tmp_path / "all.csv", "csv", selection="mine")
    selected = {name: row["selected"] for name, row in _rows(tmp_path / "all.csv").items()}
    assert [name for name, flag in selected.items() if flag == "True"] == sorted(
        [best.name, second.name], key=lambda n: [e.id for e in decided if e.name == n]
    )


def test_csv_has_a_row_an_episode_and_every_column(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    export(dataset, tmp_path / "all.csv", "csv")
    rows = _rows(tmp_path / "all.csv")
    assert set(rows) == {e.name for e in decided}
    for row in rows.values():
        assert list(row) == [*COLUMNS, "score/gripper_timing", "score/knn"]
        assert row["steps"] == "3"
        assert float(row["duration_s"]) == pytest.approx(0.11)
    review = rows["pick-2"]
    assert (review["decision"], review["by"], review["revision"]) == ("review", "curator", "1")
    assert review["reason"] == 'because, "2"'
    assert (review["span_start_ns"], review["span_end_ns"]) == ("0", str(WHOLE[1]))
    assert (review["findings"], review["state_hash"]) == ("gap", "fitted")
    assert (review["score/knn"], review["score/gripper_timing"]) == ("-0.2", "")
    assert [rows[f"pick-{k}"]["selected"] for k in range(5)] == ["True", "True", *["False"] * 3]
    undecided = rows["pick-4"]
    assert (undecided["decision"], undecided["score/knn"], undecided["findings"]) == ("", "", "")


def test_csv_says_which_part_is_kept_beside_what_was_decided(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    export(dataset, tmp_path / "all.csv", "csv")
    rows = _rows(tmp_path / "all.csv")
    kept = {name: row["selected_spans"] for name, row in rows.items()}
    assert kept == {"pick-0": "all", "pick-1": f"{SPAN[0]}:{SPAN[1]}"} | {
        f"pick-{k}": "" for k in (2, 3, 4)
    }
    assert rows["pick-1"]["span_end_ns"] == str(SPAN[1])
    save_selection(dataset, rule="all", name="whole")
    export(dataset, tmp_path / "whole.csv", "csv", selection="whole")
    rows = _rows(tmp_path / "whole.csv")
    assert {row["selected_spans"] for row in rows.values()} == {"all"}
    assert rows["pick-1"]["span_end_ns"] == str(SPAN[1])


def test_two_spans_of_an_episode_are_both_in_its_row(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    manifest, _ = save_selection(dataset, rule="decisions", name="one")
    [salvaged] = [e for e in manifest.entries if e.span is not None]
    later = replace(salvaged, span=(60_000_000, 90_000_000))
    dataset.save_manifest(replace(manifest, name="two", entries=(salvaged, later)))
    for file_format in ("csv", "parquet"):
        export(dataset, tmp_path / file_format, file_format, selection="two")
    row = _rows(tmp_path / "csv")["pick-1"]
    assert row["selected_spans"] == f"{SPAN[0]}:{SPAN[1]} 60000000:90000000"
    column = pq.read_table(tmp_path / "parquet").column("selected_spans").to_pylist()
    assert sorted(filter(None, column)) == [row["selected_spans"]]


def test_parquet_holds_the_same_with_types(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    export(dataset, tmp_path / "all.parquet", "parquet")
    export(dataset, tmp_path / "all.csv", "csv")
    table = pq.read_table(tmp_path / "all.parquet")
    kinds = {
        name: str(kind) for name, kind in zip(table.schema.names, table.schema.types, strict=True)
    }
    assert kinds["episode"] == "string"
    assert kinds["selected"] == "bool"
    assert kinds["span_end_ns"] == kinds["steps"] == "int64"
    assert kinds["score/gripper_timing"] == kinds["duration_s"] == "double"  # all are null
    for row in table.to_pylist():
        told = {k: "" if v is None else str(v) for k, v in row.items()}
        assert told == _rows(tmp_path / "all.csv")[row["name"]]


def test_persons_decision_is_in_force_beside_the_curators_scores(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    log_override(dataset, decided[3].id, "keep", "fine", "Ada")
    export(dataset, tmp_path / "all.csv", "csv")
    row = _rows(tmp_path / "all.csv")["pick-3"]
    assert (row["decision"], row["by"], row["reason"]) == ("keep", "Ada", "Ada: fine")
    assert (row["revision"], row["selected"]) == ("2", "True")
    assert float(row["score/knn"]) == pytest.approx(-0.3)


def test_decision_whose_bag_has_gone_keeps_its_row(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    bag = dataset.bag_path(decided[0].id)
    bag.rename(tmp_path / "elsewhere")
    export(dataset, tmp_path / "all.csv", "csv")
    row = _rows(tmp_path / "all.csv")["pick-0"]
    assert (row["decision"], row["steps"], row["duration_s"]) == ("keep", "", "")


@pytest.mark.parametrize("file_format", FORMATS)
def test_file_that_is_there_is_only_overwritten_by_force(
    dataset: Dataset, decided: list[Episode], tmp_path: Path, file_format: str
) -> None:
    out = tmp_path / "out"
    out.write_text("precious")
    with pytest.raises(CurationError, match="--force overwrites it"):
        export(dataset, out, file_format)
    assert out.read_text() == "precious"
    export(dataset, out, file_format, force=True)
    assert b"precious" not in out.read_bytes()
    assert [p.name for p in tmp_path.iterdir() if p.name.endswith(".part")] == []


@pytest.mark.parametrize("file_format", ["keep-json", "csv"])
def test_export_of_the_same_dataset_is_the_same_file(
    dataset: Dataset, decided: list[Episode], tmp_path: Path, file_format: str
) -> None:
    for name in ("a", "b"):
        export(dataset, tmp_path / name, file_format)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_folders_on_the_way_are_made(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    export(dataset, tmp_path / "x" / "y" / "all.csv", "csv")
    assert len(_rows(tmp_path / "x" / "y" / "all.csv")) == 5


def test_missing_library_is_told_with_its_extra(
    dataset: Dataset, decided: list[Episode], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)  # as where it is not installed
    with pytest.raises(ConfigError, match=r"pip install 'curation_ros\[parquet\]'"):
        export(dataset, tmp_path / "all.parquet", "parquet")
    assert not (tmp_path / "all.parquet").exists()
    export(dataset, tmp_path / "all.csv", "csv")


def test_nothing_to_export_is_an_error(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    with pytest.raises(CurationError, match="no episode to export"):
        export(dataset, tmp_path / "out", "csv")
    record(dataset, short_episode(rng, 3))
    with pytest.raises(CurationError, match="no decision yet: run curation score"):
        export(dataset, tmp_path / "out", "keep-json")
    with pytest.raises(CurationError, match=r"selections/nose\.json"):
        export(dataset, tmp_path / "out", "keep-json", selection="nose")
    with pytest.raises(ConfigError, match="no format 'nose'"):
        export(dataset, tmp_path / "out", "nose")
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_folder_that_cannot_be_written_is_told(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    with pytest.raises(CurationError, match="closed"):
        export(dataset, tmp_path / "closed" / "all.csv", "csv")


def test_file_in_the_way_of_a_folder_is_told(
    dataset: Dataset, decided: list[Episode], tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(CurationError, match="file"):
        export(dataset, tmp_path / "file" / "all.csv", "csv")


def test_keep_json_of_nothing_is_an_empty_list() -> None:
    kept: dict[str, Any] = keep_json((), None)
    assert (kept["episodes"], kept["names"], kept["spans"]) == ([], {}, {})
