"""Scorers fitted on a reference: what is refused, what abstains, what changes the hash."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_pool, make_reference

from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers import SCORERS


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_reference(rng)


def fit(reference: list[Episode], **options: Any) -> FittedScorers:
    return fit_scorers(CurationSettings(**options), reference)


def test_reference_with_faults_is_refused_by_name(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    gap = make_episode(rng, name="bad-1", findings=[Finding("gap", "silent for 2 s", (0, 9))])
    inverted = make_episode(rng, name="bad-2", opens=1)
    with pytest.raises(EpisodeError, match=r"bad-1 .*gap: silent for 2 s") as caught:
        fit([*reference, gap, inverted])
    assert "bad-2" in str(caught.value)
    assert "good-" not in str(caught.value)
    with pytest.raises(EpisodeError, match="there twice"):
        fit([*reference, reference[0]])
    with pytest.raises(EpisodeError, match="too-short: 1 steps"):
        fit([*reference, make_episode(rng, 1)])


def test_mistake_of_all_references_is_said_once_and_not_fifty_times(
    rng: np.random.Generator,
) -> None:
    gap = Finding("gap", "silent", (0, 9))
    with pytest.raises(EpisodeError) as caught:
        fit([make_episode(rng, name=f"bad-{k}", findings=[gap]) for k in range(9)])
    assert str(caught.value).count("gap: silent") == 3
    assert str(caught.value).endswith("; and 6 more")


def test_scorer_that_cannot_be_fitted_abstains_and_the_others_score(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    scores, abstained = fit(reference[:1]).score(make_episode(rng))
    assert set(abstained) == {"isolation_forest"}
    assert "at least 2" in abstained["isolation_forest"]
    assert scores["knn"] is not None


def test_length_is_scored_whole_and_the_others_truncated(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    fitted = fit(reference)
    long = make_episode(rng, 500, task_steps=240)
    scores, abstained = fitted.score(long)
    cut, _ = fitted.score(long.steps(234))
    assert scores["length"] == -500
    truncated = [k for k in scores if SCORERS[k].length_controlled]
    assert {k: scores[k] for k in truncated} == {k: cut[k] for k in truncated}
    assert abstained == {}


# --- the dataset --------------------------------------------------------------------------------

TWIN = {"scorers": ("knn_label_free", "gripper_timing"), "rule": "none"}


def test_twin_abstains_until_it_is_fitted_on_the_dataset(rng: np.random.Generator) -> None:
    before = fit([], rule_scorer="gripper_timing", **TWIN)
    assert before.needs_dataset
    episode, *_ = pool = make_pool(rng)
    assert "was not given" in before.score(episode)[1]["knn_label_free"]
    after = before.fit_dataset(pool)
    assert after.score(episode)[0]["knn_label_free"] is not None
    assert after.dataset_ids == tuple(sorted(e.id for e in pool))
    # What was fitted before stays as it was.
    assert "was not given" in before.score(episode)[1]["knn_label_free"]
    assert before.scoring_hash != after.scoring_hash
    assert after.fit_dataset(pool[::-1]).scoring_hash == after.scoring_hash
    assert after.fit_dataset(pool[1:]).scoring_hash != after.scoring_hash


def test_percentile_without_a_reference_is_learned_from_the_dataset(
    rng: np.random.Generator,
) -> None:
    fitted = fit([], scorers=("gripper_timing",), length="percentile", length_value=0)
    assert fitted.needs_dataset
    assert fitted.length.steps_ is None
    pool = make_pool(rng)
    learned = fitted.fit_dataset(pool)
    assert learned.length.steps_ == min(len(e) for e in pool)
    assert not learned.needs_dataset


def test_dataset_too_small_for_a_twin_leaves_it_silent(rng: np.random.Generator) -> None:
    fitted = fit([], rule_scorer="gripper_timing", **TWIN).fit_dataset(make_pool(rng)[:1])
    assert "at least" in fitted.unfitted["knn_label_free"]


# --- the hash -----------------------------------------------------------------------------------


def test_hash_is_the_one_that_datasets_have() -> None:
    # Of commit d434e8b. Another one makes every kept examination void.
    scorers = ("gripper_timing", "length", "object_coupling", "grip_consistency", "phase_events")
    assert fit([], scorers=scorers).scoring_hash == (
        "0dc7790d0ae0b201fb0aa957530d556e2119e7cc508c070d77f4b542cdab0e80"
    )


def test_hash_does_not_depend_on_the_order_of_the_reference(reference: list[Episode]) -> None:
    assert fit(reference).scoring_hash == fit(reference[::-1]).scoring_hash
    assert fit(reference).scoring_hash != fit(reference[1:]).scoring_hash


def test_scoring_changes_nothing(reference: list[Episode], rng: np.random.Generator) -> None:
    fitted = fit(reference)
    episode = make_episode(rng)
    first = fitted.score(episode)
    assert fitted.score(episode) == first
    assert fit(reference).scoring_hash == fitted.scoring_hash
