"""Decisions: what becomes of an episode, why, from where to where, and on what evidence."""

from __future__ import annotations

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, get_args

import numpy as np
from scipy.special import stdtrit

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.findings import Finding

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode import Episode

Verdict = Literal["keep", "salvage", "review", "discard"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)

#: Author of the decisions that are not a person's.
CURATOR = "curator"

#: Findings of the recording that are noted in the decision and stop nothing; all others need a
#: person, for what was recorded may not be what happened. (A bag that cannot be read: the live
#: episode stands. Lost messages that cannot be counted: a hole that matters is also a `gap`.)
NOTED = ("unknown-loss", "unknown-phase", "no-bag")


def untrustworthy(findings: Iterable[Finding]) -> list[Finding]:
    """Findings that need a person, in their order."""
    return [f for f in findings if f.kind == "recording" and f.id not in NOTED]


@dataclass(frozen=True)
class Decision:
    """One line of `decisions/<uuid>.jsonl`.

    Attributes:
        episode, name: identity of the episode.
        verdict: keep, salvage (keep the span alone), review (a person is to look), or discard.
        reason: one sentence that an operator understands.
        span: nanoseconds from the start stamp, inclusive; the whole episode by default.
        scores: scorer -> score, None where it abstained.
        abstained: scorer -> why.
        findings: faults of the recording.
        evidence: what the verdict rests on, as plain JSON values.
        revision: 1, 2, ... an episode; the log gives the number.
        by: `curator`, or the name of the person.
        state_hash: fitted state that the decision is a function of.
    """

    episode: str
    name: str
    verdict: Verdict
    reason: str
    span: tuple[int, int]
    scores: Mapping[str, float | None] = field(default_factory=dict)
    abstained: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    revision: int = 1
    by: str = CURATOR
    state_hash: str = ""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise EpisodeError(
                f"decision on {self.episode}: verdict {self.verdict!r} is none of "
                f"{', '.join(VERDICTS)}"
            )
        if not 0 <= self.span[0] <= self.span[1]:
            raise EpisodeError(f"decision on {self.episode}: span {self.span} is none")
        for scorer, score in self.scores.items():
            if score is not None and not math.isfinite(score):
                raise EpisodeError(
                    f"decision on {self.episode}: score {scorer!r} is {score}; "
                    "one that abstained is None"
                )

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal decision."""
        return {
            "episode": self.episode,
            "name": self.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "span": list(self.span),
            "scores": dict(self.scores),
            "abstained": dict(self.abstained),
            "findings": [f.to_json() for f in self.findings],
            "evidence": dict(self.evidence),
            "revision": self.revision,
            "by": self.by,
            "state_hash": self.state_hash,
        }

    def to_line(self) -> str:
        """One line of JSON, without its newline."""
        return json.dumps(self.to_json(), allow_nan=False)

    @classmethod
    def from_json(cls, raw: object) -> Decision:
        """Read what `to_json` wrote; keys that it does not know are left alone.

        Raises:
            EpisodeError: if a key is missing or a value makes no sense.
        """
        if not isinstance(raw, Mapping):
            raise EpisodeError(f"decision: expected a mapping, found {raw!r:.80}")
        try:
            scores = {str(k): None if v is None else float(v) for k, v in raw["scores"].items()}
            findings = tuple(
                Finding(str(f["id"]), str(f["message"]), (int(f["span"][0]), int(f["span"][1])))
                for f in raw["findings"]
            )
            first, last = raw["span"]
            return cls(
                episode=str(raw["episode"]),
                name=str(raw["name"]),
                verdict=raw["verdict"],
                reason=str(raw["reason"]),
                span=(int(first), int(last)),
                scores=scores,
                abstained={str(k): str(v) for k, v in raw["abstained"].items()},
                findings=findings,
                evidence=dict(raw["evidence"]),
                revision=int(raw["revision"]),
                by=str(raw["by"]),
                state_hash=str(raw["state_hash"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as err:
            raise EpisodeError(f"decision: {type(err).__name__} {err} in {raw!r:.200}") from err

    @classmethod
    def from_line(cls, line: str) -> Decision:
        """Read what `to_line` wrote.

        Raises:
            EpisodeError: if the line is no JSON, or no decision.
        """
        try:
            raw = json.loads(line)
        except ValueError as err:
            raise EpisodeError(f"decision: no JSON: {err} in {line!r:.80}") from err
        return cls.from_json(raw)


def override(
    previous: Decision,
    verdict: Verdict,
    reason: str,
    *,
    by: str,
    span: tuple[int, int] | None = None,
) -> Decision:
    """A person's decision: the next revision, on the same scores, findings and evidence.

    Raises:
        EpisodeError: if no person is named, or the verdict makes no sense.
    """
    if not by or by == CURATOR:
        raise EpisodeError(f"override of {previous.episode}: by {by!r} is no person")
    return replace(
        previous,
        verdict=verdict,
        reason=reason,
        by=by,
        span=previous.span if span is None else span,
        revision=previous.revision + 1,
    )


def in_force(decisions: Iterable[Decision]) -> dict[str, Decision]:
    """The decision that counts for each episode.

    A person outranks the curator, whatever the curator decides later; among equals the highest
    revision counts, and the later one of equal revisions.

    Args:
        decisions: in the order of their logs.
    """
    found: dict[str, Decision] = {}
    for decision in decisions:
        held = found.get(decision.episode)
        if held is None or _rank(decision) >= _rank(held):
            found[decision.episode] = decision
    return found


def _rank(decision: Decision) -> tuple[bool, int]:
    return decision.by != CURATOR, decision.revision


class Rule(ABC):
    """Turns scores into a verdict; hyper-parameters and `fit` as scorers have them.

    Attributes:
        needs: `reference` where `fit` must see the scores of trusted episodes.
        min_references: how many of them at least.
    """

    needs: Literal["nothing", "reference"] = "nothing"
    min_references: ClassVar[int] = 0

    def __init__(self, *, scorer: str) -> None:
        """Store the name of the scorer that decides."""
        self.scorer = scorer

    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
        """Learn from the deciding scorer's scores of trusted episodes.

        Args:
            reference_scores: one an episode, each by a scorer that had not seen that episode.
            resolution: `Scorer.resolution`: the difference that counts as none.
        """
        return self

    @abstractmethod
    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
    ) -> tuple[Verdict, str]:
        """Decide on one episode.

        Args:
            scores: scorer -> score, None where it abstained.
            abstained: scorer -> why.
            words: scorer -> what is to be seen in the episode, where a scorer can say it.

        Returns:
            The verdict and its reason.
        """

    def params(self) -> dict[str, Any]:
        """Hyper-parameters by name."""
        return {k: v for k, v in vars(self).items() if not k.endswith("_")}

    def fitted(self) -> dict[str, Any]:
        """Learned values by name."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}

    def describe(self) -> str:
        """One line for people."""
        return "review: every episode is for a person to decide"


