from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from streams import record

from curation_ros.bags import open_bag
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes

DONE, USAGE, NOTHING = 0, 2, 3
EARLY = ("pick-2", "pick-3")
KEYS = {
    "scorer", "needs", "auroc_raw", "ci_raw", "auroc_controlled", "ci", "ci_starts", "pauroc",
    "spearman_length", "spearman_length_p", "spearman_length_controlled",
    "spearman_length_controlled_p", "auroc_within_length", "p_label_length_held",
    "spearman_within_label", "p_length_label_held", "n_kept", "precision", "clean_recall",
    "tied_at_cut", "purity_ceiling", "n_scored", "abstained", "abstained_raw", "paper", "notes",
    "labels", "n_good", "n_bad", "unlabelled", "in_reference", "reference", "length_control",
    "length_separates", "keep", "permutations", "seed",
}  # fmt: skip
Run = Callable[..., Any]


@pytest.fixture
def labelled_data(folder: Path) -> Path:
    """The dataset with its truth: pick-2 and pick-3 are early releases that failed."""
    dataset = Dataset(folder / "data")
    for bag in find_episodes([folder / "data"]):
        event = open_bag(bag).event()
        assert event is not None
        early = event.name in EARLY
        dataset.append_truth(
            {
                "episode": event.id,
                "outcome": "failed" if early else "succeeded",
                "defect": "early_release" if early else "none",
            }
        )
    return folder / "data"


def _fast(folder: Path) -> list[object]:
    scorers = ["--scorers", "gripper_timing,knn", "--permutations", 99]
    return [*scorers, "--reference", folder / "reference"]


def test_json_is_one_line_per_scorer_with_exactly_these_keys(
    curation: Run, folder: Path, labelled_data: Path
) -> None:
    done = curation("audit", labelled_data, *_fast(folder), "--json")
    assert done.code == DONE, done.err
    assert [r["scorer"] for r in done.rows] == ["length_path", "knn", "gripper_timing", "length"]
    for row in done.rows:
        assert set(row) == KEYS
        assert list(row)[:2] == ["scorer", "needs"]
    timing = done.rows[2]
    assert timing["auroc_controlled"] == 1.0
    assert (timing["labels"], timing["n_good"], timing["n_bad"]) == ("success", 3, 2)
    assert timing["permutations"] == 99
    assert timing["length_control"]["mode"] == "shortest-reference"
    assert "NaN" not in done.out


def test_every_key_is_documented() -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "audit.md").read_text()
    assert not [key for key in sorted(KEYS) if f"`{key}`" not in text]


def test_table_shows_every_scorer_what_it_needs_and_the_paper(
    curation: Run, folder: Path, labelled_data: Path
) -> None:
    done = curation("audit", labelled_data, *_fast(folder), "--labels", "defect")
    assert done.code == DONE, done.err
    text = " ".join(done.out.split())
    assert "3 good and 2 bad by the label 'defect'; 5 reference episodes" in text
    assert "needs reference" in text
    assert "gripper timing nothing 1.000" in text
    assert "Table I of the paper" in text
    assert "0.957" in text
    assert "99 permutations, seed 0" in text


def test_not_identifiable_is_in_the_table_and_in_json(
    curation: Run, dataset: Dataset, rng: np.random.Generator
) -> None:
    for n_steps, outcome in ((228, "succeeded"), (234, "succeeded"), (300, "failed")):
        episode = make_episode(rng, n_steps)
        record(dataset, episode)
        dataset.append_truth({"episode": episode.id, "outcome": outcome})
    options = ["--scorers", "gripper_timing", "--permutations", 9]
    text = " ".join(curation("audit", dataset.path, *options).out.split())
    assert "not identifiable: length alone separates the labels perfectly (good 228 to 234" in text
    assert text.count("not identifiable") == 1 + 3  # and a cell in each row
    for row in curation("audit", dataset.path, *options, "--json").rows:
        assert (row["auroc_within_length"], row["p_label_length_held"]) == (None, None)
        assert sum("not identifiable" in note for note in row["notes"]) == 2


def test_same_call_prints_the_same(curation: Run, folder: Path, labelled_data: Path) -> None:
    first = curation("audit", labelled_data, *_fast(folder), "--json")
    assert curation("audit", labelled_data, *_fast(folder), "--json").out == first.out


def test_unreadable_bag_is_reported_and_the_others_are_audited(
    curation: Run, folder: Path, labelled_data: Path
) -> None:
    broken = labelled_data / "episodes" / "broken"
    broken.mkdir()
    (broken / "broken_0.mcap").write_bytes(b"")
    done = curation("audit", labelled_data, *_fast(folder), "--json")
    assert done.code == DONE
    assert done.rows[0]["n_good"] == 3
    assert str(broken) in done.err


def test_dataset_without_labels_is_nothing_to_audit(curation: Run, folder: Path) -> None:
    done = curation("audit", folder / "data", *_fast(folder), "--json")
    assert (done.code, done.out) == (NOTHING, "")
    assert "5 have no such label in truth.jsonl" in done.err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--labels", "nose"], USAGE, "nose"),
        (["--scorers", "nose"], USAGE, "no scorer 'nose'"),
        (["--length", "nose"], USAGE, "length 'nose'"),
        (["--length", "fixed:nose"], USAGE, "'nose' is no number"),
        (["--length", "fixed"], USAGE, "takes steps"),
        (["--keep", "nose"], USAGE, "--keep 'nose'"),
        (["--keep", "0"], USAGE, "keep 0"),
        (["--keep", "1.5"], USAGE, "keep 1.5"),
        (["--permutations", "0"], USAGE, "n_permutations 0"),
    ],
)
def test_wrong_usage_is_one_line_and_a_code(
    curation: Run, labelled_data: Path, arguments: list[str], code: int, message: str
) -> None:
    done = curation("audit", labelled_data, *arguments, "--json")
    assert (done.code, done.out) == (code, "")
    assert message in done.err
    assert "internal error" not in done.err


@pytest.mark.parametrize(
    ("length", "mode", "steps", "needs"),
    [
        ("fixed:150", "fixed", 150, "nothing"),
        ("percentile:50", "percentile", 240, "dataset"),
        ("shortest-success", "shortest-success", 240, "labels"),
        ("none", "none", None, "nothing"),
    ],
)
def test_length_control_is_chosen_by_name_and_value(
    curation: Run, labelled_data: Path, length: str, mode: str, steps: int | None, needs: str
) -> None:
    options = ["--scorers", "gripper_timing", "--permutations", 9, "--length", length]
    done = curation("audit", labelled_data, *options, "--json")
    control = done.rows[0]["length_control"]
    assert (control["mode"], control["steps"], control["needs"]) == (mode, steps, needs)


def test_parameters_of_scorers_come_from_the_config(
    curation: Run, labelled_data: Path, tmp_path: Path
) -> None:
    options = ["--scorers", "gripper_timing", "--permutations", 9, "--json", "--length", "none"]
    (tmp_path / "c.yaml").write_text("scorer_params: {gripper_timing: {'on': nose}}\n")
    done = curation("audit", labelled_data, *options, "--config", tmp_path / "c.yaml")
    assert (done.code, done.out) == (USAGE, "")
    assert "on is 'nose'" in done.err


def test_number_to_keep_is_taken(curation: Run, labelled_data: Path) -> None:
    options = ["--scorers", "gripper_timing", "--permutations", 9, "--json", "--keep"]
    by_number = curation("audit", labelled_data, *options, "2").rows[0]
    by_share = curation("audit", labelled_data, *options, "0.4").rows[0]
    assert (by_number["n_kept"], by_share["n_kept"]) == (2, 2)
