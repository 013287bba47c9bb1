"""From what was seen in an episode, and a fitted rule, to a decision."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from curation_ros.core.decision.decision import CURATOR, Decision, Verdict, untrustworthy
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.rules import Case, Rule
from curation_ros.core.types import NS_PER_S, Span


@dataclass(frozen=True)
class Ruling:
    """A fitted rule, and what it has seen.

    Attributes:
        rule: None where it could not be fitted.
        no_rule: why not.
        basis: `provisional` where the dataset that it was fitted on may still grow.
        fitted_on: what it has seen: `what` (nothing, reference, dataset), number of `episodes`,
            and a `hash` over their ids and scores.
        state_hash: of scorers and rule with all that they have learned.
    """

    rule: Rule | None
    no_rule: str
    basis: Literal["final", "provisional"]
    fitted_on: Mapping[str, Any] = field(default_factory=dict)
    state_hash: str = ""


def decide(
    seen: Examination,
    rule: Rule | None,
    *,
    evidence: Mapping[str, Any] | None = None,
    no_rule: str = "no reference",
    revision: int = 1,
    by: str = CURATOR,
    state_hash: str = "",
) -> Decision:
    """Decide on one episode: a pure function of what is given.

    A recording that cannot be trusted is for review whatever its scores, with its finding as the
    reason; unless it is bad at an end only, and the rule keeps the rest: that is salvaged.
    Then the rule judges; what it would keep although the task was seen to fail is for a person.
    Of what it would salvage the beginning is kept, up to a margin before it broke; where that is
    not known, or nothing is left, it is discarded. Odd motion is noted and decides nothing.

    Args:
        seen: the episode, examined.
        rule: the fitted rule; None where it could not be fitted.
        evidence: plain JSON values to keep with the decision, beside those of `seen`.
        no_rule: why `rule` is None: the reason of the review.
        revision: number of the decision.
        by: author.
        state_hash: fitted state that the scores and the rule come from.
    """
    faults = untrustworthy(seen.findings)
    span = seen.span
    facts: dict[str, Any] = {}
    verdict: Verdict
    if faults:
        more = f" (and {len(faults) - 1} more findings)" if len(faults) > 1 else ""
        verdict, reason = "review", f"{faults[0].id}: {faults[0].message}{more}"
        part = seen.part
        if part is not None and rule is not None:
            judged, text = rule.verdict(
                Case(seen.episode, part.scores, part.abstained, part.words)
            )
            if judged == "keep":
                verdict, span, reason = "salvage", part.span, f"{text}; without {part.without}"
    elif rule is None:
        verdict, reason = "review", no_rule
    else:
        verdict, reason = rule.verdict(Case(seen.episode, seen.scores, seen.abstained, seen.words))
        decided_by = rule.decider(seen.scores)
        facts["decided_by"] = decided_by
        if verdict == "salvage":
            verdict, span, more = _salvaged(seen, decided_by)
            reason += more
            if verdict == "salvage":
                broke = seen.breaks[decided_by]
                facts["salvage"] = {
                    "scorer": decided_by,
                    "broke_ns": broke.at_ns,
                    "margin_s": broke.margin_s,
                }
        failed = [f for f in seen.findings if f.kind == "task"]
        if verdict == "keep" and failed:
            verdict, reason = "review", f"{failed[0].id}: {failed[0].message}; but {reason}"
    return Decision(
        episode=seen.episode,
        name=seen.name,
        verdict=verdict,
        reason=reason,
        span=span,
        scores=dict(seen.scores),
        abstained=dict(seen.abstained),
        findings=seen.findings,
        evidence={**seen.evidence, **(evidence or {}), **facts},
        revision=revision,
        by=by,
        state_hash=state_hash,
    )


def _salvaged(seen: Examination, scorer: str) -> tuple[Verdict, Span, str]:
    """Verdict, span and the end of the reason for an episode that a scorer saw break."""
    broke = seen.breaks.get(scorer)
    if broke is None:
        return "discard", seen.span, ""
    if broke.span is None:
        return "discard", seen.span, "; too little was good before that"
    return "salvage", broke.span, f"; kept until {broke.span[1] / NS_PER_S:.2f} s"
