"""Audits of episodes made in memory; of the dataset only the truth is read."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_reference
from streams import record

from curation_ros.batch.audit import Audit, AuditSettings, audit, audit_dataset
from curation_ros.batch.published import TABLE_1
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError, EpisodeError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.statistics.detection import auroc, auroc_interval
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.labels import read_labels

pytestmark = pytest.mark.slow

FAST = ("gripper_timing", "knn", "length")
DRAWS = {"n_permutations": 199, "n_resamples": 200}


def _settings(**changes: Any) -> AuditSettings:
    return AuditSettings(**{"scorers": FAST, **DRAWS, **changes})


def _labelled(dataset: Dataset, episode: Episode, good: bool, **truth: Any) -> Episode:
    outcome, defect = ("succeeded", "none") if good else ("failed", "early_release")
    dataset.append_truth({"episode": episode.id, "outcome": outcome, "defect": defect, **truth})
    return episode


def _contaminated(
    dataset: Dataset, rng: np.random.Generator, *, bad_steps: Sequence[int] = (300, 300, 300, 300)
) -> list[Episode]:
    """Four good episodes of 228 to 246 steps, and early releases of given lengths."""
    good = [make_episode(rng, 228 + 6 * k, name=f"good-{k}") for k in range(4)]
    bad = [
        make_episode(rng, n, task_steps=240, open_at=120 + 3 * k, name=f"bad-{k}")
        for k, n in enumerate(bad_steps)
    ]
    return [_labelled(dataset, e, e in good) for e in (*good, *bad)]


def _row(audited: Audit, scorer: str) -> dict[str, Any]:
    [row] = [r for r in audited.rows if r["scorer"] == scorer]
    return row


# --- labels -------------------------------------------------------------------------------------


def test_flipped_labels_mirror_every_auroc_and_change_no_score(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Any
) -> None:
    episodes = _contaminated(dataset, rng)
    reference = make_reference(rng)
    turned = Dataset(tmp_path / "turned", create=True)
    for episode in episodes:
        _labelled(turned, episode, not read_labels(dataset, "success")[episode.id])
    settings = _settings(scorers=tuple(SCORERS))
    one, other = (audit(d, episodes, reference, settings) for d in (dataset, turned))
    assert len(one.rows) == len(SCORERS) + 1
    for a, b in zip(one.rows, other.rows, strict=True):
        assert a["scorer"] == b["scorer"]
        if a["auroc_controlled"] is None:
            assert b["auroc_controlled"] is None
            continue
        assert b["auroc_controlled"] == pytest.approx(1 - a["auroc_controlled"], abs=1e-12)
        assert b["spearman_length"] == a["spearman_length"]


@pytest.mark.parametrize("good", [True, False])
def test_labels_of_one_kind_are_refused_with_an_explanation(
    dataset: Dataset, rng: np.random.Generator, good: bool
) -> None:
    episodes = [_labelled(dataset, make_episode(rng), good) for _ in range(3)]
    message = f"{3 * good} good and {3 * (not good)} bad of 3 episodes.*needs some of both"
    with pytest.raises(EpisodeError, match=message):
        audit(dataset, episodes, settings=_settings())


def test_dataset_without_truth_is_refused_with_the_number_of_unlabelled(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    with pytest.raises(EpisodeError, match="2 have no such label"):
        audit(dataset, [make_episode(rng), make_episode(rng)], settings=_settings())


def test_episodes_without_a_label_or_in_the_reference_are_left_out_and_counted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = [*_contaminated(dataset, rng), make_episode(rng)]
    audited = audit(dataset, episodes, episodes[:2], _settings())
    facts = audited.facts
    assert (facts["n_good"], facts["n_bad"]) == (2, 4)
    assert (facts["unlabelled"], facts["in_reference"]) == (1, 2)
    assert "1 episodes lack the label 'success': left out" in audited.notes
    assert "2 episodes are in the reference: left out" in audited.notes


def test_note_compares_both_kinds_of_labels(dataset: Dataset, rng: np.random.Generator) -> None:
    episodes = _contaminated(dataset, rng)
    assert "the labels 'defect' say the same of all 8 episodes" in (
        audit(dataset, episodes, settings=_settings()).notes
    )
    dataset.append_truth({"episode": episodes[0].id, "outcome": "failed"})
    assert "the labels 'success' differ on 1 of 8 episodes" in (
        audit(dataset, episodes, settings=_settings(labels="defect")).notes
    )


# --- figures ------------------------------------------------------------------------------------


def test_figures_are_those_of_the_scores(dataset: Dataset, rng: np.random.Generator) -> None:
    episodes = _contaminated(dataset, rng, bad_steps=(235, 300, 300, 300))
    reference = make_reference(rng)
    audited = audit(dataset, episodes, reference, _settings())
    row = _row(audited, "length")
    assert row["auroc_raw"] == auroc([-len(e) for e in episodes], [True] * 4 + [False] * 4)
    assert row["ci_raw"] == list(auroc_interval(row["auroc_raw"], 4, 4))
    assert row["spearman_length"] == pytest.approx(-1.0)
    shortest = min(len(e) for e in reference)
    assert row["length_control"] == {
        "mode": "shortest-reference",
        "value": None,
        "steps": shortest,
        "needs": "reference",
    }
    timing = _row(audited, "gripper_timing")
    assert (timing["auroc_controlled"], timing["needs"]) == (1.0, "nothing")
    low, high = timing["ci"]
    assert (low < 0.9, high) == (True, 1.0)
    # All good ones open beyond T, or in the very last steps: the best 6 hold all four.
    assert timing["n_kept"] == 6
    assert timing["precision"] == pytest.approx(4 / 6)
    assert timing["clean_recall"] == 1.0
    assert timing["purity_ceiling"] == pytest.approx(4 / 6)
    assert timing["pauroc"] == pytest.approx(1.0)
    assert _row(audited, "knn")["needs"] == "reference"


def test_length_that_is_cut_away_detects_nothing(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _contaminated(dataset, rng)
    row = _row(
        audit(dataset, episodes, settings=_settings(length="fixed", length_value=200)), "length"
    )
    assert (row["auroc_raw"], row["auroc_controlled"]) == (1.0, 0.5)
    assert (row["tied_at_cut"], row["precision"]) == (1.0, pytest.approx(0.5))
    assert row["spearman_length_controlled"] is None
    path = _row(audit(dataset, episodes, settings=_settings()), "length_path")
    assert path["auroc_raw"] is not None


def test_length_that_is_left_after_control_is_noted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _contaminated(dataset, rng)
    left = audit(dataset, episodes, settings=_settings(length="fixed", length_value=235)).notes
    assert (
        "2 episodes are shorter than 235 steps: after control, length alone still has an AUROC "
        "of 0.750"
    ) in left
    none = audit(dataset, episodes, settings=_settings(length="none")).notes
    assert "length is not controlled: raw and controlled are the same" in none
    whole = audit(dataset, episodes, settings=_settings(length="fixed", length_value=228)).notes
    assert not [note for note in whole if "shorter" in note or "not controlled" in note]


def test_nothing_is_identifiable_if_length_separates_the_labels(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    audited = audit(dataset, _contaminated(dataset, rng), settings=_settings())
    assert audited.facts["length_separates"]
    assert audited.notes[0].startswith(
        "not identifiable: length alone separates the labels perfectly (good 228 to 246 steps, "
        "bad 300 to 300)"
    )
    for row in audited.rows:
        assert (row["auroc_within_length"], row["p_label_length_held"]) == (None, None)
        if row["auroc_controlled"] is not None:
            assert any(n.startswith("not identifiable at equal length") for n in row["notes"])


def test_overlapping_lengths_are_compared_at_equal_length(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _contaminated(dataset, rng, bad_steps=[228, 234, 240, 246])
    audited = audit(dataset, episodes, settings=_settings())
    assert not audited.facts["length_separates"]
    row = _row(audited, "gripper_timing")
    assert row["auroc_within_length"] == 1.0
    # One good against one bad in each of four strata: 2 of 16 arrangements are as extreme.
    assert row["p_label_length_held"] == pytest.approx(2 / 16, abs=0.07)
    length = _row(audited, "length")
    assert length["auroc_within_length"] == 0.5
    assert length["p_label_length_held"] == 1.0


def test_abstentions_are_counted_and_the_reason_is_noted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _contaminated(dataset, rng)
    episodes.append(_labelled(dataset, make_episode(rng, close_at=None), True))
    row = _row(audit(dataset, episodes, settings=_settings()), "gripper_timing")
    assert (row["abstained"], row["abstained_raw"], row["n_scored"]) == (1, 1, 8)
    assert row["notes"][0] == "1 abstained: the gripper was never commanded to close"
    assert row["auroc_controlled"] == 1.0  # of those with a score
    assert row["clean_recall"] == pytest.approx(4 / 5)  # of all good ones: it is not kept


def test_scorers_without_their_reference_abstain_with_a_note(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    row = _row(audit(dataset, _contaminated(dataset, rng), settings=_settings()), "knn")
    assert (row["auroc_raw"], row["auroc_controlled"], row["ci"]) == (None, None, None)
    assert row["notes"] == ["all abstained: no reference"]
    assert row["abstained"] == 8


def test_label_free_twins_are_fitted_on_the_dataset(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    twins = tuple(name for name, kind in SCORERS.items() if kind.needs == "dataset")
    assert twins
    episodes = _contaminated(dataset, rng)
    for k, e in enumerate(episodes):  # each from a start of its own
        e.fields["bowl_position"][:] += 0.01 * k
    audited = audit(dataset, episodes, settings=_settings(scorers=twins))
    for name in twins:
        row = _row(audited, name)
        assert (row["needs"], row["abstained"]) == ("dataset", 0), row["notes"]


def test_rows_are_in_the_papers_order_with_its_figures(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    audited = audit(
        dataset,
        _contaminated(dataset, rng),
        make_reference(rng),
        _settings(scorers=tuple(SCORERS)),
    )
    assert [row["scorer"] for row in audited.rows][: len(TABLE_1)] == list(TABLE_1)
    assert _row(audited, "gripper_timing")["paper"] == {
        "raw": 0.957,
        "truncated": 0.804,
        "truncated_joined_by_name": 0.973,
    }
    assert _row(audited, "length")["paper"] is None


def test_order_of_episodes_and_a_second_audit_change_nothing(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes, reference = _contaminated(dataset, rng), make_reference(rng)
    settings = _settings(scorers=tuple(SCORERS))
    first = audit(dataset, episodes, reference, settings)
    again = audit(dataset, episodes[::-1], reference[::-1], settings)
    assert json.dumps(again.rows) == json.dumps(first.rows)


def test_starts_that_recur_give_an_interval_over_starts(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = []
    for k in range(6):
        for good in (True, False):
            steps = int(rng.integers(225, 250))
            made = make_episode(rng, steps, open_at=-1 if good == (k > 1) else 120)
            episodes.append(_labelled(dataset, made, good, task="t", start=f"s{k}", repetition=0))
    row = _row(audit(dataset, episodes, settings=_settings(length="none")), "gripper_timing")
    assert row["ci_starts"] is not None
    low, high = row["ci_starts"]
    assert low < row["auroc_controlled"] < high


def test_perfect_ranking_has_a_note_instead_of_a_bootstrap_interval(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _contaminated(dataset, rng)
    for episode in episodes:
        dataset.append_truth({"episode": episode.id, "start": "s"})
    for k in (0, 4):
        dataset.append_truth({"episode": episodes[k].id, "start": "other"})
    row = _row(audit(dataset, episodes, settings=_settings()), "gripper_timing")
    assert (row["auroc_controlled"], row["ci_starts"]) == (1.0, None)
    assert "the bootstrap over starts gives one value throughout: see ci" in row["notes"]


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("length", "value", "steps", "needs"),
    [
        ("none", None, None, "nothing"),
        ("fixed", 150, 150, "nothing"),
        ("phase-normalised", 20, 20, "phases"),
        ("percentile", 0, 228, "dataset"),
        ("percentile", 100, 300, "dataset"),
        ("shortest-success", None, 228, "labels"),
        ("", None, 230, "dataset"),  # the 5th percentile of 228, 234, 240, 246 and 4 times 300
    ],
)
def test_length_control_declares_its_needs(
    dataset: Dataset,
    rng: np.random.Generator,
    length: str,
    value: float | None,
    steps: int | None,
    needs: str,
) -> None:
    settings = _settings(length=length, length_value=value)
    audited = audit(dataset, _contaminated(dataset, rng), settings=settings)
    control = audited.facts["length_control"]
    assert (control["steps"], control["needs"]) == (steps, needs)
    uses_labels = "the length control uses labels: for comparison with the paper only"
    assert (uses_labels in audited.notes) == (needs == "labels")


@pytest.mark.parametrize(
    ("keep", "n_kept"), [(0.75, 6), (0.5, 4), (3, 3), (1, 1), (1.0, 8), (0.01, 1), (0.3125, 3)]
)
def test_what_is_kept_is_a_share_or_a_number(
    dataset: Dataset, rng: np.random.Generator, keep: float, n_kept: int
) -> None:
    audited = audit(dataset, _contaminated(dataset, rng), settings=_settings(keep=keep))
    assert _row(audited, "gripper_timing")["n_kept"] == n_kept


def test_keeping_more_than_have_a_score_is_noted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    audited = audit(dataset, _contaminated(dataset, rng), settings=_settings(keep=9))
    row = _row(audited, "gripper_timing")
    assert (row["n_kept"], row["precision"]) == (None, None)
    assert "cannot keep 9: 8 have a score" in row["notes"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"labels": "nose"}, "expected one of success, defect"),
        ({"keep": 0}, "keep 0"),
        ({"keep": 1.5}, "keep 1.5"),
        ({"length": "nose"}, "length 'nose'"),
        ({"length": "shortest-reference"}, "needs --reference"),
        ({"length": "fixed"}, "takes steps"),
        ({"length": "shortest-success", "length_value": 3.0}, "takes no value"),
        ({"scorers": ("nose",)}, "no scorer 'nose'"),
    ],
)
def test_wrong_settings_raise(
    dataset: Dataset, rng: np.random.Generator, changes: dict[str, Any], message: str
) -> None:
    episodes = _contaminated(dataset, rng)
    with pytest.raises(ConfigError, match=message):
        audit(dataset, episodes, settings=_settings(**changes))


def test_shortest_success_without_a_success_is_refused(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = [make_episode(rng), make_episode(rng)]
    for episode, defect in zip(episodes, ("none", "early_release"), strict=True):
        dataset.append_truth({"episode": episode.id, "outcome": "failed", "defect": defect})
    with pytest.raises(CurationError, match="no episode of the dataset succeeded"):
        audit(dataset, episodes, settings=_settings(labels="defect", length="shortest-success"))


# --- datasets -----------------------------------------------------------------------------------


def test_bags_that_cannot_be_read_are_listed_and_the_others_audited(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    broken = dataset.bag_path("broken")
    broken.mkdir()
    (broken / "broken_0.mcap").write_bytes(b"")
    with pytest.raises(EpisodeError, match=r"no episode that can be read; 1 bags.*broken"):
        audit_dataset(dataset, settings=_settings())
    for k in range(4):
        episode = make_episode(rng, 228 + 6 * k, open_at=-1 if k < 2 else 120)
        record(dataset, _labelled(dataset, episode, k < 2))
    audited = audit_dataset(dataset, settings=_settings())
    assert len(audited.problems) == 1
    assert str(broken) in audited.problems[0]
    assert (audited.facts["n_good"], audited.facts["n_bad"]) == (2, 2)
    for line, row in zip(audited.to_json(), audited.rows, strict=True):
        assert line["notes"] == [*row["notes"], *audited.notes]
