"""Cases as rules see them, for their tests."""

from __future__ import annotations

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.rules import Case, Rule


def case(score: float | None, episode: str = "e", why: str = "") -> Case:
    """An episode with one score, of the scorer `s`; or with the reason why there is none."""
    return Case(episode, {"s": score}, {"s": why} if why else {})


def explained(score: float, explanation: str, episode: str = "e") -> Case:
    """An episode with one score, and what the scorer says about it."""
    return Case(episode, {"s": score}, {}, {"s": explanation, "other": "no"})


def verdicts(rule: Rule, scores: dict[str, float | None]) -> dict[str, Verdict]:
    """Episode -> verdict."""
    return {i: rule.verdict(case(x, i))[0] for i, x in scores.items()}


def kept(rule: Rule, scores: dict[str, float | None]) -> set[str]:
    """The episodes that a rule keeps."""
    return {i for i, v in verdicts(rule, scores).items() if v == "keep"}
