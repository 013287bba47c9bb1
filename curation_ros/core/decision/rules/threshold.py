"""Rule `threshold`: a score at or above a number, given or fitted on a reference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import stdtrit
from typing_extensions import override

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.rules.rule import Case, Rule, RuleNeed, is_number, told_apart
from curation_ros.core.errors import EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self


class Threshold(Rule):
    """Keep at or above a threshold of one scorer, discard below, review where it abstained.

    The threshold is given, or fitted on the reference as the lower of two bounds:

    - min - resolution: below every reference score by more than the scorer can tell apart. This
      one decides where references are saturated (a timing of 1.0 throughout) and the spread is 0;
    - median - k * 1.4826 * MAD, with k the one-sided prediction factor of Student's t,
      t(1 - false_alarm, n - 1) * sqrt(1 + 1 / n): it reaches further below the smaller n is.

    The aim is that `false_alarm` = 1 % of good demonstrations are discarded if scores are normal.
    The MAD of few numbers is itself uncertain. Simulated rates with normal scores are 5 % at
    n = 3, 3 % at 4 to 6, 2 % at 8 to 12 and 1 % from 20 on. With exponential tails they are about
    three times that. Nothing protects against a defective reference: such an episode lowers the
    threshold.

    Attributes:
        threshold_: after `fit`; always finite.
        n_: number of references.
        low_, median_: smallest and middle of their scores.
    """

    name = "threshold"
    summary = "keep scores at or above the value; without one it is fitted on the reference"
    value_param = "threshold"
    instead = (
        "without a value it is fitted on a reference: give --value, or run curation score DATASET "
        "--write --rule threshold --reference PATH, then curation select --rule decisions"
    )
    min_references = 3

    def __init__(
        self, *, scorer: str, threshold: float | None = None, false_alarm: float = 0.01
    ) -> None:
        """Store the parameters.

        Args:
            scorer: name of the scorer that decides.
            threshold: keep at or above; None: fit it.
            false_alarm: share of good demonstrations that a fitted threshold may discard, above 0
                and below 0.5.
        """
        super().__init__(scorer=scorer)
        self.threshold = threshold
        self.false_alarm = false_alarm

    @property
    @override
    def needs(self) -> RuleNeed:
        return "reference" if self.threshold is None else "nothing"

    @override
    def check_params(self) -> None:
        super().check_params()
        given = self.threshold
        if given is not None and not (is_number(given) and math.isfinite(given)):
            raise self._refuse("threshold", "a finite number")
        if not (is_number(self.false_alarm) and 0 < self.false_alarm < 0.5):
            raise self._refuse("false_alarm", "a number above 0 and below 0.5")

    @override
    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
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

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        score = self._score(case)
        if isinstance(score, str):
            return "review", score
        threshold = self.cut
        if threshold is None:
            raise NotFittedError("rule 'threshold' has no threshold: give one, or fit it")
        given = self.threshold is not None
        origin = "as configured" if given else f"fitted on {self.n_} references"
        keep = score >= threshold
        if not keep and self.scorer in case.explanations:
            return "discard", case.explanations[self.scorer]
        shown, limit = told_apart(score, threshold)
        relation = "at or above" if keep else "below"
        text = f"{self.scorer} {shown} {relation} {limit}, {origin}"
        return ("keep" if keep else "discard"), text

    @property
    @override
    def cut(self) -> float | None:
        if self.threshold is not None:
            return self.threshold
        fitted: float | None = getattr(self, "threshold_", None)
        return fitted

    @override
    def describe(self) -> str:
        if self.threshold is not None:
            return f"keep where {self.scorer} >= {self.threshold:.6g} (as configured)"
        if not hasattr(self, "threshold_"):
            return f"review: no threshold for {self.scorer}"
        return (
            f"keep where {self.scorer} >= {self.threshold_:.6g} (fitted on {self.n_} references, "
            f"lowest {self.low_:.6g}, median {self.median_:.6g})"
        )
