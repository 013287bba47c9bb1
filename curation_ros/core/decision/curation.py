"""Scoring: scorers, length control and a rule, fitted together on a trusted reference."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, Any, Literal

from curation_ros.core.decision.decision import CURATOR, Decision, untrustworthy
from curation_ros.core.decision.examination import Break, Examination, Part
from curation_ros.core.decision.judgement import Ruling, decide
from curation_ros.core.decision.rules import Rule, make_rule
from curation_ros.core.decision.salvage import DEFAULT_MARGIN_S, good_prefix, sound_part
from curation_ros.core.decision.state_hash import state_hash
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode
from curation_ros.core.evidence.gripper import gripper_findings
from curation_ros.core.evidence.length_control import LengthControl
from curation_ros.core.scorers import DEFAULT_SCORERS, Look, PoolScorer, Scorer, find_scorer
from curation_ros.core.scorers.features import phase_name

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode

NO_REFERENCE = "no reference"
NO_DATASET = "it compares with the whole dataset, which was not given"
#: Checks that read the gripper's command: void where its meaning is in doubt.
_BY_GRIPPER = ("clipped-start", "grip-lost", "never-grasped", "opened-early", "unfinished")
#: Refused references that are named; a mistake in a topic map is one of all of them.
_SHOWN = 3
#: Raised when the meaning of the state hash, or what an examination finds, changes.
_STATE_VERSION = 5
#: References are scored by scorers that were fitted without them; above this many, in groups.
_MAX_FOLDS = 20
#: While a dataset grows, a rule over it waits for so many scored episodes: the best of two may be
#: bad, and the share that was asked for is of a dataset that is not there yet.
_MIN_PROVISIONAL = 4


class Curation:
    """The curator without its node: an episode goes in, scores and a decision come out.

    Invariant: after `fit` (and `fit_dataset`, where something needs that), scores are functions
    of the episode and of a fitted state whose hash is `scoring_hash`, and decisions of that and
    of a `Ruling`, with its `state_hash`; neither the order of the reference or the dataset nor
    the number of episodes that are scored changes them.

    Attributes:
        scorers_: name -> fitted scorer, in the order asked for.
        unfitted_: name -> why a scorer could not be fitted; it abstains with that.
        length_: fitted length control; without a reference a mode that needs one becomes 'none'.
        ruling_: the rule, as far as it can be fitted without the dataset.
        baseline_: what the reference looks like, for the checks.
        reference_ids_: sorted ids of the reference episodes.
        dataset_ids_: sorted ids of the dataset's episodes, where `fit_dataset` has seen them.
    """

    def __init__(
        self,
        *,
        scorers: Sequence[str] = DEFAULT_SCORERS,
        rule: str = "evidence",
        rule_scorer: str = "gripper_timing",
        length: str = "shortest-reference",
        length_value: float | None = None,
        scorer_params: Mapping[str, Mapping[str, Any]] | None = None,
        rule_params: Mapping[str, Any] | None = None,
        salvage_margin_s: float | None = DEFAULT_MARGIN_S,
    ) -> None:
        """Check and store the configuration.

        Args:
            scorers: names of scorers (`curation scorers` lists them); each scores every episode.
            rule: name in RULES.
            rule_scorer: the one of `scorers` that decides.
            length: mode of the length control.
            length_value: its value, for the modes that take one.
            scorer_params: scorer -> its hyper-parameters, where they are not the defaults.
            rule_params: hyper-parameters of the rule.
            salvage_margin_s: a beginning that is salvaged ends at least so long before the
                episode broke, seconds from 0; None: nothing is salvaged.

        Raises:
            ConfigError: naming what does not exist, and what does.
        """
        self.scorers = tuple(scorers)
        self.rule = rule
        self.rule_scorer = rule_scorer
        self.length = length
        self.length_value = length_value
        self.scorer_params = {k: dict(v) for k, v in (scorer_params or {}).items()}
        self.rule_params = dict(rule_params or {})
        self.salvage_margin_s = salvage_margin_s
        if salvage_margin_s is not None and not 0.0 <= salvage_margin_s < math.inf:
            raise ConfigError(
                f"salvage_margin_s is {salvage_margin_s}, expected seconds from 0, or nothing"
            )
        if not self.scorers or len(set(self.scorers)) < len(self.scorers):
            raise ConfigError(f"scorers {list(self.scorers)}: expected names, each once")
        for name in (*self.scorers, *self.scorer_params):
            find_scorer(name)
        for name in self.scorer_params:
            if name not in self.scorers:
                raise ConfigError(
                    f"parameters for scorer {name!r}, which is none of {', '.join(self.scorers)}"
                )
        if rule_scorer not in self.scorers:
            raise ConfigError(
                f"rule_scorer {rule_scorer!r} is none of the scorers {', '.join(self.scorers)}"
            )
        for name in self.scorers:
            self._make_scorer(name)
        self._make_rule()
        LengthControl(length, length_value)

    def _make_scorer(self, name: str) -> Scorer:
        params = self.scorer_params.get(name, {})
        known = find_scorer(name)().params()
        for key, value in params.items():
            if key not in known:
                known_names = ", ".join(known) or "none"
                raise ConfigError(
                    f"scorer {name!r} has no parameter {key!r}; it has {known_names}"
                )
            if not _fits(value, known[key]):
                raise ConfigError(
                    f"scorer {name!r}: {key} is {value!r}, expected one like {known[key]!r}"
                )
        scorer = find_scorer(name)(**params)
        scorer.check_params()
        return scorer

    def _make_rule(self) -> Rule:
        rule = make_rule(self.rule, self.rule_scorer, self.rule_params)
        if not rule.decides:
            raise ConfigError(f"rule {self.rule!r}: {rule.instead}")
        return rule

    def fit(self, reference: Iterable[Episode]) -> Self:
        """Learn from trusted episodes; what was learned before is forgotten.

        Args:
            reference: may be empty: then scorers that need one abstain, and a rule that needs
                one leaves every episode for review.

        Raises:
            EpisodeError: naming each reference episode that cannot be trusted, or that the
                deciding scorer cannot score, and why; where it can score none of them, and the
                rule has other evidence, that goes on without it.
        """
        episodes = sorted(reference, key=lambda e: e.id)
        vars(self).pop("scoring_hash_", None)  # a fit that fails leaves nothing to score with
        _check_reference(episodes)
        self.reference_ids_ = tuple(e.id for e in episodes)
        self.dataset_ids_: tuple[str, ...] = ()
        self.length_ = LengthControl(self.length, self.length_value)
        if self.length_.needs_reference and not episodes:
            self.length_ = LengthControl("none")
        self.length_.fit(episodes)
        self.baseline_ = Baseline().fit(episodes)
        self.scorers_: dict[str, Scorer] = {}
        self.unfitted_: dict[str, str] = {}
        for name in self.scorers:
            scorer = self._make_scorer(name)
            self.scorers_[name] = scorer
            if scorer.needs == "dataset":
                self.unfitted_[name] = NO_DATASET
                continue
            if scorer.needs == "reference" and not episodes:
                self.unfitted_[name] = NO_REFERENCE
                continue
            try:
                scorer.fit(self._views(scorer, episodes))
            except EpisodeError as err:
                self.unfitted_[name] = str(err)
        rule, no_rule, seen = self._reference_rule(episodes)
        self.scoring_hash_ = self._hash_scoring()
        self.ruling_ = self._ruling(rule, no_rule, "final", seen)
        return self

    @property
    def needs_dataset(self) -> bool:
        """Whether `fit_dataset` is to be called before scoring, so that nobody abstains."""
        by_length = self.length == "percentile" and self.length_.mode == "none"
        return by_length or any(s.needs == "dataset" for s in self.scorers_.values())

    def fit_dataset(self, episodes: Iterable[Episode]) -> Self:
        """Let scorers that need it learn from the dataset that is to be scored, without labels.

        Args:
            episodes: all of them, in any order; may be a stream that is read again each time it
                is iterated: one episode is held at a time. Iterated twice where the length
                control learns from their lengths, else once.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        if self.length == "percentile" and self.length_.mode == "none":
            lengths = [len(e) for e in episodes]
            self.length_ = LengthControl(self.length, self.length_value).fit_lengths(lengths)
        pools = {k: s for k, s in self.scorers_.items() if isinstance(s, PoolScorer)}
        rows: dict[str, dict[str, Any]] = {name: {} for name in pools}
        ids = set()
        for episode in episodes:
            ids.add(episode.id)
            for name, scorer in pools.items():
                try:
                    [view] = self._views(scorer, [episode])
                    rows[name][episode.id] = scorer.summary(view)
                except EpisodeError:  # it will abstain when it is asked to score that one, too
                    continue
        for name, scorer in pools.items():
            self.unfitted_.pop(name, None)
            try:
                found = sorted(rows[name])
                scorer.fit_summaries(found, [rows[name][i] for i in found])
            except EpisodeError as err:
                self.unfitted_[name] = str(err)
        self.dataset_ids_ = tuple(sorted(ids))
        self.scoring_hash_ = self._hash_scoring()
        old = self.ruling_
        self.ruling_ = self._ruling(old.rule, old.no_rule, "final", dict(old.fitted_on))
        return self

    def _views(self, scorer: Scorer, episodes: Sequence[Episode]) -> list[Episode]:
        """Episodes as a scorer is to see them."""
        if not scorer.length_controlled:
            return list(episodes)
        return [self.length_.apply(e) for e in episodes]

    def _reference_rule(
        self, episodes: Sequence[Episode]
    ) -> tuple[Rule | None, str, dict[str, Any]]:
        """The rule as far as the reference fits it, else why there is none; what it has seen."""
        rule = self._make_rule()
        scorer = self.scorers_[self.rule_scorer]
        rule.fit_consulted(
            {
                name: self._scores_told(self.scorers_[name], episodes)
                for name in rule.consults
                if name in self.scorers_ and name not in self.unfitted_
            }
        )
        if rule.needs == "nothing":
            return rule.fit([]), "", {"what": "nothing"}
        if rule.needs == "dataset":
            return None, "no other episode is scored yet", {"what": "dataset", "episodes": 0}
        why = ""
        if not episodes:
            why = NO_REFERENCE
        elif len(episodes) < rule.min_references:
            why = (
                f"the rule needs {rule.min_references} reference episodes, "
                f"there are {len(episodes)}"
            )
        elif self.rule_scorer in self.unfitted_:
            why = f"{self.rule_scorer}: {self.unfitted_[self.rule_scorer]}"
        seen = {"what": "reference", "episodes": len(episodes)}
        if why:
            return rule.without_reference(why), why, seen
        try:
            scores = self._reference_scores(self.rule_scorer, episodes)
        except EpisodeError as err:
            # One of them may be at fault; all of them are not: this robot has nothing to score.
            if self._scores_told(scorer, episodes):
                raise
            alone = rule.without_reference(str(err))
            if alone is None:
                raise
            return alone, str(err), seen
        rule.fit(list(scores.values()), resolution=scorer.resolution)
        return rule, "", _seen("reference", scores)

    def _scores_told(self, scorer: Scorer, episodes: Sequence[Episode]) -> list[float]:
        """Scores of the episodes that a scorer does not abstain on."""
        found = []
        for episode in self._views(scorer, episodes):
            with suppress(EpisodeError):
                found.append(scorer.score(episode))
        return found

    def ruling(
        self, scores: Mapping[str, float | None], *, final: bool, tie: TieKey | None = None
    ) -> Ruling:
        """The rule, fitted on the dataset where it needs that.

        Args:
            scores: episode id -> the deciding scorer's score of every episode of the dataset, or
                of those seen so far; None where it abstained.
            final: whether these are all there will be.
            tie: see `Rule.fit_dataset`.

        Returns:
            `ruling_` where the rule does not look at the dataset.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        rule = self._make_rule()
        if rule.needs != "dataset":
            return self.ruling_
        known = {k: v for k, v in scores.items() if v is not None}
        if self.rule_scorer in self.unfitted_:
            why = f"{self.rule_scorer} cannot tell: {self.unfitted_[self.rule_scorer]}"
            return self._ruling(None, why, "provisional", _seen("dataset", known))
        basis: Literal["final", "provisional"] = "final" if final else "provisional"
        seen = _seen("dataset", known)
        resolution = self.scorers_[self.rule_scorer].resolution
        least = max(rule.min_episodes, _MIN_PROVISIONAL)
        if not final and len(known) < least:
            why = f"the rule needs {least} scored episodes; there are {len(known)}"
            return self._ruling(None, why, basis, seen)
        try:
            rule.fit_dataset(known, resolution=resolution, tie=tie)
        except EpisodeError as err:
            return self._ruling(None, str(err), basis, seen)
        return self._ruling(rule, "", basis, seen)

    @property
    def rule_looks_at_dataset(self) -> bool:
        """Whether a decision depends on the scores of the other episodes."""
        return self._make_rule().needs == "dataset"

    @staticmethod
    def is_trusted(seen: Examination) -> bool:
        """Whether an episode counts for a rule over the dataset: its recording has no fault."""
        return not untrustworthy(seen.findings)

    def _ruling(
        self,
        rule: Rule | None,
        no_rule: str,
        basis: Literal["final", "provisional"],
        seen: Mapping[str, Any],
    ) -> Ruling:
        state = {
            "scoring": self.scoring_hash_,
            "name": self.rule,
            "scorer": self.rule_scorer,
            "params": self.rule_params,
            "fitted": rule.fitted() if rule is not None else no_rule,
            "seen": dict(seen),
        }
        return Ruling(rule, no_rule, basis, dict(seen), state_hash(state))

    def _reference_scores(self, name: str, episodes: Sequence[Episode]) -> dict[str, float]:
        """Id -> score of the reference, each by a scorer that was fitted without that episode."""
        fitted = self.scorers_[name]
        views = self._views(fitted, episodes)
        n_folds = min(len(views), _MAX_FOLDS) if fitted.needs == "reference" else 1
        shuffled = sorted(views, key=lambda e: hashlib.sha256(e.id.encode()).digest())
        scores = {}
        for fold in range(n_folds):
            held_out = shuffled[fold::n_folds]
            scorer = fitted
            if n_folds > 1:
                ids = {e.id for e in held_out}
                scorer = self._make_scorer(name).fit([e for e in views if e.id not in ids])
            for episode in held_out:
                try:
                    scores[episode.id] = scorer.score(episode)
                except EpisodeError as err:
                    raise EpisodeError(
                        f"reference episode {episode.name} ({episode.id}): "
                        f"{name} cannot score it: {err}"
                    ) from err
        return scores

    def _check_fitted(self) -> None:
        if not hasattr(self, "scoring_hash_"):
            raise NotFittedError("Curation: call fit first; the reference may be empty")

    def score(self, episode: Episode) -> tuple[dict[str, float | None], dict[str, str]]:
        """Score one episode with every scorer.

        Returns:
            Scorer -> score, None where it abstained; and scorer -> why it abstained.

        Raises:
            NotFittedError: before `fit`.
        """
        looks, abstained, _ = self._looks(episode)
        return self._scores(looks), abstained

    def _scores(self, looks: Mapping[str, Look]) -> dict[str, float | None]:
        """Scorer -> score, None where it abstained."""
        return {
            name: float(looks[name].score) if name in looks else None for name in self.scorers_
        }

    def _looks(
        self, episode: Episode
    ) -> tuple[dict[str, Look], dict[str, str], dict[str, Episode]]:
        """Ask every scorer once: scorer -> its look, else why it abstained; and what it saw."""
        self._check_fitted()
        view, no_view = self._view(episode)
        looks: dict[str, Look] = {}
        abstained: dict[str, str] = {}
        views: dict[str, Episode] = {}
        for name, scorer in self.scorers_.items():
            shown = view if scorer.length_controlled else episode
            if name in self.unfitted_ or shown is None:
                abstained[name] = self.unfitted_.get(name, no_view)
                continue
            try:
                look = scorer.look(shown)
            except EpisodeError as err:  # Abstain is one
                abstained[name] = str(err)
                continue
            if math.isfinite(look.score):
                looks[name], views[name] = look, shown
            else:
                abstained[name] = f"its score is {look.score}"
        return looks, abstained, views

    def _view(self, episode: Episode) -> tuple[Episode | None, str]:
        """The episode under length control, or why there is none."""
        try:
            return self.length_.apply(episode), ""
        except EpisodeError as err:
            return None, str(err)

    def examine(self, episode: Episode) -> Examination:
        """Score one episode and look at it; what a rule judges by.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        findings = self._findings(episode)
        looks, abstained, views = self._looks(episode)
        part = None
        kept = sound_part(episode, untrustworthy(findings))
        if kept is not None:
            rest = episode.steps(kept[1] + 1, kept[0])
            less = untrustworthy(self._findings(rest))
            if all(f.id in {g.id for g in findings} for f in less):
                some, silent, _ = self._looks(rest)
                cut = untrustworthy(findings)[0]
                part = Part(
                    episode.span(*kept),
                    f"{cut.id}: {cut.message}",
                    self._scores(some),
                    silent,
                    _explanations(some),
                )
        evidence: dict[str, Any] = {"length_steps": self.length_.steps_}
        seen = {
            name: {
                "span": list(views[name].span(*look.steps)),
                "phase": phase_name(views[name], look.steps[0]),
            }
            for name, look in looks.items()
            if look.steps is not None
        }
        if seen:
            evidence["seen"] = seen
        return Examination(
            episode=episode.id,
            name=episode.name,
            steps=len(episode),
            span=(0, max(0, episode.end_ns - episode.start_ns)),
            scores=self._scores(looks),
            abstained=abstained,
            words=_explanations(looks),
            findings=findings,
            evidence=evidence,
            content=episode.content_digest,
            part=part,
            breaks=self._breaks(episode, looks),
        )

    def _findings(self, episode: Episode) -> tuple[Finding, ...]:
        """Those that came with the episode, and what its arrays show."""
        seen = (*gripper_findings(episode), *check_episode(episode, self.baseline_))
        known = {f.id for f in episode.findings}
        if any(f.id == "gripper-meaning" for f in (*episode.findings, *seen)):
            known.update(_BY_GRIPPER)
        return (*episode.findings, *(f for f in seen if f.id not in known))

    def _breaks(self, episode: Episode, looks: Mapping[str, Look]) -> dict[str, Break]:
        """Where scorers see the whole episode break."""
        found: dict[str, Break] = {}
        margin_s = self.salvage_margin_s
        for name, look in looks.items():
            if margin_s is None or self.scorers_[name].length_controlled:
                continue
            step = look.broke_at
            if step is not None:
                kept = good_prefix(episode, step, margin_s)
                at_ns = int(episode.stamps_ns[step]) - episode.start_ns
                found[name] = Break(at_ns, margin_s, kept and episode.span(*kept))
        return found

    def judge(
        self,
        seen: Examination,
        ruling: Ruling | None = None,
        *,
        revision: int = 1,
        by: str = CURATOR,
    ) -> Decision:
        """Decide on an episode that was examined.

        Args:
            seen: by this curation.
            ruling: of this curation; None: what `fit` made, without a look at the dataset.
            revision: number of the decision.
            by: author.
        """
        ruling = self.ruling_ if ruling is None else ruling
        evidence: dict[str, Any] = {
            "basis": ruling.basis,
            "fitted_on": dict(ruling.fitted_on),
            "scoring": self.scoring_hash_,
            "content": seen.content,
        }
        rule = ruling.rule
        if rule is not None and rule.cut is not None and rule.decider(seen.scores) == rule.scorer:
            evidence["threshold"] = float(rule.cut)
        return decide(
            seen,
            ruling.rule,
            evidence=evidence,
            no_rule=ruling.no_rule,
            revision=revision,
            by=by,
            state_hash=ruling.state_hash,
        )

    def decide(self, episode: Episode, revision: int = 1, by: str = CURATOR) -> Decision:
        """Examine one episode and decide on it, without a look at the dataset.

        Raises:
            NotFittedError: before `fit`.
        """
        return self.judge(self.examine(episode), revision=revision, by=by)

    @property
    def scoring_hash(self) -> str:
        """SHA-256 over scorers, length control, sorted reference ids and everything learned.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        return self.scoring_hash_

    @property
    def state_hash(self) -> str:
        """SHA-256 over `scoring_hash` and the rule, as far as the reference has fitted it.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        return self.ruling_.state_hash

    def _hash_scoring(self) -> str:
        state = {
            "version": _STATE_VERSION,
            "salvage_margin_s": self.salvage_margin_s,
            "scorers": {
                name: {
                    "version": scorer.version,
                    "params": scorer.params(),
                    "fitted": scorer.fitted(),
                    "unfitted": self.unfitted_.get(name),
                }
                for name, scorer in self.scorers_.items()
            },
            "length": self.length_.describe(),
            "baseline": self.baseline_.fitted(),
            "reference": self.reference_ids_,
            "dataset": self.dataset_ids_,
        }
        return state_hash(state)

    def describe(self) -> str:
        """For people: what scores, what each scorer needs, and what decides.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        lines = [f"reference: {len(self.reference_ids_)} episodes"]
        steps = self.length_.steps_
        lines.append(
            f"length control: {self.length_.mode}"
            + (f", {steps} steps" if steps is not None else "")
        )
        for name, scorer in self.scorers_.items():
            line = f"scorer {name}: needs {scorer.needs}"
            params = ", ".join(f"{k}={v}" for k, v in scorer.params().items())
            line += f" ({params})" if params else ""
            fitted = scorer.fitted().get("k_")
            if fitted is not None and fitted < scorer.params()["k"]:
                line += f"; only {fitted} reference episodes to compare with"
            if name in self.unfitted_:
                line += f"; abstains: {self.unfitted_[name]}"
            lines.append(line)
        if self.ruling_.rule is not None:
            lines.append(f"rule {self.rule}: {self.ruling_.rule.describe()}")
        elif self._make_rule().needs == "dataset":
            lines.append(f"rule {self.rule}: {self._make_rule().describe()}")
        else:
            lines.append(f"rule {self.rule}: review: {self.ruling_.no_rule}")
        return "\n".join(lines)


def _explanations(looks: Mapping[str, Look]) -> dict[str, str]:
    """Scorer -> its explanation, where it has one."""
    return {n: look.explanation for n, look in looks.items() if look.explanation is not None}


def _seen(what: str, scores: Mapping[str, float]) -> dict[str, Any]:
    """What a rule was fitted on, as plain JSON."""
    return {"what": what, "episodes": len(scores), "hash": state_hash(scores)}


def _fits(value: object, default: object) -> bool:
    """Whether a value is of the kind of a default: a text that says 'False' is no bool."""
    if isinstance(default, bool) or isinstance(value, bool):
        return isinstance(default, bool) and isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, (int, float))
    return isinstance(value, type(default))


def _check_reference(episodes: Sequence[Episode]) -> None:
    """Refuse a reference that cannot be trusted.

    Raises:
        EpisodeError: naming every episode and why.
    """
    refused = []
    seen: set[str] = set()
    for episode in episodes:
        if episode.id in seen:
            refused.append(f"{episode.name} ({episode.id}): it is there twice")
        seen.add(episode.id)
        seen_in = (*episode.findings, *gripper_findings(episode), *check_episode(episode))
        faults = untrustworthy(seen_in)
        if faults:
            refused.append(f"{episode.name} ({episode.id}): {faults[0].id}: {faults[0].message}")
    if refused:
        more = f"; and {len(refused) - _SHOWN} more" if len(refused) > _SHOWN else ""
        raise EpisodeError(f"reference refused: {'; '.join(refused[:_SHOWN])}{more}")
