"""A rule fitted on a reference or on a dataset, and why it sometimes cannot be."""

from __future__ import annotations

import numpy as np
import pytest
from episodes import make_episode, make_reference

from curation_ros.core.decision.deciding import decide
from curation_ros.core.decision.examining import examine
from curation_ros.core.decision.fitted_rule import fit_rule, fit_rule_over
from curation_ros.core.decision.fitted_scorers import fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_reference(rng)


@pytest.mark.parametrize("rule_scorer", ["knn", "trajectory_alignment"])
def test_reference_is_scored_by_scorers_that_had_not_seen_it(
    rule_scorer: str, reference: list[Episode]
) -> None:
    fitted = fit_scorers(CurationSettings(rule_scorer=rule_scorer), reference)
    known = [fitted.score(e)[0][rule_scorer] for e in reference]
    rule = fit_rule(fitted, reference).rule
    assert rule is not None
    assert rule.fitted()["low_"] < min(s for s in known if s is not None)


def test_rule_over_the_dataset_says_why_its_scorer_is_silent(rng: np.random.Generator) -> None:
    fitted = fit_scorers(CurationSettings(rule="gap", rule_scorer="knn"), [])
    rule = fit_rule_over(fitted, {"a": None, "b": None}, final=True)
    assert (rule.rule, rule.no_rule) == (None, "knn cannot tell: no reference")
    decision = decide(examine(fitted, make_episode(rng)), rule)
    assert (decision.verdict, decision.reason) == ("review", "knn cannot tell: no reference")


def test_reference_that_the_deciding_scorer_cannot_score_is_refused_by_name(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    never = make_episode(rng, name="bad-3", close_at=None)
    with pytest.raises(EpisodeError, match=r"bad-3 .*gripper_timing cannot score it: the gripper"):
        fit_rule(fit_scorers(CurationSettings(), [*reference, never]), [*reference, never])
    by_knn = fit_scorers(CurationSettings(rule_scorer="knn"), [*reference, never])
    assert fit_rule(by_knn, [*reference, never]).rule is not None


def test_two_references_are_too_few_for_a_threshold(reference: list[Episode]) -> None:
    fitted = fit_scorers(CurationSettings(rule="threshold"), reference[:2])
    rule = fit_rule(fitted, reference[:2])
    assert (rule.rule, rule.no_rule) == (
        None,
        "the rule needs 3 reference episodes, there are 2",
    )
    assert rule.fitted_on == {"what": "reference", "episodes": 2}


SCORES = {"a": 1.0, "b": 2.0, "c": 3.0, "d": None}


@pytest.mark.parametrize("name", ["top-fraction", "top-k"])
def test_growing_dataset_needs_four_scores_and_a_complete_one_does_not(name: str) -> None:
    fitted = fit_scorers(CurationSettings(rule=name, rule_scorer="length"), [])
    growing = fit_rule_over(fitted, SCORES, final=False)
    assert (growing.rule, growing.basis) == (None, "provisional")
    assert growing.no_rule == "the rule needs 4 scored episodes; there are 3"
    complete = fit_rule_over(fitted, SCORES, final=True)
    assert (complete.rule is not None, complete.basis) == (True, "final")
    assert complete.fitted_on["episodes"] == 3
    four = fit_rule_over(fitted, {**SCORES, "d": 4.0}, final=False)
    assert (four.rule is not None, four.basis) == (True, "provisional")


def test_dataset_without_a_score_fits_no_ranking() -> None:
    fitted = fit_scorers(CurationSettings(rule="top-k", rule_scorer="length"), [])
    assert fit_rule_over(fitted, {"a": None}, final=True).no_rule == "no episode has a score"


def test_hash_of_a_rule_covers_what_it_was_fitted_on_and_its_scorers(
    reference: list[Episode],
) -> None:
    fitted = fit_scorers(CurationSettings(rule="top-k", rule_scorer="length"), reference)
    four = {**SCORES, "d": 4.0}
    rules = [
        fit_rule(fitted, reference),
        fit_rule_over(fitted, four, final=True),
        fit_rule_over(fitted, {**four, "d": 4.5}, final=True),
        fit_rule_over(fit_scorers(fitted.settings, []), four, final=True),
    ]
    assert len({rule.state_hash for rule in rules}) == 4
    other_order = fit_rule_over(fitted, dict(reversed(four.items())), final=True)
    assert other_order.state_hash == rules[1].state_hash
