"""The rules that read no scores: `none`, `all` and `decisions`."""

from __future__ import annotations

from typing_extensions import override

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.rules.rule import Case, Rule


class NoRule(Rule):
    """Every episode is for a person to decide: scores are shown, nothing is concluded."""

    name = "none"
    summary = "leave every episode to a person"
    selects = False
    instead = "it selects nothing: choose another rule"
    reads_scores = False

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        return "review", "no rule: a person decides"

    @override
    def describe(self) -> str:
        return "review: every episode is for a person to decide"


class AllEpisodes(Rule):
    """Every episode is selected, whatever was decided about it."""

    name = "all"
    summary = "keep every episode, also what was discarded"
    decides = False
    instead = "it decides nothing: it is for curation select"
    reads_scores = False

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        return "keep", "every episode is kept"


class LoggedDecisions(Rule):
    """What was decided is selected: the kept episodes whole, the salvaged ones by their spans.

    A person's decision outranks the curator's.
    """

    name = "decisions"
    summary = "keep what was decided to be kept, and the salvaged spans"
    decides = False
    instead = "it reads decisions that were made before: it is for curation select"
    reads_scores = False

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        if case.decision is None:
            return "review", "not decided"
        return case.decision.verdict, case.decision.reason
