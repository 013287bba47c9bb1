"""From an examination and a fitted rule to a decision."""

from __future__ import annotations

from typing import Any

from curation_ros.core.decision.decision import Decision, Verdict, untrustworthy
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.fitted_rule import FittedRule
from curation_ros.core.decision.rules import Rule
from curation_ros.core.types import NS_PER_S, Span


def decide(examination: Examination, fitted_rule: FittedRule) -> Decision:
    """Decide on one episode: a pure function of what is given.

    1. A recording that cannot be trusted is for review whatever its scores, with its finding as
       the reason. If it is bad at an end only, and the rule keeps the rest, that is salvaged.
    2. Without a fitted rule it is for review.
    3. The rule gives a verdict. If it keeps an episode that shows a failed task, a person is
       asked. If it salvages, the beginning is kept, up to a margin before the episode broke.
       Where that is not known, or nothing is left, the episode is discarded.

    Unusual motion is noted and never changes the verdict.

    Args:
        examination: of the episode.
        fitted_rule: fitted with the scorers that examined it.
    """
    rule, scores = fitted_rule.rule, examination.scores
    facts: dict[str, Any] = {
        "basis": fitted_rule.basis,
        "fitted_on": dict(fitted_rule.fitted_on),
        "scoring": fitted_rule.scoring_hash,
        "content": examination.content,
    }
    if rule is not None and rule.cut is not None and rule.decider(scores) == rule.scorer:
        facts["threshold"] = float(rule.cut)
    if untrustworthy(examination.findings):
        verdict, reason, span = _on_a_faulty_recording(examination, rule)
    elif rule is None:
        verdict, reason, span = "review", fitted_rule.no_rule, examination.span
    else:
        verdict, reason, span, more = _by_rule(examination, rule)
        facts |= more
    return Decision(
        episode=examination.episode,
        name=examination.name,
        verdict=verdict,
        reason=reason,
        span=span,
        scores=dict(scores),
        abstained=dict(examination.abstained),
        findings=examination.findings,
        evidence={**examination.evidence, **facts},
        state_hash=fitted_rule.state_hash,
    )


def _on_a_faulty_recording(
    examination: Examination, rule: Rule | None
) -> tuple[Verdict, str, Span]:
    """Review; or salvage of the sound part, if the rule keeps it."""
    faults = untrustworthy(examination.findings)
    part = examination.part
    if part is not None and rule is not None:
        verdict, text = rule.verdict(part.case(examination.episode))
        if verdict == "keep":
            return "salvage", f"{text}; without {part.without}", part.span
    more = f" (and {len(faults) - 1} more findings)" if len(faults) > 1 else ""
    return "review", f"{faults[0].id}: {faults[0].message}{more}", examination.span


def _by_rule(examination: Examination, rule: Rule) -> tuple[Verdict, str, Span, dict[str, Any]]:
    """Verdict, reason, span and evidence, where the recording can be trusted."""
    verdict, reason = rule.verdict(examination.case)
    decider = rule.decider(examination.scores)
    facts: dict[str, Any] = {"decided_by": decider}
    if verdict == "salvage":
        broke = examination.breaks.get(decider)
        if broke is None:
            return "discard", reason, examination.span, facts
        if broke.span is None:
            reason += "; too little was good before that"
            return "discard", reason, examination.span, facts
        facts["salvage"] = {
            "scorer": decider,
            "broke_ns": broke.at_ns,
            "margin_s": broke.margin_s,
        }
        return verdict, f"{reason}; kept until {broke.span[1] / NS_PER_S:.2f} s", broke.span, facts
    failed = [f for f in examination.findings if f.kind == "task"]
    if verdict == "keep" and failed:
        verdict, reason = "review", f"{failed[0].id}: {failed[0].message}; but {reason}"
    return verdict, reason, examination.span, facts
