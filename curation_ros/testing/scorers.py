"""What every scorer must do, as checks that a scorer of another package can be run through.

For example, in a test of that package::

    import pytest
    from curation_ros.testing.scorers import SCORER_RULES, check_scorer

    @pytest.mark.parametrize("rule", SCORER_RULES)
    def test_scorer(rule):
        check_scorer(MyScorer, rules=[rule])
"""

from __future__ import annotations

import inspect
import pickle
import warnings
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, get_args

import numpy as np

from curation_ros.core.decision.state_hash import state_hash
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import CurationError, EpisodeError, NotFittedError
from curation_ros.core.scorers import Abstain, Look, Need, PoolScorer, Scorer
from curation_ros.testing.episodes import copied, make_episode, make_pool, shifted, with_fields
from curation_ros.testing.rules import Rules, expect

#: What orients these comes with the episode, so they learn nothing.
_LEARNS_NOTHING: tuple[Need, ...] = ("nothing", "object pose")
_HOUR_NS = 3_600_000_000_000
#: A reason to abstain is one short line.
_LONGEST_REASON = 100


@dataclass(frozen=True)
class _Case:
    """A scorer under test, and episodes to test it with."""

    make: Callable[[], Scorer]
    reference: Sequence[Episode]
    episode: Episode

    @cached_property
    def fitted(self) -> Scorer:
        """Fitted once for all rules, as none of them may change it."""
        return self.make().fit(self.reference)


#: Rule -> its check. Each rule is a sentence about every scorer.
SCORER_RULES: Rules[_Case] = Rules()
_rule = SCORER_RULES.rule


def check_scorer(
    make: Callable[[], Scorer],
    *,
    reference: Sequence[Episode] = (),
    episode: Episode | None = None,
    rules: Collection[str] = (),
) -> None:
    """Check that a scorer does what every scorer must do.

    Args:
        make: the class; or what makes an unfitted scorer, as `functools.partial` of the class.
        reference: at least six trusted episodes of one robot, each with its own start and id; by
            default generated ones.
        episode: another episode of that robot, which the scorer can score; by default an early
            release.
        rules: keys of SCORER_RULES; by default all of them.

    Raises:
        AssertionError: naming the scorer, the rule it breaks, and how.
        KeyError: if there is no such rule.
    """
    rng = np.random.default_rng(20261)
    case = _Case(
        make,
        list(reference) or make_pool(rng, 8),
        episode if episode is not None else make_episode(rng, open_at=140),
    )
    SCORER_RULES.check(case, _name(make), rules)


def _name(make: Callable[[], Scorer]) -> str:
    return str(getattr(make, "__name__", make))


def _state(scorer: Scorer) -> str:
    """Everything that a scorer holds, as text."""
    with np.printoptions(threshold=10**9, floatmode="unique"):
        return repr(sorted(vars(scorer).items()))


# --- the class ----------------------------------------------------------------------------------


@_rule("It is a Scorer, and overrides `look` but not `score`.")
def _overrides_look(case: _Case) -> None:
    scorer = case.make()
    expect(isinstance(scorer, Scorer), f"it is a {type(scorer).__name__}")
    expect(type(scorer).score is Scorer.score, "it overrides score")


@_rule("Every parameter is keyword-only, has a default, and is stored unchanged under its name.")
def _stores_parameters(case: _Case) -> None:
    parameters = list(inspect.signature(type(case.make())).parameters.values())
    for p in parameters:
        expect(p.kind is p.KEYWORD_ONLY, f"{p.name} is not keyword-only")
        expect(p.default is not p.empty, f"{p.name} has no default")
    given = {p.name: p.default for p in parameters}
    found = type(case.make())(**given).params()
    expect(found == given, f"given {given}, stored {found}")


@_rule("Construction learns nothing, and default parameters are valid.")
def _construction_learns_nothing(case: _Case) -> None:
    scorer = case.make()
    scorer.check_params()
    expect(not scorer.fitted(), f"it holds {', '.join(scorer.fitted())} before fit")