class NoRule(Rule):
    """Every episode is for a person to decide: scores are shown, nothing is concluded."""

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
    ) -> tuple[Verdict, str]:
        """Review, always."""
        return "review", "no rule: a person decides"


class Threshold(Rule):
    """Keep at or above a threshold of one scorer, discard below, review where it abstained.

    The threshold is given, or fitted on the reference as the lower of two bounds:

    - min - resolution: below every reference score by more than the scorer can tell apart. This
      one decides where references are saturated (a timing of 1.0 throughout) and the spread is 0;
    - median - k * 1.4826 * MAD, with k the one-sided prediction factor of Student's t,
      t(1 - false_alarm, n - 1) * sqrt(1 + 1 / n): it reaches further below the smaller n is.

    Aim: `false_alarm` = 1 % of good demonstrations discarded if scores are normal. Because the
    MAD of few numbers is itself uncertain, simulated rates with normal scores are 5 % at n = 3,
    3 % at 4 to 6, 2 % at 8 to 12 and 1 % from 20 on; with exponential tails about three times
    that. It cannot protect against a defective reference: such an episode lowers the threshold.

    Attributes:
        threshold_: after `fit`; always finite.
        n_: number of references.
        low_, median_: smallest and middle of their scores.
    """

    min_references = 3

    def __init__(
        self, *, scorer: str, threshold: float | None = None, false_alarm: float = 0.01
    ) -> None:
        """Store the parameters.

        Args:
            scorer: name of the scorer that decides.
            threshold: keep at or above; None: fit it.
            false_alarm: share of good demonstrations that a fitted threshold may discard.

        Raises:
            ConfigError: if a number makes no sense.
        """
        super().__init__(scorer=scorer)
        if threshold is not None and not math.isfinite(threshold):
            raise ConfigError(f"rule 'threshold': threshold {threshold} is not finite")
        if not 0 < false_alarm < 0.5:
            raise ConfigError(
                f"rule 'threshold': false_alarm {false_alarm}: expected a number from 0 to 0.5"
            )
        self.threshold = threshold
        self.false_alarm = false_alarm
        self.needs = "reference" if threshold is None else "nothing"

    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
        """Learn the threshold, if none was given.

        Raises:
            EpisodeError: if there are fewer than `min_references`, or a score is not finite.
        """
        if self.threshold is not None:
            return self
        scores = np.asarray(reference_scores, dtype=np.float64)
        n = len(scores)
        if n < self.min_references:
            raise EpisodeError(
                f"a threshold needs {self.min_references} reference episodes, there are {n}"
            )
        if not np.isfinite(scores).all():
            raise EpisodeError("a reference score is not finite")
        median = float(np.median(scores))
        sigma = 1.4826 * float(np.median(np.abs(scores - median)))
        k = float(stdtrit(n - 1, 1.0 - self.false_alarm)) * math.sqrt(1.0 + 1.0 / n)
        self.low_, self.median_, self.n_ = float(scores.min()), median, n
        self.threshold_ = min(self.low_ - resolution, median - k * sigma)
        return self

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
    ) -> tuple[Verdict, str]:
        """Compare the score with the threshold."""
        score = scores.get(self.scorer)
        if score is None:
            why = abstained.get(self.scorer, "it was not asked")
            return "review", f"{self.scorer} cannot tell: {why}"
        if self.threshold is not None:
            threshold, origin = self.threshold, "as configured"
        elif hasattr(self, "threshold_"):
            threshold, origin = self.threshold_, f"fitted on {self.n_} references"
        else:
            raise NotFittedError("rule 'threshold' has no threshold: give one, or fit it")
        keep = score >= threshold
        if not keep and self.scorer in words:
            return "discard", words[self.scorer]
        shown, limit = _told_apart(score, threshold)
        relation = "at or above" if keep else "below"
        text = f"{self.scorer} {shown} {relation} {limit}, {origin}"
        return ("keep" if keep else "discard"), text

    def describe(self) -> str:
        """The threshold and where it comes from."""
        if self.threshold is not None:
            return f"keep where {self.scorer} >= {self.threshold:.6g} (as configured)"
        if not hasattr(self, "threshold_"):
            return f"review: no threshold for {self.scorer}"
        return (
            f"keep where {self.scorer} >= {self.threshold_:.6g} (fitted on {self.n_} references, "
            f"lowest {self.low_:.6g}, median {self.median_:.6g})"
        )


