"""What a scorer is: the contract of scikit-learn's estimators, for episodes."""

from __future__ import annotations

import inspect
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode

#: What orients a score. `dataset` is the unlabelled dataset, which only shows what is usual.
Need = Literal["nothing", "reference", "dataset", "object pose", "rollouts", "labels"]


class Abstain(EpisodeError):  # noqa: N818 - an answer rather than an error
    """A scorer cannot score this episode; the message is the short reason."""


@dataclass(frozen=True)
class Look:
    """What one scorer finds in one episode.

    Attributes:
        score: higher is better; finite.
        steps: first and last step that the score rests on; None where it rests on all alike.
        explanation: one sentence for the operator; None where there is nothing to point out.
        broke_at: step at which something went wrong that had been right until then, for a known
            cause. The steps before it are a good demonstration of the beginning of the task.
            None where nothing broke, or the cause may lie further back. Only asked of scorers
            that see the whole episode.
    """

    score: float
    steps: tuple[int, int] | None = None
    explanation: str | None = None
    broke_at: int | None = None


class Scorer(ABC):
    """Scores one episode; **higher is better**, for every scorer.

    Hyper-parameters are keyword-only and stored unchanged. What `fit` learns ends in `_`, and a
    second `fit` forgets the first. A look depends on the episode and the fitted state alone, and
    changes neither. Labels have no way in: no method has an argument for them.

    Attributes:
        needs: what orients the score. An instance may differ from its class (`ensemble`).
        length_controlled: whether the episode is length-controlled before a look. False for the
            baseline of length. False also for scorers of certain phases: they need all of these
            phases, and later steps do not change them.
        resolution: scores that differ by less count as equal. It is also the margin of a
            threshold that was fitted on references with equal scores.
        version: raised with each change of the definition, so that old and new scores are never
            mixed.
        choices: hyper-parameter -> its allowed values, for those that take one of a few words.
    """

    needs: Need = "nothing"
    length_controlled: ClassVar[bool] = True
    resolution: float = 0.0
    version: ClassVar[int] = 1
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn from trusted reference episodes. A scorer that needs nothing learns nothing.

        Args:
            episodes: the reference, length-controlled like the episodes to score. Their order may
                change the last bits of what is learned, so callers sort them.

        Raises:
            EpisodeError: if there are too few, or one of them cannot be used.
        """
        return self

    @abstractmethod
    def look(self, episode: Episode) -> Look:
        """Score one episode, and say where and why.

        Raises:
            Abstain: if the episode cannot be scored, with the reason.
            NotFittedError: if the scorer needs a reference and was not fitted.
        """

    @final
    def score(self, episode: Episode) -> float:
        """The score alone.

        Raises:
            Abstain: as `look` does.
            NotFittedError: as `look` does.
        """
        return self.look(episode).score

    def check_params(self) -> None:
        """Check the hyper-parameters. As in scikit-learn, construction does not check them.

        Raises:
            ConfigError: naming the parameter, what was found and what was expected.
        """
        for name, values in self.choices.items():
            if getattr(self, name) not in values:
                raise ConfigError(
                    f"{type(self).__name__}: {name} is {getattr(self, name)!r}, "
                    f"expected one of {', '.join(values)}"
                )

    def params(self) -> dict[str, Any]:
        """Hyper-parameters by name, as given."""
        parameters = inspect.signature(type(self).__init__).parameters.values()
        names = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
        return {name: getattr(self, name) for name in names}

    def fitted(self) -> dict[str, Any]:
        """Learned values by name; empty before `fit`."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}

    def _check_fitted(self) -> None:
        if not self.fitted():
            raise NotFittedError(
                f"{type(self).__name__} needs a reference: fit it on trusted episodes first"
            )
