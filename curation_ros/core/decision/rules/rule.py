"""What a rule is: scikit-learn's contract, from what is known of an episode to a verdict."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from curation_ros.core.decision.decision import Decision, Verdict
from curation_ros.core.decision.ties import TieKey
from curation_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from typing_extensions import Self

#: What a rule is fitted on before it can decide.
RuleNeed = Literal["nothing", "reference", "dataset"]


@dataclass(frozen=True)
class Case:
    """What a rule decides on: one episode, and what is known of it.

    Attributes:
        episode: its id. A rule that keeps a number of episodes draws lots by it at the cut.
        scores: scorer -> score, None where it abstained.
        abstained: scorer -> why.
        explanations: scorer -> one sentence for the operator, where it has one.
        decision: the decision in force, where one was made before.
    """

    episode: str
    scores: Mapping[str, float | None]
    abstained: Mapping[str, str] = field(default_factory=dict)
    explanations: Mapping[str, str] = field(default_factory=dict)
    decision: Decision | None = None


class Rule(ABC):
    """Gives a verdict on an episode; `curation score` and `curation select` share all rules.

    Hyper-parameters are keyword-only, stored unchanged, and checked by `check_params`. What `fit`
    and `fit_dataset` learn ends in `_`.

    Attributes:
        name: as the command line and the configuration have it.
        summary: what it keeps, for `--help`.
        decides: whether `curation score` can use it.
        selects: whether `curation select` can use it.
        instead: what to use where it cannot be used.
        reads_scores: whether its verdict depends on scores.
        value_param: the hyper-parameter that `--value` sets; empty where it takes no value.
        min_references: how many trusted episodes it needs at least.
        min_episodes: how many scored episodes of the dataset it needs at least.
        consults: scorers that it asks before the one that it is given.
    """

    name: ClassVar[str]
    summary: ClassVar[str]
    decides: ClassVar[bool] = True
    selects: ClassVar[bool] = True
    instead: ClassVar[str] = ""
    reads_scores: ClassVar[bool] = True
    value_param: ClassVar[str] = ""
    min_references: ClassVar[int] = 0
    min_episodes: ClassVar[int] = 0
    consults: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *, scorer: str) -> None:
        """Store the name of the scorer that decides."""
        self.scorer = scorer

    @property
    def needs(self) -> RuleNeed:
        """What it is fitted on.

        Nothing, the scores of trusted episodes (`fit`), or the scores of the dataset that is
        decided on (`fit_dataset`).
        """
        return "nothing"

    def check_params(self) -> None:
        """Check the hyper-parameters; not done on construction, as scikit-learn has it.

        Raises:
            ConfigError: naming the rule, the parameter, what was found and what was expected.
        """
        if not isinstance(self.scorer, str):
            raise self._refuse("scorer", "the name of a scorer")

    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
        """Learn from the deciding scorer's scores of trusted episodes.

        Args:
            reference_scores: one per episode, each by a scorer fitted without that episode.
            resolution: difference in score that counts as none (`Scorer.resolution`).

        Raises:
            EpisodeError: if there are fewer than `min_references`, or a score is not finite.
        """
        return self

    def fit_consulted(self, reference_scores: Mapping[str, Sequence[float]]) -> Self:
        """Learn from the consulted scorers' scores of the reference; called before `fit`.

        Args:
            reference_scores: scorer -> scores of the trusted episodes, without those on which it
                abstained.
        """
        return self

    def without_reference(self, why: str) -> Self | None:
        """The rule where it needs a reference and has none.

        Args:
            why: what is missing.

        Returns:
            None if it cannot decide without one.
        """
        return None

    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        """Learn from the deciding scorer's scores of the dataset that is decided on.

        Args:
            scores: episode id -> score, without the episodes on which it abstained.
            resolution: as in `fit`.
            tie: episode id -> key that orders equal scores; by default a hash of the id.

        Raises:
            EpisodeError: if there are fewer than `min_episodes`.
        """
        return self

    @abstractmethod
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        """The verdict on one episode, and its reason.

        `salvage` means that the episode broke, and that its good beginning is worth keeping where
        there is one.

        Raises:
            NotFittedError: before the rule was fitted, where it needs that.
        """

    def decider(self, scores: Mapping[str, float | None]) -> str:
        """The scorer that decides on an episode with these scores."""
        return self.scorer

    def params(self) -> dict[str, Any]:
        """Hyper-parameters by name, as they were given."""
        return {name: getattr(self, name) for name in parameter_names(type(self))}

    def fitted(self) -> dict[str, Any]:
        """Learned values by name; empty before the rule was fitted."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}

    @property
    def cut(self) -> float | None:
        """The score at or above which it keeps, where it has one."""
        return None

    @property
    def no_basis(self) -> str:
        """Why it cannot decide on any episode of the dataset it was fitted on; empty if it can."""
        return ""

    def describe(self) -> str:
        """One line for people."""
        return self.summary

    def _score(self, case: Case) -> float | str:
        """The deciding score, or why there is none."""
        score = case.scores.get(self.scorer)
        if score is None:
            why = case.abstained.get(self.scorer, "it was not asked")
            return f"{self.scorer} cannot tell: {why}"
        return score

    def _refuse(self, parameter: str, expected: str) -> ConfigError:
        """The error for a hyper-parameter that makes no sense."""
        value = getattr(self, parameter)
        return ConfigError(f"rule {self.name!r}: {parameter} is {value!r}, expected {expected}")


def parameter_names(rule: type[Rule]) -> list[str]:
    """Names of the hyper-parameters of a rule, `scorer` among them."""
    parameters = inspect.signature(rule.__init__).parameters.values()
    return [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]


def is_number(value: object) -> bool:
    """Whether a hyper-parameter is a number: true and false are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def told_apart(a: float, b: float) -> tuple[str, str]:
    """Two numbers with two decimals, or as many as it takes to tell them apart."""
    for digits in range(2, 17):
        first, second = f"{a:.{digits}f}", f"{b:.{digits}f}"
        if first != second or a == b:
            return first, second
    return repr(a), repr(b)
