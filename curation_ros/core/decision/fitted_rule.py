"""A rule with what it was fitted on: a reference, a dataset, or nothing."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

from curation_ros.core.decision.fitted_scorers import NO_REFERENCE, FittedScorers, views
from curation_ros.core.decision.rules import Rule
from curation_ros.core.decision.state_hash import state_hash
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers.registry import contained

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

Basis = Literal["final", "provisional"]

#: References are scored by scorers that were fitted without them; above this many, in groups.
_MAX_FOLDS = 20
#: While a dataset grows, a rule over it waits for this many scored episodes: the best of two may
#: be bad, and a share was asked for of a dataset that is not there yet.
_MIN_PROVISIONAL = 4


@dataclass(frozen=True)
class FittedRule:
    """A rule that can decide, or the reason why it cannot.

    Attributes:
        rule: None where it could not be fitted.
        no_rule: why not.
        basis: `provisional` while the dataset that it was fitted on may still grow.
        fitted_on: `what` it was fitted on (nothing, reference, dataset), the number of
            `episodes`, and a `hash` over their ids and scores.
        scoring_hash: of the scorers that it was fitted with.
        state_hash: of scorers and rule with all that they have learned.
    """

    rule: Rule | None
    no_rule: str = NO_REFERENCE
    basis: Basis = "final"
    fitted_on: Mapping[str, Any] = field(default_factory=dict)
    scoring_hash: str = ""
    state_hash: str = ""

    def with_scorers(self, fitted: FittedScorers) -> FittedRule:
        """The same rule with scorers that have learned from the dataset since."""
        return _fitted_rule(fitted, self.rule, self.no_rule, self.basis, self.fitted_on)


def fit_rule(fitted: FittedScorers, reference: Iterable[Episode]) -> FittedRule:
    """Fit the rule as far as a reference goes.

    Args:
        fitted: scorers, fitted on that reference.
        reference: trusted episodes; may be empty.

    Raises:
        EpisodeError: naming a reference episode that the deciding scorer cannot score. If it can
            score none of them, and the rule has other evidence, the rule goes without it.
    """
    episodes = sorted(reference, key=lambda e: e.id)
    rule = fitted.settings.make_rule()
    scorer = fitted.settings.rule_scorer
    rule.fit_consulted(
        {
            name: _scores_of(fitted, name, episodes)
            for name in rule.consults
            if name in fitted.scorers and name not in fitted.unfitted
        }
    )
    if rule.needs == "nothing":
        return _fitted_rule(fitted, rule.fit([]), "", "final", {"what": "nothing"})
    if rule.needs == "dataset":
        nothing = {"what": "dataset", "episodes": 0}
        return _fitted_rule(fitted, None, "no other episode is scored yet", "final", nothing)
    fitted_on: dict[str, Any] = {"what": "reference", "episodes": len(episodes)}
    why = _no_reference(fitted, rule, len(episodes))
    if why:
        return _fitted_rule(fitted, rule.without_reference(why), why, "final", fitted_on)
    try:
        scores = _held_out_scores(fitted, scorer, episodes)
    except EpisodeError as err:
        # If it can score some of them, the others are at fault. If it can score none, this robot
        # lacks what the scorer reads.
        alone = rule.without_reference(str(err))
        if alone is None or _scores_of(fitted, scorer, episodes):
            raise
        return _fitted_rule(fitted, alone, str(err), "final", fitted_on)
    rule.fit(list(scores.values()), resolution=fitted.scorers[scorer].resolution)
    return _fitted_rule(fitted, rule, "", "final", _fitted_on("reference", scores))


def fit_rule_over(
    fitted: FittedScorers,
    scores: Mapping[str, float | None],
    *,
    final: bool,
    tie: TieKey | None = None,
) -> FittedRule:
    """Fit a rule that looks at the dataset.

    Args:
        fitted: scorers that gave the scores.
        scores: episode id -> the deciding scorer's score, None where it abstained. Of every
            episode of the dataset without a fault of its recording, or of those scored so far.
        final: whether the dataset is complete.
        tie: episode id -> key that orders equal scores.
    """
    rule = fitted.settings.make_rule()
    scorer = fitted.settings.rule_scorer
    known = {k: v for k, v in scores.items() if v is not None}
    fitted_on = _fitted_on("dataset", known)
    if scorer in fitted.unfitted:
        why = f"{scorer} cannot tell: {fitted.unfitted[scorer]}"
        return _fitted_rule(fitted, None, why, "provisional", fitted_on)
    basis: Basis = "final" if final else "provisional"
    least = max(rule.min_episodes, _MIN_PROVISIONAL)
    if not final and len(known) < least:
        why = f"the rule needs {least} scored episodes; there are {len(known)}"
        return _fitted_rule(fitted, None, why, basis, fitted_on)
    try:
        rule.fit_dataset(known, resolution=fitted.scorers[scorer].resolution, tie=tie)
    except EpisodeError as err:
        return _fitted_rule(fitted, None, str(err), basis, fitted_on)
    return _fitted_rule(fitted, rule, "", basis, fitted_on)


def _fitted_rule(
    fitted: FittedScorers,
    rule: Rule | None,
    no_rule: str,
    basis: Basis,
    fitted_on: Mapping[str, Any],
) -> FittedRule:
    """With the hash of everything that it has learned."""
    settings = fitted.settings
    state = {
        "scoring": fitted.scoring_hash,
        "name": settings.rule,
        "scorer": settings.rule_scorer,
        "params": settings.rule_params,
        "fitted": rule.fitted() if rule is not None else no_rule,
        "seen": dict(fitted_on),
    }
    return FittedRule(
        rule, no_rule, basis, dict(fitted_on), fitted.scoring_hash, state_hash(state)
    )


def _fitted_on(what: str, scores: Mapping[str, float]) -> dict[str, Any]:
    """What a rule was fitted on, as plain JSON."""
    return {"what": what, "episodes": len(scores), "hash": state_hash(scores)}


def _no_reference(fitted: FittedScorers, rule: Rule, n: int) -> str:
    """Why the rule cannot be fitted on n reference episodes; empty where it can."""
    scorer = fitted.settings.rule_scorer
    if not n:
        return NO_REFERENCE
    if n < rule.min_references:
        return f"the rule needs {rule.min_references} reference episodes, there are {n}"
    if scorer in fitted.unfitted:
        return f"{scorer}: {fitted.unfitted[scorer]}"
    return ""


def _scores_of(fitted: FittedScorers, name: str, episodes: Sequence[Episode]) -> list[float]:
    """Scores of the episodes that a scorer does not abstain on."""
    scorer = fitted.scorers[name]
    found = []
    for episode in views(scorer, episodes, fitted.length):
        with suppress(EpisodeError), contained(name):
            found.append(scorer.score(episode))
    return found


def _held_out_scores(
    fitted: FittedScorers, name: str, episodes: Sequence[Episode]
) -> dict[str, float]:
    """Id -> score of the reference, each by a scorer that was fitted without that episode."""
    whole = fitted.scorers[name]
    shown = views(whole, episodes, fitted.length)
    n_folds = min(len(shown), _MAX_FOLDS) if whole.needs == "reference" else 1
    shuffled = sorted(shown, key=lambda e: hashlib.sha256(e.id.encode()).digest())
    scores = {}
    for fold in range(n_folds):
        held_out = shuffled[fold::n_folds]
        scorer = whole
        if n_folds > 1:
            ids = {e.id for e in held_out}
            with contained(name):
                scorer = fitted.settings.make_scorer(name)
                scorer.fit([e for e in shown if e.id not in ids])
        for episode in held_out:
            try:
                with contained(name):
                    scores[episode.id] = scorer.score(episode)
            except EpisodeError as err:
                raise EpisodeError(
                    f"reference episode {episode.name} ({episode.id}): "
                    f"{name} cannot score it: {err}"
                ) from err
    return scores
