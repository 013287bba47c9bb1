"""Scoring: scorers, length control and a rule, fitted together on a trusted reference."""

from __future__ import annotations

import hashlib
import math
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from curation_ros.core.decisions import CURATOR, RULES, Decision, Rule, decide, untrustworthy
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.gripper import gripper_findings
from curation_ros.core.length_control import LengthControl
from curation_ros.core.scorers import SCORERS, Scorer
from curation_ros.core.scorers.features import phase_name

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode

NO_REFERENCE = "no reference"
#: Raised when the meaning of the state hash changes.
_STATE_VERSION = 1
#: References are scored by scorers that were fitted without them; above this many, in groups.
_MAX_FOLDS = 20


class Curation:
    """The curator without its node: an episode goes in, scores and a decision come out.

    Invariant: after `fit`, scores and decisions are functions of the episode and of a fitted
    state whose hash is `state_hash`; neither the order of the reference nor the number of
    episodes that are scored changes them.

    Attributes:
        scorers_: name -> fitted scorer, in the order asked for.
        unfitted_: name -> why a scorer could not be fitted; it abstains with that.
        length_: fitted length control; without a reference a mode that needs one becomes 'none'.
        rule_: fitted rule, None where it could not be fitted.
        no_rule_: why not.
        reference_ids_: sorted ids of the reference episodes.
    """

    def __init__(
        self,
        *,
        scorers: Sequence[str] = tuple(SCORERS),
        rule: str = "threshold",
        rule_scorer: str = "gripper_timing",
        length: str = "shortest-reference",
        length_value: float | None = None,
        scorer_params: Mapping[str, Mapping[str, Any]] | None = None,
        rule_params: Mapping[str, Any] | None = None,
    ) -> None:
        """Check and store the configuration.

        Args:
            scorers: names in SCORERS; each scores every episode.
            rule: name in RULES.
            rule_scorer: the one of `scorers` that decides.
            length: mode of the length control.
            length_value: its value, for the modes that take one.
            scorer_params: scorer -> its hyper-parameters, where they are not the defaults.
            rule_params: hyper-parameters of the rule.

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
        if not self.scorers or len(set(self.scorers)) < len(self.scorers):
            raise ConfigError(f"scorers {list(self.scorers)}: expected names, each once")
        for name in (*self.scorers, *self.scorer_params):
            if name not in SCORERS:
                raise ConfigError(f"no scorer {name!r}; there are {', '.join(SCORERS)}")
        for name in self.scorer_params:
            if name not in self.scorers:
                raise ConfigError(
                    f"parameters for scorer {name!r}, which is none of {', '.join(self.scorers)}"
                )
        if rule not in RULES:
            raise ConfigError(f"no rule {rule!r}; there are {', '.join(RULES)}")
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
        known = SCORERS[name]().params()
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
        scorer = SCORERS[name](**params)
        scorer.check_params()
        return scorer

    def _make_rule(self) -> Rule:
        try:
            return RULES[self.rule](scorer=self.rule_scorer, **self.rule_params)
        except TypeError as err:
            raise ConfigError(f"rule {self.rule!r}: {err}") from err

    def fit(self, reference: Iterable[Episode]) -> Self:
        """Learn from trusted episodes; what was learned before is forgotten.

        Args:
            reference: may be empty: then scorers that need one abstain, and a rule that needs
                one leaves every episode for review.

        Raises:
            EpisodeError: naming each reference episode that cannot be trusted, or that the
                deciding scorer cannot score, and why.
        """
        episodes = sorted(reference, key=lambda e: e.id)
        vars(self).pop("state_hash_", None)  # a fit that fails leaves nothing to score with
        _check_reference(episodes)
        self.length_ = LengthControl(self.length, self.length_value)
        if self.length_.needs_reference and not episodes:
            self.length_ = LengthControl("none")
        self.length_.fit(episodes)
        self.scorers_: dict[str, Scorer] = {}
        self.unfitted_: dict[str, str] = {}
        for name in self.scorers:
            scorer = self._make_scorer(name)
            self.scorers_[name] = scorer
            if scorer.needs == "reference" and not episodes:
                self.unfitted_[name] = NO_REFERENCE
                continue
            try:
                scorer.fit(self._views(scorer, episodes))
            except EpisodeError as err:
                self.unfitted_[name] = str(err)
        self._fit_rule(episodes)
        self.reference_ids_ = tuple(e.id for e in episodes)
        self.state_hash_ = self._hash()
        return self

    def _views(self, scorer: Scorer, episodes: Sequence[Episode]) -> list[Episode]:
        """Episodes as a scorer is to see them."""
        if not scorer.length_controlled:
            return list(episodes)
        return [self.length_.apply(e) for e in episodes]

    def _fit_rule(self, episodes: Sequence[Episode]) -> None:
        rule = self._make_rule()
        self.rule_: Rule | None = None
        self.no_rule_ = ""
        scorer = self.scorers_[self.rule_scorer]
        if rule.needs == "nothing":
            self.rule_ = rule.fit([])
        elif not episodes:
            self.no_rule_ = NO_REFERENCE
        elif len(episodes) < rule.min_references:
            self.no_rule_ = (
                f"the rule needs {rule.min_references} reference episodes, "
                f"there are {len(episodes)}"
            )
        elif self.rule_scorer in self.unfitted_:
            self.no_rule_ = f"{self.rule_scorer}: {self.unfitted_[self.rule_scorer]}"
        else:
            scores = self._reference_scores(self.rule_scorer, episodes)
            self.rule_ = rule.fit(scores, resolution=scorer.resolution)

    def _reference_scores(self, name: str, episodes: Sequence[Episode]) -> list[float]:
        """Scores of the reference, each by a scorer that was fitted without that episode."""
        fitted = self.scorers_[name]
        views = self._views(fitted, episodes)
        n_folds = min(len(views), _MAX_FOLDS) if fitted.needs == "reference" else 1
        shuffled = sorted(views, key=lambda e: hashlib.sha256(e.id.encode()).digest())
        scores = []
        for fold in range(n_folds):
            held_out = shuffled[fold::n_folds]
            scorer = fitted
            if n_folds > 1:
                ids = {e.id for e in held_out}
                scorer = self._make_scorer(name).fit([e for e in views if e.id not in ids])
            for episode in held_out:
                try:
                    scores.append(scorer.score(episode))
                except EpisodeError as err:
                    raise EpisodeError(
                        f"reference episode {episode.name} ({episode.id}): "
                        f"{name} cannot score it: {err}"
                    ) from err
        return scores

    def _check_fitted(self) -> None:
        if not hasattr(self, "state_hash_"):
            raise NotFittedError("Curation: call fit first; the reference may be empty")

    def score(self, episode: Episode) -> tuple[dict[str, float | None], dict[str, str]]:
        """Score one episode with every scorer.

        Returns:
            Scorer -> score, None where it abstained; and scorer -> why it abstained.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        scores: dict[str, float | None] = {}
        abstained: dict[str, str] = {}
        view = self.length_.apply(episode)
        for name, scorer in self.scorers_.items():
            scores[name] = None
            if name in self.unfitted_:
                abstained[name] = self.unfitted_[name]
                continue
            try:
                score = float(scorer.score(view if scorer.length_controlled else episode))
            except EpisodeError as err:  # Abstain is one
                abstained[name] = str(err)
                continue
            if math.isfinite(score):
                scores[name] = score
            else:
                abstained[name] = f"its score is {score}"
        return scores, abstained

    def decide(self, episode: Episode, revision: int = 1, by: str = CURATOR) -> Decision:
        """Score one episode and decide on it.

        Raises:
            NotFittedError: before `fit`.
        """
        scores, abstained = self.score(episode)
        if not any(f.id == "gripper-meaning" for f in episode.findings):
            episode = replace(episode, findings=episode.findings + gripper_findings(episode))
        words: dict[str, str] = {}
        seen: dict[str, dict[str, Any]] = {}
        view = self.length_.apply(episode)
        for name in self.scorers_:
            if name in abstained:
                continue
            scorer = self.scorers_[name]
            shown = view if scorer.length_controlled else episode
            text, steps = scorer.explain(shown), scorer.location(shown)
            if text is not None:
                words[name] = text
            if steps is not None:
                seen[name] = {
                    "span": list(shown.span(*steps)),
                    "phase": phase_name(shown, steps[0]),
                }
        evidence: dict[str, Any] = {"length_steps": self.length_.steps_}
        if seen:
            evidence["seen"] = seen
        if self.rule_ is not None and self.rule_.params().get("threshold") is not None:
            evidence["threshold"] = float(self.rule_.params()["threshold"])
        elif self.rule_ is not None and "threshold_" in self.rule_.fitted():
            evidence["threshold"] = float(self.rule_.fitted()["threshold_"])
        return decide(
            episode,
            scores,
            self.rule_,
            abstained=abstained,
            words=words,
            evidence=evidence,
            no_rule=self.no_rule_,
            revision=revision,
            by=by,
            state_hash=self.state_hash,
        )

    @property
    def state_hash(self) -> str:
        """SHA-256 over configuration, sorted reference ids and everything learned.

        Raises:
            NotFittedError: before `fit`.
        """
        self._check_fitted()
        return self.state_hash_

    def _hash(self) -> str:
        rule = self.rule_
        state = {
            "version": _STATE_VERSION,
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
            "rule": {
                "name": self.rule,
                "scorer": self.rule_scorer,
                "params": self.rule_params,
                "fitted": rule.fitted() if rule is not None else self.no_rule_,
            },
            "reference": self.reference_ids_,
        }
        digest = hashlib.sha256()
        _feed(digest, state)
        return digest.hexdigest()

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
        if self.rule_ is None:
            lines.append(f"rule {self.rule}: review: {self.no_rule_}")
        else:
            lines.append(f"rule {self.rule}: {self.rule_.describe()}")
        return "\n".join(lines)


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
        faults = untrustworthy(episode.findings + gripper_findings(episode))
        if len(episode) < 2:
            refused.append(f"{episode.name} ({episode.id}): it has {len(episode)} steps")
        elif faults:
            refused.append(f"{episode.name} ({episode.id}): {faults[0].id}: {faults[0].message}")
    if refused:
        raise EpisodeError(f"reference refused: {'; '.join(refused)}")


def _feed(digest: Any, value: object) -> None:
    """Feed a value to a hash, with its type, so that no two states look alike.

    Raises:
        TypeError: for a type without a canonical form.
    """
    if isinstance(value, Mapping):
        digest.update(f"map{len(value)}".encode())
        for key in sorted(value):
            _feed(digest, key)
            _feed(digest, value[key])
    elif isinstance(value, (list, tuple)):
        digest.update(f"seq{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    elif isinstance(value, np.ndarray):
        kind = "<f8" if value.dtype.kind == "f" else "<i8"
        digest.update(f"arr{kind}{value.shape}".encode())
        digest.update(value.astype(kind).tobytes())
    elif value is None or isinstance(value, (bool, np.bool_)):
        digest.update(f"lit{value}".encode())
    elif isinstance(value, (int, np.integer)):
        digest.update(f"int{int(value)};".encode())
    elif isinstance(value, (float, np.floating)):
        digest.update(b"flt" + struct.pack("<d", value))
    elif isinstance(value, str):
        text = value.encode()
        digest.update(f"str{len(text)};".encode() + text)
    else:
        raise TypeError(f"no canonical form for {type(value).__name__}")
