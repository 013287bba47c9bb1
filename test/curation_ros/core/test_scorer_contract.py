"""The contract of every scorer, parametrised over the one list of them."""

from __future__ import annotations

import inspect
from dataclasses import fields

import numpy as np
import pytest
from episodes import copied, make_episode, make_reference, shifted, with_fields

from curation_ros.core.episode import Episode
from curation_ros.core.errors import EpisodeError, NotFittedError
from curation_ros.core.scorers import SCORERS, Abstain, Scorer
from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.knn import NearestNeighbours

NAMES = list(SCORERS)
HOUR_NS = 3_600_000_000_000


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_reference(rng)


@pytest.fixture
def fitted(name: str, reference: list[Episode]) -> Scorer:
    return SCORERS[name]().fit(reference)


def state_bytes(scorer: Scorer) -> str:
    with np.printoptions(threshold=10**9, floatmode="unique"):
        return repr(sorted(vars(scorer).items()))


def test_parameters_are_keyword_only_with_defaults_and_stored_unchanged(name: str) -> None:
    parameters = [p for p in inspect.signature(SCORERS[name]).parameters.values()]
    assert all(p.kind is p.KEYWORD_ONLY and p.default is not p.empty for p in parameters)
    given = {p.name: p.default for p in parameters}
    assert SCORERS[name](**given).params() == given


def test_construction_learns_nothing(name: str) -> None:
    assert SCORERS[name]().fitted() == {}


def test_declares_what_it_needs(name: str) -> None:
    assert SCORERS[name].needs in ("nothing", "reference", "object pose", "rollouts", "labels")
    assert SCORERS[name].resolution >= 0
    assert SCORERS[name]().resolution > 0


def test_score_before_fit_raises_where_a_reference_is_needed(
    name: str, rng: np.random.Generator
) -> None:
    scorer = SCORERS[name]()
    if scorer.needs == "nothing":
        assert np.isfinite(scorer.score(make_episode(rng)))
    else:
        with pytest.raises(NotFittedError):
            scorer.score(make_episode(rng))


def test_fit_returns_self_and_learned_values_are_plain(fitted: Scorer, name: str) -> None:
    scorer = SCORERS[name]()
    assert scorer.fit([make_episode(np.random.default_rng(k)) for k in range(3)]) is scorer
    for value in fitted.fitted().values():
        assert isinstance(value, (np.ndarray, int, float, str, tuple, type(None)))


def test_empty_reference_is_refused_where_one_is_needed(name: str) -> None:
    scorer = SCORERS[name]()
    if scorer.needs == "reference":
        with pytest.raises(EpisodeError, match="reference"):
            scorer.fit([])


def test_score_is_a_finite_float_and_changes_nothing(
    fitted: Scorer, rng: np.random.Generator
) -> None:
    episode = make_episode(rng)
    state, digest = state_bytes(fitted), episode.digest
    first = fitted.score(episode)
    fitted.location(episode)
    fitted.explain(episode)
    assert type(first) is float
    assert np.isfinite(first)
    assert fitted.score(episode) == first
    assert state_bytes(fitted) == state
    assert episode.digest == digest


def test_fit_changes_no_reference_episode(name: str, reference: list[Episode]) -> None:
    digests = [e.digest for e in reference]
    SCORERS[name]().fit(reference)
    assert [e.digest for e in reference] == digests


def test_score_is_the_same_alone_and_in_a_batch(fitted: Scorer, rng: np.random.Generator) -> None:
    batch = [make_episode(rng, 230 + k, open_at=130 + 9 * k) for k in range(8)]
    forwards = [fitted.score(e) for e in batch]
    backwards = [fitted.score(e) for e in reversed(batch)][::-1]
    assert forwards == backwards


def test_refit_forgets(name: str, reference: list[Episode], rng: np.random.Generator) -> None:
    other = [make_episode(rng, 300, noise=0.2, close_at=60) for _ in range(4)]
    fresh = SCORERS[name]().fit(reference)
    refitted = SCORERS[name]().fit(other).fit(reference)
    assert state_bytes(refitted) == state_bytes(fresh)


