"""Scorers, length control and baseline, fitted on a trusted reference and on a dataset."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

from curation_ros.core.decision.decision import untrustworthy
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.decision.state_hash import state_hash
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode
from curation_ros.core.evidence.gripper import gripper_findings
from curation_ros.core.evidence.length_control import LengthControl
from curation_ros.core.scorers import SCORERS, Look, PoolScorer, Scorer
from curation_ros.core.scorers.registry import contained

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

NO_REFERENCE = "no reference"
NO_DATASET = "it compares with the whole dataset, which was not given"
#: Refused references that are named. A mistake in a topic map affects all of them.
_SHOWN = 3
#: Raised when the meaning of the scoring hash, or what an examination finds, changes.
_STATE_VERSION = 5


@dataclass(frozen=True)
class Looks:
    """What all scorers found in one episode.

    Attributes:
        found: scorer -> its look.
        abstained: scorer -> why it has none.
        views: scorer -> the episode as it saw it, for those that have a look.
        names: all scorers, in the order asked for.
    """

    found: Mapping[str, Look]
    abstained: Mapping[str, str]
    views: Mapping[str, Episode]
    names: tuple[str, ...]

    @property
    def scores(self) -> dict[str, float | None]:
        """Scorer -> score, None where it abstained."""
        return {n: float(self.found[n].score) if n in self.found else None for n in self.names}

    @property
    def explanations(self) -> dict[str, str]:
        """Scorer -> one sentence for the operator, where it has one."""
        return {
            name: look.explanation
            for name, look in self.found.items()
            if look.explanation is not None
        }


@dataclass(frozen=True)
class FittedScorers:
    """Scorers as they score: after `fit_scorers`, and after `fit_dataset` where needed.

    Invariant: scores are functions of the episode and of the state behind `scoring_hash`.
    Neither the order of the reference or the dataset, nor the number of scored episodes, changes
    them.

    Attributes:
        settings: how they were configured.
        scorers: name -> scorer, in the order asked for.
        unfitted: name -> why a scorer could not be fitted; it abstains for that reason.
        length: fitted length control. Without a reference a mode that needs one becomes 'none'.
        baseline: what the reference looks like, for the checks.
        reference_ids: sorted ids of the reference episodes.
        dataset_ids: sorted ids of the episodes that `fit_dataset` learned from.
    """

    settings: CurationSettings
    scorers: Mapping[str, Scorer]
    unfitted: Mapping[str, str]
    length: LengthControl
    baseline: Baseline
    reference_ids: tuple[str, ...]
    dataset_ids: tuple[str, ...] = ()

    @property
    def needs_dataset(self) -> bool:
        """Whether something abstains until `fit_dataset` is called."""
        return self._learns_length or any(s.needs == "dataset" for s in self.scorers.values())

    @property
    def _learns_length(self) -> bool:
        return self.settings.length == "percentile" and self.length.mode == "none"

    def fit_dataset(self, episodes: Iterable[Episode]) -> FittedScorers:
        """The same scorers, with those that need it fitted on the dataset that is to be scored.

        No label is involved.

        Args:
            episodes: all of them, in any order. It may be read again each time it is iterated,
                so that one episode is held at a time. It is iterated twice if the length control
                learns from their lengths, else once.

        Raises:
            EpisodeError: if the length control finds no episode that is long enough.
        """
        length = self.length
        if self._learns_length:
            lengths = [len(e) for e in episodes]
            length = self.settings.make_length_control().fit_lengths(lengths)
        pools: dict[str, PoolScorer] = {}
        for name in self.scorers:
            scorer = self.settings.make_scorer(name)
            if isinstance(scorer, PoolScorer):
                pools[name] = scorer
        rows: dict[str, dict[str, Any]] = {name: {} for name in pools}
        ids = set()
        for episode in episodes:
            ids.add(episode.id)
            for name, pool in pools.items():
                try:
                    [view] = views(pool, [episode], length)
                    with contained(name):
                        rows[name][episode.id] = pool.summary(view)
                except EpisodeError:  # the scorer will abstain on this episode
                    continue
        unfitted = {name: why for name, why in self.unfitted.items() if name not in pools}
        for name, pool in pools.items():
            found = sorted(rows[name])
            try:
                with contained(name):
                    pool.fit_summaries(found, [rows[name][i] for i in found])
            except EpisodeError as err:
                unfitted[name] = str(err)
        return replace(
            self,
            scorers={**self.scorers, **pools},
            unfitted=unfitted,
            length=length,
            dataset_ids=tuple(sorted(ids)),
        )

    def look(self, episode: Episode) -> Looks:
        """Ask every scorer once."""
        no_view = ""
        view: Episode | None = None
        try:
            view = self.length.apply(episode)
        except EpisodeError as err:
            no_view = str(err)
        found: dict[str, Look] = {}
        abstained: dict[str, str] = {}
        shown: dict[str, Episode] = {}
        for name, scorer in self.scorers.items():
            part = view if scorer.length_controlled else episode
            if name in self.unfitted or part is None:
                abstained[name] = self.unfitted.get(name, no_view)
                continue
            try:
                with contained(name):
                    look = scorer.look(part)
                    score = float(look.score)
            except EpisodeError as err:  # Abstain is one
                abstained[name] = str(err)
                continue
            if math.isfinite(score):
                found[name], shown[name] = look, part
            else:
                abstained[name] = f"its score is {score}"
        return Looks(found, abstained, shown, tuple(self.scorers))

    def score(self, episode: Episode) -> tuple[dict[str, float | None], dict[str, str]]:
        """Score one episode with every scorer.

        Returns:
            Scorer -> score, None where it abstained; and scorer -> why it abstained.
        """
        looks = self.look(episode)
        return looks.scores, dict(looks.abstained)

    @cached_property
    def scoring_hash(self) -> str:
        """SHA-256 over scorers, length control, sorted reference ids and everything learned."""
        state = {
            "version": _STATE_VERSION,
            "salvage_margin_s": self.settings.salvage_margin_s,
            "scorers": {
                name: {
                    "version": scorer.version,
                    "params": scorer.params(),
                    "fitted": scorer.fitted(),
                    "unfitted": self.unfitted.get(name),
                    **_origin(name, scorer),
                }
                for name, scorer in self.scorers.items()
            },
            "length": self.length.describe(),
            "baseline": self.baseline.fitted(),
            "reference": self.reference_ids,
            "dataset": self.dataset_ids,
        }
        return state_hash(state)

    def describe(self) -> list[str]:
        """Lines for people: the reference, the length control, and what each scorer needs."""
        steps = self.length.steps_
        lines = [
            f"reference: {len(self.reference_ids)} episodes",
            f"length control: {self.length.mode}"
            + (f", {steps} steps" if steps is not None else ""),
        ]
        for name, scorer in self.scorers.items():
            line = f"scorer {name}: needs {scorer.needs}"
            params = ", ".join(f"{k}={v}" for k, v in scorer.params().items())
            line += f" ({params})" if params else ""
            fitted = scorer.fitted().get("k_")
            if fitted is not None and fitted < scorer.params().get("k", fitted):
                line += f"; only {fitted} reference episodes to compare with"
            if name in self.unfitted:
                line += f"; abstains: {self.unfitted[name]}"
            lines.append(line)
        return lines


def fit_scorers(settings: CurationSettings, reference: Iterable[Episode]) -> FittedScorers:
    """Fit scorers, length control and baseline on trusted episodes.

    Args:
        settings: what to fit.
        reference: in any order; may be empty. Then scorers that need one abstain.

    Raises:
        EpisodeError: naming the reference episodes that cannot be trusted, and why.
    """
    episodes = sorted(reference, key=lambda e: e.id)
    check_reference(episodes)
    length = settings.make_length_control()
    if length.needs_reference and not episodes:
        length = LengthControl("none")
    length.fit(episodes)
    scorers: dict[str, Scorer] = {}
    unfitted: dict[str, str] = {}
    for name in settings.scorers:
        scorer = scorers[name] = settings.make_scorer(name)
        if scorer.needs == "dataset":
            unfitted[name] = NO_DATASET
        elif scorer.needs == "reference" and not episodes:
            unfitted[name] = NO_REFERENCE
        else:
            try:
                with contained(name):
                    scorer.fit(views(scorer, episodes, length))
            except EpisodeError as err:
                unfitted[name] = str(err)
    return FittedScorers(
        settings=settings,
        scorers=scorers,
        unfitted=unfitted,
        length=length,
        baseline=Baseline().fit(episodes),
        reference_ids=tuple(e.id for e in episodes),
    )


def _origin(name: str, scorer: Scorer) -> dict[str, str]:
    """Where a scorer of another package comes from, as two packages may use one name."""
    kind = type(scorer)
    return {} if name in SCORERS else {"class": f"{kind.__module__}:{kind.__qualname__}"}


def views(scorer: Scorer, episodes: Sequence[Episode], length: LengthControl) -> list[Episode]:
    """Episodes as a scorer sees them: under length control, unless it looks at whole ones.

    Raises:
        EpisodeError: if the length control cannot be applied to one of them.
    """
    if not scorer.length_controlled:
        return list(episodes)
    return [length.apply(e) for e in episodes]


def check_reference(episodes: Sequence[Episode]) -> None:
    """Refuse a reference that cannot be trusted.

    Raises:
        EpisodeError: naming the episodes and why.
    """
    refused = []
    known: set[str] = set()
    for episode in episodes:
        if episode.id in known:
            refused.append(f"{episode.name} ({episode.id}): it is there twice")
        known.add(episode.id)
        found = (*episode.findings, *gripper_findings(episode), *check_episode(episode))
        faults = untrustworthy(found)
        if faults:
            refused.append(f"{episode.name} ({episode.id}): {faults[0].id}: {faults[0].message}")
    if refused:
        more = f"; and {len(refused) - _SHOWN} more" if len(refused) > _SHOWN else ""
        raise EpisodeError(f"reference refused: {'; '.join(refused[:_SHOWN])}{more}")