@_rule("`needs`, `resolution`, `version` and `choices` say what they should.")
def _declarations(case: _Case) -> None:
    scorer = case.make()
    expect(scorer.needs in get_args(Need), f"needs is {scorer.needs!r}, none of {get_args(Need)}")
    expect(
        isinstance(scorer, PoolScorer) == (scorer.needs == "dataset"),
        "a scorer needs the dataset exactly if it is a PoolScorer",
    )
    expect(scorer.resolution > 0, f"resolution is {scorer.resolution}, expected more than 0")
    expect(isinstance(scorer.length_controlled, bool), "length_controlled is not a bool")
    expect(
        isinstance(scorer.version, int) and scorer.version >= 1,
        f"version is {scorer.version!r}, expected 1 or more",
    )
    for name, choices in scorer.choices.items():
        value = scorer.params().get(name)
        expect(value in choices, f"choices of {name} are {choices}, its value is {value!r}")


@_rule("Labels have no way in: `look` takes an episode, `fit` takes episodes, and nothing else.")
def _no_labels(case: _Case) -> None:
    kind = type(case.make())
    for method, expected in ((kind.look, ["self", "episode"]), (kind.fit, ["self", "episodes"])):
        found = list(inspect.signature(method).parameters)
        expect(found == expected, f"{method.__name__} takes {', '.join(found)}")


# --- fitting ------------------------------------------------------------------------------------


@_rule("Without a fit, a scorer that learns raises NotFittedError, and another one scores.")
def _look_before_fit(case: _Case) -> None:
    scorer = case.make()
    if scorer.needs in _LEARNS_NOTHING:
        scorer.look(case.episode)
        return
    try:
        scorer.look(case.episode)
    except NotFittedError:
        return
    raise AssertionError("it looked at an episode before fit")


@_rule("`fit` returns the scorer.")
def _fit_returns_self(case: _Case) -> None:
    scorer = case.make()
    expect(scorer.fit(case.reference) is scorer, "it returned something else")


@_rule("A scorer that learns refuses an empty reference with an EpisodeError and learns nothing.")
def _empty_reference(case: _Case) -> None:
    scorer = case.make()
    if scorer.needs in _LEARNS_NOTHING:
        scorer.fit([])
        return
    try:
        scorer.fit([])
    except EpisodeError:
        expect(not scorer.fitted(), f"it holds {', '.join(scorer.fitted())}")
        return
    raise AssertionError("it was fitted on nothing")


@_rule("What it learns can be hashed and pickled, and scores the same in another process.")
def _state_travels(case: _Case) -> None:
    fitted = case.fitted
    state_hash(fitted.fitted())
    travelled: Scorer = pickle.loads(pickle.dumps(fitted))
    expect(travelled.look(case.episode) == fitted.look(case.episode), "its copy looks differently")


@_rule("`fit` changes no episode.")
def _fit_changes_no_episode(case: _Case) -> None:
    before = [e.digest for e in case.reference]
    case.make().fit(case.reference)
    expect([e.digest for e in case.reference] == before, "an episode of the reference has changed")


@_rule("A second fit forgets the first.")
def _refit_forgets(case: _Case) -> None:
    others = [_scaled(e, 1.1) for e in case.reference]
    refitted = case.make().fit(others).fit(case.reference)
    expect(_state(refitted) == _state(case.fitted), "it remembers what it was fitted on before")


@_rule("The order of the dataset changes no look of a scorer that needs it.")
def _order_of_the_dataset(case: _Case) -> None:
    fitted = case.fitted
    if fitted.needs == "dataset":
        backwards = case.make().fit(list(reversed(case.reference)))
        expect(backwards.look(case.episode) == fitted.look(case.episode), "the look depends on it")


# --- looking ------------------------------------------------------------------------------------


@_rule("It scores the episode: its look is a Look, and its score a finite float.")
def _scores(case: _Case) -> None:
    try:
        look = case.fitted.look(case.episode)
    except Abstain as reason:
        raise AssertionError(
            f"it abstained ({reason}); pass an episode and a reference that it can score"
        ) from reason
    expect(type(look) is Look, f"it returned a {type(look).__name__}")
    expect(type(look.score) is float, f"the score is a {type(look.score).__name__}")
    expect(np.isfinite(look.score), f"the score is {look.score}")


@_rule("Steps of a look lie in the episode, and an explanation is one line.")
def _steps_and_explanation(case: _Case) -> None:
    look, n = case.fitted.look(case.episode), len(case.episode)
    if look.steps is not None:
        first, last = look.steps
        expect(0 <= first <= last < n, f"steps are {look.steps}, the episode has {n}")
    if look.broke_at is not None:
        expect(0 <= look.broke_at < n, f"broke_at is {look.broke_at}, the episode has {n} steps")
    if look.explanation is not None:
        lines = look.explanation.strip().splitlines()
        expect(len(lines) == 1, f"the explanation is {look.explanation!r}")


