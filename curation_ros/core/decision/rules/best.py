"""Rules `top-fraction` and `top-k`: the best of a dataset, however good they are."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from typing_extensions import override

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.rules.rule import Case, Rule, RuleNeed, is_number, told_apart
from curation_ros.core.decision.ties import TieKey, ranking, unique
from curation_ros.core.errors import EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self


class _Best(Rule):
    """Keeps a number of episodes, the best of the dataset, and discards the rest.

    Of equal scores at the cut some are kept by lot, that is by their tie keys, so that the number
    comes out. Their reasons name the lot.

    Attributes:
        cut_: lowest score that is kept; infinite if nothing is kept.
        by_lot_: sorted ids of the kept episodes that share it with others that are not kept.
        n_kept_, n_: how many episodes are kept, of how many.
        n_tied_: episodes with a score equal to the cut.
    """

    value_param = "value"
    min_episodes = 1
    value: float
    #: What `value` must be, for messages.
    _expected: ClassVar[str]

    @property
    @override
    def needs(self) -> RuleNeed:
        return "dataset"

    @abstractmethod
    def count(self, n: int) -> int:
        """How many of n scored episodes are kept."""

    @abstractmethod
    def _is_valid(self) -> bool:
        """Whether `value`, which is a number, makes sense."""

    @override
    def check_params(self) -> None:
        super().check_params()
        if not (is_number(self.value) and self._is_valid()):
            raise self._refuse("value", self._expected)

    @override
    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        self.check_params()
        if not scores:
            raise EpisodeError("no episode has a score")
        order = ranking(scores, unique(tie))
        kept = order[: self.count(len(order))]
        self.n_, self.n_kept_ = len(order), len(kept)
        self.cut_ = scores[kept[-1]] if kept else math.inf
        tied = [i for i in order if scores[i] == self.cut_]
        self.n_tied_ = len(tied)
        held = sorted(set(tied) & set(kept))
        self.by_lot_ = tuple(held) if len(held) < len(tied) else ()
        return self

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        score = self._score(case)
        if isinstance(score, str):
            return "review", score
        if not hasattr(self, "cut_"):
            raise NotFittedError(
                f"rule {self.name!r} was not fitted on a dataset: call fit_dataset first"
            )
        by_lot = score == self.cut_ and bool(self.by_lot_)
        keep = case.episode in self.by_lot_ if by_lot else score >= self.cut_
        shown, limit = told_apart(score, self.cut_)
        place = f"among the best {self.n_kept_} of {self.n_}"
        if by_lot:
            text = (
                f"{self.scorer} {shown} is the cut of the best {self.n_kept_} of {self.n_}, which "
                f"{self.n_tied_} episodes share: {'kept' if keep else 'left out'} by lot"
            )
        elif keep:
            text = f"{self.scorer} {shown} is {place}"
        else:
            text = f"{self.scorer} {shown} is not {place} (cut {limit})"
            explanation = case.explanations.get(self.scorer)
            text = f"{explanation}; {text}" if explanation is not None else text
        return ("keep" if keep else "discard"), text

    @property
    @override
    def cut(self) -> float | None:
        fitted: float = getattr(self, "cut_", math.inf)
        return fitted if math.isfinite(fitted) else None


class TopFraction(_Best):
    """Keep the best share of the dataset (the paper's: 0.75), whatever their scores are.

    It keeps bad episodes where more than that share is bad, and discards good ones where less is.
    Their number is rounded to the nearest, and half up: the best half of 3 are 2.
    """

    name = "top-fraction"
    summary = "keep the best share of the scored episodes, value above 0 up to 1 (0.75)"
    _expected = "a share above 0, up to 1"

    def __init__(self, *, scorer: str, value: float = 0.75) -> None:
        """Store the share."""
        super().__init__(scorer=scorer)
        self.value = value

    @override
    def count(self, n: int) -> int:
        return math.floor(float(self.value) * n + 0.5)

    @override
    def _is_valid(self) -> bool:
        return 0 < self.value <= 1

    @override
    def describe(self) -> str:
        return f"keep the best {self.value:.0%} of the dataset by {self.scorer}"


class TopK(_Best):
    """Keep the best K of the dataset, or all of them where there are fewer."""

    name = "top-k"
    summary = "keep the best K of the scored episodes, value K (60); all where there are fewer"
    _expected = "a whole number from 1"

    def __init__(self, *, scorer: str, value: float = 60) -> None:
        """Store the number."""
        super().__init__(scorer=scorer)
        self.value = value

    @override
    def count(self, n: int) -> int:
        return min(int(self.value), n)

    @override
    def _is_valid(self) -> bool:
        return self.value >= 1 and float(self.value).is_integer()

    @override
    def describe(self) -> str:
        return f"keep the best {self.value:.0f} of the dataset by {self.scorer}"