def test_copied_episode_scores_the_same(fitted: Scorer, rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    assert fitted.score(copied(episode)) == fitted.score(episode)
    assert fitted.score(copied(episode, id="another", name="x")) == fitted.score(episode)


def test_shift_of_all_stamps_changes_nothing(
    name: str, reference: list[Episode], rng: np.random.Generator
) -> None:
    episode = make_episode(rng)
    here = SCORERS[name]().fit(reference)
    there = SCORERS[name]().fit([shifted(e, HOUR_NS) for e in reference])
    assert there.score(shifted(episode, HOUR_NS)) == here.score(episode)
    assert there.explain(shifted(episode, HOUR_NS)) == here.explain(episode)


def degenerate(kind: str) -> Episode:
    episode = make_episode(np.random.default_rng(1))
    n = len(episode)
    if kind == "empty":
        return make_episode(n_steps=0)
    if kind == "one step":
        return episode.steps(1)
    if kind == "NaN":
        command = episode.fields["gripper"].copy()
        twist = episode.fields["twist"].copy()
        command[n // 2] = twist[n // 2] = np.nan
        return with_fields(episode, gripper=command, twist=twist)
    if kind == "infinite":
        return with_fields(
            episode, gripper=np.full((n, 1), np.inf), twist=np.full((n, 3), -np.inf)
        )
    if kind == "all missing":
        return with_fields(episode, **{k: v * np.nan for k, v in episode.fields.items()})
    return with_fields(episode, twist=np.full((n, 3), 0.1), gripper=np.full((n, 1), -1.0))


@pytest.mark.parametrize(
    "kind", ["empty", "one step", "NaN", "infinite", "all missing", "constant"]
)
@pytest.mark.filterwarnings("error")
def test_degenerate_episode_abstains_with_a_short_reason(fitted: Scorer, kind: str) -> None:
    with pytest.raises(Abstain) as caught:
        fitted.score(degenerate(kind))
    assert 0 < len(str(caught.value)) < 100


@pytest.mark.parametrize("n_steps", [2, 3, 5])
@pytest.mark.filterwarnings("error")
def test_shortest_episodes_score_or_abstain(
    fitted: Scorer, rng: np.random.Generator, n_steps: int
) -> None:
    episode = make_episode(rng, n_steps, close_at=1)
    try:
        assert np.isfinite(fitted.score(episode))
    except Abstain:
        assert n_steps < 5


def test_location_lies_in_the_episode(fitted: Scorer, rng: np.random.Generator) -> None:
    episode = make_episode(rng, open_at=140)
    location = fitted.location(episode)
    if location is not None:
        assert 0 <= location[0] <= location[1] < len(episode)


def test_labels_have_no_way_in(name: str) -> None:
    assert list(inspect.signature(SCORERS[name].score).parameters) == ["self", "episode"]
    assert list(inspect.signature(SCORERS[name].fit).parameters) == ["self", "episodes"]
    known = {f.name for f in fields(Episode)}
    assert not known & {"success", "label", "labels", "outcome", "defect", "truth"}
    with pytest.raises(TypeError):
        SCORERS[name]().fit([], y=[])  # type: ignore[call-arg]


def test_another_robot_abstains_or_scores(fitted: Scorer, rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    wider = with_fields(
        episode,
        twist=np.tile(episode.fields["twist"], 2),
        eef_position=np.tile(episode.fields["eef_position"], 2),
    )
    if fitted.needs == "reference":
        with pytest.raises(Abstain, match="the reference has"):
            fitted.score(wider)
    else:
        assert np.isfinite(fitted.score(wider))


def test_registry_is_the_paper_and_the_baseline() -> None:
    assert set(NAMES) == {
        "smoothness",
        "entropy",
        "gripper_timing",
        "isolation_forest",
        "ensemble",
        "knn",
        "trajectory_alignment",
        "length",
    }
    assert [n for n in NAMES if not SCORERS[n].length_controlled] == ["length"]


@pytest.mark.parametrize("scorer", [Ensemble(standardised=True), NearestNeighbours(few="abstain")])
def test_other_forms_need_what_they_say(scorer: Scorer, rng: np.random.Generator) -> None:
    assert scorer.needs == "reference"
    with pytest.raises(NotFittedError):
        scorer.score(make_episode(rng))