@_rule("A look changes neither scorer nor episode, and a second one is equal.")
def _look_changes_nothing(case: _Case) -> None:
    fitted = case.fitted
    state, digest = _state(fitted), case.episode.digest
    first = fitted.look(case.episode)
    expect(_state(fitted) == state, "the scorer has changed")
    expect(case.episode.digest == digest, "the episode has changed")
    expect(fitted.look(case.episode) == first, "the second look differs")
    expect(fitted.look(replace(case.episode)) == first, "the look at an equal episode differs")


@_rule("A look does not depend on other episodes that are looked at.")
def _looks_are_independent(case: _Case) -> None:
    fitted = case.fitted
    batch = [case.episode, _scaled(case.episode, 1.05), *case.reference[:3]]
    forwards = [_look_or_reason(fitted, e) for e in batch]
    backwards = [_look_or_reason(fitted, e) for e in reversed(batch)]
    expect(forwards == backwards[::-1], "looks depend on the order of the episodes")


@_rule("Id and name of an episode do not matter.")
def _identity_does_not_matter(case: _Case) -> None:
    fitted = case.fitted
    copy = copied(case.episode, id="another", name="other")
    expect(
        fitted.look(copy) == fitted.look(case.episode), "a copy with another id looks different"
    )


@_rule("The time at which an episode was recorded does not matter.")
def _time_does_not_matter(case: _Case) -> None:
    later = case.make().fit([shifted(e, _HOUR_NS) for e in case.reference])
    expect(
        later.look(shifted(case.episode, _HOUR_NS)) == case.fitted.look(case.episode),
        "an hour later the look differs",
    )


@_rule("It scores a degenerate episode without a warning, or abstains with a short reason.")
def _degenerate_episodes(case: _Case) -> None:
    fitted = case.fitted
    for what, episode in _degenerate(case.episode).items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                score = fitted.look(episode).score
                expect(np.isfinite(score), f"{what}: its score is {score}")
            except Abstain as reason:
                n = len(str(reason))
                expect(0 < n <= _LONGEST_REASON, f"{what}: the reason has {n} characters")
            except (CurationError, Warning, ArithmeticError, LookupError, ValueError) as err:
                raise AssertionError(f"{what}: {type(err).__name__}: {err}") from err


@_rule("An episode with other columns is scored, or the scorer abstains.")
def _another_robot(case: _Case) -> None:
    try:
        score = case.fitted.look(_wider(case.episode)).score
    except Abstain:
        return
    expect(np.isfinite(score), f"its score is {score}")


def _look_or_reason(scorer: Scorer, episode: Episode) -> Look | str:
    try:
        return scorer.look(episode)
    except Abstain as reason:
        return str(reason)


def _scaled(episode: Episode, factor: float) -> Episode:
    """Another motion: all fields but phases and command of the gripper times a factor."""
    gripper = episode.topic_map.gripper
    fields = {
        name: values * factor
        for name, values in episode.fields.items()
        if not episode.topic_map.fields[name].labels and (not gripper or name != gripper.field)
    }
    return with_fields(episode, **fields)


def _wider(episode: Episode) -> Episode:
    """The episode with twice the columns in what is measured, and in actions."""
    fields: dict[str, Any] = {
        name: np.tile(values, 2)
        for name, values in episode.fields.items()
        if episode.topic_map.fields[name].role in ("clock", "effector", "action")
    }
    return with_fields(episode, **fields)


def _degenerate(episode: Episode) -> dict[str, Episode]:
    every = episode.fields.items()
    half = len(episode) // 2

    def from_half_on(values: Any, value: float) -> Any:
        changed = values.copy()
        changed[half:] = value
        return changed

    return {
        "no step": episode.steps(0),
        "one step": episode.steps(1),
        "two steps": episode.steps(2),
        "three steps": episode.steps(3),
        "NaN from half on": with_fields(episode, **{k: from_half_on(v, np.nan) for k, v in every}),
        "all missing": with_fields(episode, **{k: v * np.nan for k, v in every}),
        "infinite": with_fields(episode, **{k: np.full_like(v, np.inf) for k, v in every}),
        "all zeros": with_fields(episode, **{k: v * 0.0 for k, v in every}),
        "constant": with_fields(episode, **{k: np.tile(v[:1], (len(v), 1)) for k, v in every}),
    }
