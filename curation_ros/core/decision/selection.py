"""Selections: which episodes a policy is trained on."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from curation_ros.core.decision.decision import CURATOR, Decision, Verdict
from curation_ros.core.decision.manifest import Entry
from curation_ros.core.decision.rules import Case, Rule
from curation_ros.core.decision.ties import TieKey, ranking, unique
from curation_ros.core.errors import ConfigError, CurationError, EpisodeError


@dataclass(frozen=True)
class Candidate:
    """An episode that may be selected.

    Attributes:
        episode, name: its identity.
        score: higher is better; None where the scorer abstained or was not asked.
        decision: the decision in force, None where there is none.
        is_trusted: whether its recording has no fault that needs a person.
    """

    episode: str
    name: str
    score: float | None = None
    decision: Decision | None = None
    is_trusted: bool = True

    @property
    def is_refused(self) -> bool:
        """Whether a person has discarded it or left it for review: no score outranks that."""
        return self._by_person("review", "discard")

    @property
    def counts(self) -> bool:
        """Whether its score counts: its recording has no fault, or a person keeps it."""
        return self.is_trusted or self._by_person("keep", "salvage")

    def _by_person(self, *verdicts: Verdict) -> bool:
        decision = self.decision
        return decision is not None and decision.by != CURATOR and decision.verdict in verdicts


@dataclass(frozen=True)
class Selection:
    """What a rule made of the candidates.

    Attributes:
        entries: what is kept, best first; where nothing ranks, in the order of the tie keys.
        abstained: ids of the episodes that the rule could not decide on: without a score or a
            decision, with a fault of the recording, or between the groups of `gap`.
        kept_of: number of candidates.
    """

    entries: tuple[Entry, ...]
    abstained: tuple[str, ...]
    kept_of: int


def select(
    candidates: Iterable[Candidate],
    rule: Rule,
    *,
    seed: int = 0,
    tie: TieKey | None = None,
    resolution: float = 0.0,
) -> Selection:
    """Choose episodes by a rule.

    A rule that reads scores gives the same verdicts as in `curation score`, on the same episodes:
    those whose recording has no fault. What a person has discarded or left for review is not
    among them.

    Args:
        candidates: the episodes to choose from; their order does not matter.
        rule: not fitted.
        seed: seed of the tie keys.
        tie: episode id -> key that orders equal scores; by default `tie_key(seed, id)`. Where
            task, start and repetition are known, `tie_key(seed, task, start, repetition)`.
        resolution: difference in score that counts as none (`Scorer.resolution`), for `gap`.

    Raises:
        ConfigError: if the rule cannot select, an episode is there twice, or a score is not
            finite.
        CurationError: if the rule has no basis to decide on any episode.
    """
    pool = list(candidates)
    _check_candidates(pool)
    check_selects(rule)
    key = unique(tie, seed)
    pool.sort(key=lambda c: key(c.episode))
    if rule.reads_scores:
        return _by_scores(pool, rule, key, resolution)
    decided = [(c, rule.verdict(Case(c.episode, {}, decision=c.decision))[0]) for c in pool]
    entries = tuple(_entry(c, verdict) for c, verdict in decided if verdict in _KEPT)
    # Without a decision, `decisions` has nothing to go by; `all` asks for none.
    unknown = tuple(c.episode for c, v in decided if v == "review" and c.decision is None)
    return Selection(entries, unknown, len(pool))


_KEPT: tuple[Verdict, ...] = ("keep", "salvage")


def check_selects(rule: Rule) -> None:
    """Refuse a rule that cannot select from what is logged.

    Raises:
        ConfigError: saying what to do instead.
    """
    if not rule.selects or rule.needs == "reference":
        raise ConfigError(f"rule {rule.name!r}: {rule.instead}")


def _by_scores(pool: Sequence[Candidate], rule: Rule, key: TieKey, resolution: float) -> Selection:
    """The selection by a rule that reads scores, from a pool in the order of the tie keys."""
    known = {c.episode: c for c in pool if not c.is_refused}
    scores = {i: c.score for i, c in known.items() if c.score is not None and c.counts}
    if rule.needs == "dataset":
        try:
            rule.fit_dataset(scores, resolution=resolution, tie=key)
        except EpisodeError as err:
            raise _no_basis(rule, str(err)) from err
    if rule.no_basis:
        raise _no_basis(rule, rule.no_basis)
    verdicts = {i: rule.verdict(Case(i, {rule.scorer: x}))[0] for i, x in scores.items()}
    order = ranking(scores, key)
    return Selection(
        entries=tuple(Entry(i, known[i].name) for i in order if verdicts[i] == "keep"),
        abstained=(
            *(i for i in known if i not in scores),
            *(i for i in order if verdicts[i] == "review"),
        ),
        kept_of=len(pool),
    )


def _no_basis(rule: Rule, why: str) -> CurationError:
    return CurationError(
        f"rule {rule.name!r}: {why}; nothing is selected: have a person review the episodes, or "
        "choose by another rule"
    )


def _entry(candidate: Candidate, verdict: Verdict) -> Entry:
    """The whole episode, or the part that a decision salvages."""
    span = None
    if verdict == "salvage" and candidate.decision is not None:
        span = candidate.decision.span
    return Entry(candidate.episode, candidate.name, span)


def _check_candidates(pool: Sequence[Candidate]) -> None:
    known = set()
    for candidate in pool:
        if candidate.episode in known:
            raise ConfigError(f"selection: episode {candidate.episode} is there twice")
        known.add(candidate.episode)
        if candidate.score is not None and not math.isfinite(candidate.score):
            raise ConfigError(
                f"selection: episode {candidate.episode} has the score {candidate.score}; "
                "one that abstained has None"
            )
