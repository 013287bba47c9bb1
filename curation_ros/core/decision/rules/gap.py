"""Rule `gap`: the upper of two clearly separated groups of scores."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from typing_extensions import override

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.groups import METHODS, MIN_SCORES, split_scores
from curation_ros.core.decision.rules.rule import Case, Rule, RuleNeed, told_apart
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.errors import EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self


class Gap(Rule):
    """Keep the upper of two clearly separated groups of scores, discard the lower.

    If the scores do not separate, or an episode lies between the groups, a person is asked: it
    never falls back to a fixed share. It assumes that the upper group is the good one. That is
    wrong for a scorer that follows the majority, and no rule can detect it.

    Attributes:
        cut_: where the groups part; None where there is one group.
        doubt_: scores between these two are in doubt.
        n_upper_, n_: episodes in the upper group, and in all.
        why_: what was found.
    """

    name = "gap"
    summary = "keep the upper of two clearly separated groups of scores; no value, but a method"
    min_episodes = MIN_SCORES

    def __init__(self, *, scorer: str, method: str = "mixture") -> None:
        """Store the method, one of `groups.METHODS`."""
        super().__init__(scorer=scorer)
        self.method = method

    @property
    @override
    def needs(self) -> RuleNeed:
        return "dataset"

    @override
    def check_params(self) -> None:
        super().check_params()
        if not isinstance(self.method, str) or self.method not in METHODS:
            raise self._refuse("method", f"one of {', '.join(METHODS)}")

    @override
    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        self.check_params()
        if len(scores) < self.min_episodes:
            raise EpisodeError(
                f"the rule needs {self.min_episodes} scored episodes; there are {len(scores)}"
            )
        split = split_scores(list(scores.values()), resolution=resolution, method=self.method)
        self.cut_, self.doubt_, self.why_ = split.cut, split.doubt, split.why
        self.n_, self.n_upper_ = len(scores), split.n_upper
        return self

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        score = self._score(case)
        if isinstance(score, str):
            return "review", score
        if not hasattr(self, "cut_"):
            raise NotFittedError("rule 'gap' was not fitted on a dataset: call fit_dataset first")
        if self.cut_ is None:
            return "review", self.no_basis
        shown, limit = told_apart(score, self.cut_)
        if self.doubt_[0] < score < self.doubt_[1]:
            return "review", f"{self.scorer} {shown} lies between the two groups (cut {limit})"
        keep = score > self.cut_
        size = self.n_upper_ if keep else self.n_ - self.n_upper_
        group = f"the {'upper' if keep else 'lower'} group, {size} of {self.n_}, cut {limit}"
        text = f"{self.scorer} {shown} is in {group}"
        if not keep and self.scorer in case.explanations:
            text = f"{case.explanations[self.scorer]}; {text}"
        return ("keep" if keep else "discard"), text

    @property
    @override
    def cut(self) -> float | None:
        fitted: float | None = getattr(self, "cut_", None)
        return fitted

    @property
    @override
    def no_basis(self) -> str:
        if self.cut is not None or not hasattr(self, "cut_"):
            return ""
        return f"{self.scorer}: no two groups among {self.n_} episodes: {self.why_}"

    @override
    def describe(self) -> str:
        found = f": {self.why_}" if hasattr(self, "why_") else ""
        return f"keep the upper group by {self.scorer} ({self.method}{found})"