def _told_apart(a: float, b: float) -> tuple[str, str]:
    """Two numbers with two decimals, or as many as it takes to tell them apart."""
    for digits in range(2, 17):
        first, second = f"{a:.{digits}f}", f"{b:.{digits}f}"
        if first != second or a == b:
            return first, second
    return repr(a), repr(b)


#: Name -> class. The only list of rules.
RULES: dict[str, type[Rule]] = {"threshold": Threshold, "none": NoRule}


def decide(
    episode: Episode,
    scores: Mapping[str, float | None],
    rule: Rule | None,
    *,
    abstained: Mapping[str, str] | None = None,
    words: Mapping[str, str] | None = None,
    evidence: Mapping[str, Any] | None = None,
    no_rule: str = "no reference",
    revision: int = 1,
    by: str = CURATOR,
    state_hash: str = "",
) -> Decision:
    """Decide on one episode: a pure function of what is given.

    A recording that cannot be trusted is for review whatever its scores, with its finding as the
    reason; then the rule judges.

    Args:
        episode: the episode, whole.
        scores: scorer -> score, None where it abstained.
        rule: the fitted rule; None where it could not be fitted.
        abstained: scorer -> why.
        words: scorer -> what is to be seen in the episode.
        evidence: plain JSON values to keep with the decision.
        no_rule: why `rule` is None: the reason of the review.
        revision: number of the decision.
        by: author.
        state_hash: fitted state that the scores and the rule come from.
    """
    abstained = dict(abstained or {})
    faults = untrustworthy(episode.findings)
    verdict: Verdict
    if faults:
        more = f" (and {len(faults) - 1} more findings)" if len(faults) > 1 else ""
        verdict, reason = "review", f"{faults[0].id}: {faults[0].message}{more}"
    elif rule is None:
        verdict, reason = "review", no_rule
    else:
        verdict, reason = rule.judge(scores, abstained, words or {})
    return Decision(
        episode=episode.id,
        name=episode.name,
        verdict=verdict,
        reason=reason,
        span=(0, max(0, episode.end_ns - episode.start_ns)),
        scores=dict(scores),
        abstained=abstained,
        findings=episode.findings,
        evidence=dict(evidence or {}),
        revision=revision,
        by=by,
        state_hash=state_hash,
    )
