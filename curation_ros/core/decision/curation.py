"""A curation: fitted scorers and a fitted rule, as one object that live and batch code carry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from curation_ros.core.decision.deciding import decide
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.examination import Examination
from curation_ros.core.decision.examining import examine
from curation_ros.core.decision.fitted_rule import FittedRule, fit_rule, fit_rule_over
from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.decision.ties import TieKey

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


@dataclass(frozen=True)
class Curation:
    """What examines episodes and decides on them; it never changes.

    Attributes:
        scorers: fitted.
        rule: fitted as far as it can be without a look at the dataset.
    """

    scorers: FittedScorers
    rule: FittedRule

    @classmethod
    def fit(
        cls, settings: CurationSettings | None = None, reference: Iterable[Episode] = ()
    ) -> Curation:
        """Learn from trusted episodes.

        Args:
            settings: by default those of `CurationSettings`.
            reference: may be empty. Then scorers that need one abstain, and a rule that needs one
                leaves every episode for review.

        Raises:
            EpisodeError: naming each reference episode that cannot be trusted, or that the
                deciding scorer cannot score, and why.
        """
        episodes = list(reference)
        scorers = fit_scorers(settings or CurationSettings(), episodes)
        return cls(scorers, fit_rule(scorers, episodes))

    @property
    def settings(self) -> CurationSettings:
        """What it was configured with."""
        return self.scorers.settings

    @property
    def rule_needs_dataset(self) -> bool:
        """Whether a decision depends on the scores of the other episodes."""
        return self.settings.make_rule().needs == "dataset"

    def fit_dataset(self, episodes: Iterable[Episode]) -> Curation:
        """The same curation, with scorers fitted on the dataset (`FittedScorers.fit_dataset`)."""
        scorers = self.scorers.fit_dataset(episodes)
        return Curation(scorers, self.rule.with_scorers(scorers))

    def examine(self, episode: Episode) -> Examination:
        """Score one episode and check it."""
        return examine(self.scorers, episode)

    def rule_over(
        self,
        scores: Mapping[str, float | None],
        *,
        final: bool,
        tie: TieKey | None = None,
    ) -> FittedRule:
        """The rule, fitted on scores of the dataset if it needs that (`fit_rule_over`)."""
        if not self.rule_needs_dataset:
            return self.rule
        return fit_rule_over(self.scorers, scores, final=final, tie=tie)

    def decide(self, examination: Examination, rule: FittedRule | None = None) -> Decision:
        """Decide on an episode that this curation examined.

        Args:
            examination: of the episode.
            rule: as `rule_over` gives it; None: without a look at the dataset.
        """
        return decide(examination, self.rule if rule is None else rule)

    def describe(self) -> str:
        """For people: what scores, what each scorer needs, and what decides."""
        rule = self.rule.rule
        if rule is None and self.rule_needs_dataset:
            rule = self.settings.make_rule()
        text = rule.describe() if rule is not None else f"review: {self.rule.no_rule}"
        return "\n".join([*self.scorers.describe(), f"rule {self.settings.rule}: {text}"])
