"""The conformance check passes a good scorer, and finds each way to be a bad one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers import Abstain, Look, PoolScorer, Scorer
from curation_ros.testing.episodes import make_episode, make_pool, with_fields
from curation_ros.testing.scorers import SCORER_RULES, check_scorer

Fit = Sequence[Episode]


class Good(Scorer):
    """Minus the distance of the mean speed from that of the reference."""

    needs = "reference"
    resolution = 0.01
    choices: ClassVar = {"of": ("mean", "largest")}

    def __init__(self, *, of: str = "mean") -> None:
        self.of = of

    def fit(self, episodes: Fit) -> Scorer:
        self.check_params()
        if not episodes:
            raise EpisodeError("the reference has no episode")
        self.usual_ = np.mean([self.speed(e) for e in episodes])
        return self

    def look(self, episode: Episode) -> Look:
        self._check_fitted()
        return Look(-abs(self.speed(episode) - float(self.usual_)), steps=(0, len(episode) - 1))

    def speed(self, episode: Episode) -> float:
        if len(episode) < 2:
            raise Abstain("too short")
        speed = np.linalg.norm(episode.field("twist"), axis=1)
        if not np.isfinite(speed).all():
            raise Abstain("the twist is not finite")
        return float(speed.mean() if self.of == "mean" else speed.max())


class Untaught(Scorer):
    """Learns nothing."""

    resolution = 1.0

    def look(self, episode: Episode) -> Look:
        if not len(episode):
            raise Abstain("no step")
        return Look(1.0)


class NoScorer:
    """Has no rule of a scorer."""


class OwnScore(Good):
    def score(self, episode: Episode) -> float:  # type: ignore[misc] # the fault
        return 1.0


class Positional(Good):
    def __init__(self, of: str = "mean") -> None:
        self.of = of


class WithoutDefault(Good):
    def __init__(self, *, of: str) -> None:
        self.of = of


class Changed(Good):
    def __init__(self, *, of: str = "mean", power: int = 2) -> None:
        super().__init__(of=of)
        self.power = power + 1


class Fitted(Good):
    def __init__(self, *, of: str = "mean") -> None:
        self.of = of
        self.usual_ = np.float64(0.0)


class InvalidDefault(Good):
    def __init__(self, *, of: str = "median") -> None:
        self.of = of


class UnknownNeed(Good):
    needs = "luck"  # type: ignore[assignment] # the fault


class NoResolution(Good):
    resolution = 0.0


class NoPool(Good):
    needs = "dataset"


class NoVersion(Good):
    version = 0


class Labelled(Good):
    def fit(self, episodes: Fit, labels: object = None) -> Scorer:
        return super().fit(episodes)


class SeesLabels(Untaught):
    def look(self, episode: Episode, label: bool = True) -> Look:
        return super().look(episode)


class NeverFitted(Good):
    def look(self, episode: Episode) -> Look:
        self.usual_ = getattr(self, "usual_", np.float64(0.3))
        return super().look(episode)


class NeedsFit(Untaught):
    def look(self, episode: Episode) -> Look:
        if not hasattr(self, "ready_"):
            raise EpisodeError("fit first")
        return Look(1.0)

    def fit(self, episodes: Fit) -> Scorer:
        self.ready_ = 1
        return self


class ReturnsCopy(Good):
    def fit(self, episodes: Fit) -> Scorer:
        super().fit(episodes)
        other = type(self)(of=self.of)
        other.usual_ = self.usual_
        return other


class FittedOnNothing(Good):
    def fit(self, episodes: Fit) -> Scorer:
        self.usual_ = np.mean([self.speed(e) for e in episodes] or [0.0])
        return self


class LearnsBeforeRefusing(Good):
    def fit(self, episodes: Fit) -> Scorer:
        self.usual_ = np.float64(0.0)
        return super().fit(episodes)


class NotHashable(Good):
    def fit(self, episodes: Fit) -> Scorer:
        super().fit(episodes)
        self.kept_ = {1.0, 2.0}
        return self


class NotPickled(Good):
    def fit(self, episodes: Fit) -> Scorer:
        super().fit(episodes)
        self.measure = lambda episode: self.speed(episode)
        return self


class ChangesReference(Good):
    def fit(self, episodes: Fit) -> Scorer:
        for episode in episodes:
            episode.fields["twist"][0] += 1.0
        return super().fit(episodes)


class Remembers(Good):
    def fit(self, episodes: Fit) -> Scorer:
        before = getattr(self, "usual_", None)
        super().fit(episodes)
        if before is not None:
            self.usual_ = (self.usual_ + before) / 2
        return self


class LastCounts(PoolScorer):
    """Compares with the episode that was there last."""

    resolution = 0.01

    def __init__(self, *, same_start: float = 1e-3, min_others: int = 5) -> None:
        self.same_start = same_start
        self.min_others = min_others

    def _features(self, episode: Episode) -> Any:
        return np.array([Good().speed(episode)])

    def _learn(self, features: Any, fold: Any) -> None:
        pass

    def _score_features(self, features: Any, model: int) -> float:
        return -abs(float(features[0]) - self.last_)

    def fit(self, episodes: Fit) -> PoolScorer:
        super().fit(episodes)
        self.last_ = Good().speed(episodes[-1])
        return self


class Abstains(Untaught):
    def look(self, episode: Episode) -> Look:
        raise Abstain("no field 'wrist'")


class PlainNumber(Untaught):
    def look(self, episode: Episode) -> Any:
        return 1.0


class OtherFloat(Untaught):
    def look(self, episode: Episode) -> Look:
        return Look(np.float64(1.0))


class NotFinite(Untaught):
    def look(self, episode: Episode) -> Look:
        return Look(float("nan"))


class StepsOutside(Good):
    def look(self, episode: Episode) -> Look:
        return replace(super().look(episode), steps=(0, len(episode)))


class BreaksOutside(Good):
    def look(self, episode: Episode) -> Look:
        return replace(super().look(episode), broke_at=-1)


class SaysNothing(Good):
    def look(self, episode: Episode) -> Look:
        return replace(super().look(episode), explanation=" ")


class Counts(Good):
    def look(self, episode: Episode) -> Look:
        self.n = getattr(self, "n", 0) + 1
        return super().look(episode)


class ChangesEpisode(Good):
    def look(self, episode: Episode) -> Look:
        look = super().look(episode)
        episode.fields["twist"][0] += 1.0
        return look


class Fickle(Good):
    calls: ClassVar[list[int]] = []

    def look(self, episode: Episode) -> Look:
        self.calls.append(1)
        return Look(super().look(episode).score - len(self.calls))


class ById(Good):
    def look(self, episode: Episode) -> Look:
        return Look(super().look(episode).score - (episode.id == "another"))


class ByTime(Good):
    def look(self, episode: Episode) -> Look:
        hours = (episode.start_ns / 3.6e12) % 24
        return Look(super().look(episode).score - hours)


class Compares(Good):
    """With the episode before, by what it remembers outside of itself."""

    before: ClassVar[list[int]] = [0]

    def look(self, episode: Episode) -> Look:
        look = super().look(episode)
        change = len(episode) - self.before[-1]
        if len(episode) != self.before[-1]:
            self.before.append(len(episode))
        return Look(look.score + (change if len(self.before) > 2 else 0))


class Careless(Untaught):
    def look(self, episode: Episode) -> Look:
        return Look(float(np.nan_to_num(episode.field("twist").mean())))


class LongReason(Untaught):
    def look(self, episode: Episode) -> Look:
        if len(episode) < 5:
            raise Abstain("too short " * 50)
        return Look(1.0)


class Indexes(Untaught):
    def look(self, episode: Episode) -> Look:
        return Look(float(np.isfinite(episode.field("twist")[5, 0])))


class OneRobot(Good):
    def speed(self, episode: Episode) -> float:
        speed = super().speed(episode)
        return speed if episode.field("twist").shape[1] == 3 else float("inf")


#: Rule, by how it begins -> scorers that break it.
BAD: dict[str, tuple[Any, ...]] = {
    "It is a Scorer": (NoScorer, OwnScore),
    "Every parameter is keyword-only": (Positional, partial(WithoutDefault, of="mean"), Changed),
    "Construction learns nothing": (Fitted, InvalidDefault),
    "`needs`, `resolution`": (UnknownNeed, NoResolution, NoPool, NoVersion, InvalidDefault),
    "Labels have no way in": (Labelled, SeesLabels),
    "Without a fit": (NeverFitted, NeedsFit),
    "`fit` returns the scorer": (ReturnsCopy,),
    "A scorer that learns refuses an empty": (FittedOnNothing, LearnsBeforeRefusing),
    "What it learns can be hashed": (NotHashable, NotPickled),
    "`fit` changes no episode": (ChangesReference,),
    "A second fit forgets": (Remembers,),
    "The order of the dataset": (LastCounts,),
    "It scores the episode": (Abstains, PlainNumber, OtherFloat, NotFinite),
    "Steps of a look": (StepsOutside, BreaksOutside, SaysNothing),
    "A look changes neither": (Counts, ChangesEpisode, Fickle),
    "A look does not depend": (Compares,),
    "Id and name": (ById,),
    "The time at which": (ByTime,),
    "It scores a degenerate": (Careless, LongReason, Indexes),
    "An episode with other columns": (OneRobot,),
}


def rule_that_begins(beginning: str) -> str:
    [rule] = [rule for rule in SCORER_RULES if rule.startswith(beginning)]
    return rule


@pytest.mark.parametrize("make", [Good, Untaught, partial(Good, of="largest")])
def test_good_scorer_passes(make: Any) -> None:
    check_scorer(make)


@pytest.mark.parametrize(
    ("beginning", "make"), [(rule, bad) for rule, scorers in BAD.items() for bad in scorers]
)
def test_bad_scorer_is_found_by_its_rule(beginning: str, make: Any) -> None:
    rule = rule_that_begins(beginning)
    with pytest.raises(AssertionError) as caught:
        check_scorer(make, rules=[rule])
    assert f"breaks a rule: {rule}: " in str(caught.value)
    name = getattr(make, "func", make).__name__
    assert name in str(caught.value)


def test_every_rule_has_a_scorer_that_breaks_it() -> None:
    assert {rule_that_begins(beginning) for beginning in BAD} == set(SCORER_RULES)


def test_all_rules_are_checked_by_default() -> None:
    for make in (OwnScore, OneRobot):  # of the first rule and of the last
        with pytest.raises(AssertionError, match="breaks a rule"):
            check_scorer(make)


def test_episodes_of_another_robot_can_be_given() -> None:
    class Reaches(Untaught):
        """Knows a field that the generated episodes lack."""

        def look(self, episode: Episode) -> Look:
            if "reach" not in episode.fields or len(episode) < 2:
                raise Abstain("no reach")
            return Look(float(len(episode.field("reach"))))

    def with_reach(episode: Episode) -> Episode:
        known = dict(episode.topic_map.fields)
        known["reach"] = replace(known["twist"], name="reach", topic="reach")
        made = with_fields(episode, reach=np.ones((len(episode), 1)))
        return replace(made, topic_map=replace(episode.topic_map, fields=known))

    scores = rule_that_begins("It scores the episode")
    with pytest.raises(AssertionError, match=r"abstained \(no reach\); pass an episode"):
        check_scorer(Reaches, rules=[scores])
    reference = [with_reach(e) for e in make_pool(np.random.default_rng(1))]
    check_scorer(Reaches, reference=reference, episode=with_reach(make_episode()), rules=[scores])


def test_unknown_rule_is_refused() -> None:
    with pytest.raises(KeyError, match="Be nice"):
        check_scorer(Good, rules=["Be nice."])
