"""The contract of every scorer, parametrised over the one list of them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from copy import deepcopy
from dataclasses import fields, replace
from functools import partial

import numpy as np
import pytest
from episodes import copied, make_episode, make_pool, moved, with_fields
from streams import samples_of

from curation_ros.bags import CdrDecoder
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.stream import Messages, SampleBlock
from curation_ros.core.errors import EpisodeError, NotFittedError
from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS, Abstain, PoolScorer, Scorer
from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.features import start_state
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.knn import NearestNeighbours
from curation_ros.core.scorers.length import Length
from curation_ros.core.scorers.smoothness import Smoothness
from curation_ros.core.scorers.trajectory_alignment import TrajectoryAlignment
from curation_ros.testing.scorers import check_scorer

NAMES = list(SCORERS)
POOLED = [name for name in NAMES if SCORERS[name].needs == "dataset"]
CONSEQUENCE = ["object_coupling", "grip_consistency", "phase_events"]
#: What orients these comes with the episode: they learn nothing.
LEARNS_NOTHING = ("nothing", "object pose")
HOUR_NS = 3_600_000_000_000
_fitted: dict[str, Scorer] = {}


@pytest.fixture(params=NAMES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_pool(rng)


@pytest.fixture
def fitted(name: str, reference: list[Episode]) -> Scorer:
    # Fitting takes most of the time, and the reference is the same in every test.
    if name not in _fitted:
        _fitted[name] = SCORERS[name]().fit(reference)
    return deepcopy(_fitted[name])


def state_bytes(scorer: Scorer) -> str:
    with np.printoptions(threshold=10**9, floatmode="unique"):
        return repr(sorted(vars(scorer).items()))


def test_empty_reference_is_refused_where_one_is_needed(name: str) -> None:
    scorer = SCORERS[name]()
    if scorer.needs not in LEARNS_NOTHING:
        with pytest.raises(EpisodeError, match=scorer.needs):
            scorer.fit([])
        assert scorer.fitted() == {}


def test_rules_of_every_scorer_are_kept(name: str) -> None:
    check_scorer(SCORERS[name])


@pytest.mark.parametrize(
    "make",
    [
        partial(Ensemble, standardised=True),
        partial(NearestNeighbours, few="abstain"),
        partial(GripperTiming, on="fingers", never="abstain"),
        partial(TrajectoryAlignment, of="flattened"),
        partial(Length, of="path"),
        partial(Smoothness, profile="change"),
    ],
)
def test_rules_are_kept_with_other_parameters(make: Callable[[], Scorer]) -> None:
    check_scorer(make)


def test_live_equals_bag(fitted: Scorer, rng: np.random.Generator) -> None:
    # A bag in one block a topic, a live stream message by message, asked for in between.
    made = make_episode(rng, open_at=140)
    samples = samples_of(made)

    def builder() -> EpisodeBuilder:
        return EpisodeBuilder(
            made.topic_map,
            CdrDecoder(),
            episode_id=made.id,
            name=made.name,
            start_ns=made.start_ns,
        )

    live, bag = builder(), builder()
    for k, sample in enumerate(samples):
        live.push(sample)
        if k % 500 == 499:
            live.partial()
    for topic in made.topic_map.topics:
        of_topic = [s for s in samples if s.topic == topic]
        bag.push_block(
            SampleBlock(
                topic,
                np.array([s.stamp_ns for s in of_topic]),
                np.array([s.seq for s in of_topic]),
                Messages.joined([s.data for s in of_topic]),
            )
        )
    lived = live.finish(made.end_ns, {})
    assert fitted.look(lived) == fitted.look(bag.finish(made.end_ns, {}))
    assert fitted.look(lived) == fitted.look(made)


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
    fitted: Scorer, name: str, rng: np.random.Generator, n_steps: int
) -> None:
    episode = make_episode(rng, n_steps, close_at=1)
    if n_steps >= 5 and name in CONSEQUENCE:
        with pytest.raises(Abstain, match="never came to LIFT"):
            fitted.score(episode)
        return
    try:
        assert np.isfinite(fitted.score(episode))
    except Abstain:
        assert n_steps < 5


def test_steps_of_a_look_lie_in_the_episode(
    fitted: Scorer, name: str, rng: np.random.Generator
) -> None:
    episode = make_episode(rng, open_at=140)
    look = fitted.look(episode)
    if look.steps is not None:
        assert 0 <= look.steps[0] <= look.steps[1] < len(episode)
    if look.broke_at is not None:
        assert 0 <= look.broke_at < len(episode)
    assert look.explanation is None or look.explanation.strip()
    if name in CONSEQUENCE:  # it was opened in LIFT
        assert look.steps is not None
        assert look.broke_at == 140
        assert look.explanation is not None


def test_labels_have_no_way_in(name: str) -> None:
    assert list(inspect.signature(SCORERS[name].look).parameters) == ["self", "episode"]
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
    if fitted.needs not in LEARNS_NOTHING:
        with pytest.raises(Abstain, match=f"the {fitted.needs} has"):
            fitted.score(wider)
    else:
        assert np.isfinite(fitted.score(wider))


def test_registry_is_the_paper_the_baseline_the_consequence_and_the_twins() -> None:
    paper = {
        "smoothness",
        "entropy",
        "gripper_timing",
        "isolation_forest",
        "ensemble",
        "knn",
        "trajectory_alignment",
    }
    fitted_on_clean = {n for n in paper if SCORERS[n].needs == "reference"}
    assert set(DEFAULT_SCORERS) == paper | {"length"} | set(CONSEQUENCE)
    assert set(POOLED) == {f"{n}_label_free" for n in fitted_on_clean}
    assert set(NAMES) == set(DEFAULT_SCORERS) | set(POOLED)
    whole = [n for n in NAMES if not SCORERS[n].length_controlled]
    assert whole == ["length", *CONSEQUENCE]


@pytest.mark.parametrize("scorer", [Ensemble(standardised=True), NearestNeighbours(few="abstain")])
def test_other_forms_need_what_they_say(scorer: Scorer, rng: np.random.Generator) -> None:
    assert scorer.needs == "reference"
    with pytest.raises(NotFittedError):
        scorer.score(make_episode(rng))


# --- label-free twins ---------------------------------------------------------------------------


def pooled(name: str, episodes: list[Episode]) -> PoolScorer:
    return pool_scorer(name).fit(episodes)


def pool_scorer(name: str) -> PoolScorer:
    """A twin with few trees, if it has any: they take the time of these tests."""
    scorer = SCORERS[name](**({"n_trees": 10} if "forest" in name else {}))
    assert isinstance(scorer, PoolScorer)
    return scorer


@pytest.mark.parametrize("name", POOLED)
def test_copies_from_the_same_start_change_nothing(name: str, rng: np.random.Generator) -> None:
    pool = make_pool(rng, 30)  # more starts than folds
    for episode in (pool[0], pool[17]):
        alone = pooled(name, pool)
        copies = [copied(episode, id=i, name=i) for i in ("0", "a copy", "zzz")]
        among = pooled(name, [copies[0], *pool, *copies[1:]])
        without = pooled(name, [e for e in pool if e is not episode])
        assert among.score(episode) == alone.score(episode)
        assert among.score(copies[0]) == alone.score(episode)
        if name != "isolation_forest_label_free":  # its trees draw other samples
            assert without.score(pool[3]) != alone.score(pool[3])


@pytest.mark.parametrize("name", POOLED)
def test_repetitions_of_a_start_are_left_out_whatever_they_did(
    name: str, rng: np.random.Generator
) -> None:
    pool = make_pool(rng, 8)
    episode = pool[2]
    wild = make_episode(rng, noise=0.5, open_at=120)
    again = with_fields(
        copied(wild, id="again"),
        bowl_position=np.tile(episode.fields["bowl_position"][0], (240, 1)),
    )
    assert pooled(name, [*pool, again]).score(episode) == pooled(name, pool).score(episode)


@pytest.mark.parametrize("name", POOLED)
def test_order_of_the_dataset_changes_nothing(name: str, rng: np.random.Generator) -> None:
    pool = make_pool(rng, 12)
    forwards, backwards = pooled(name, pool), pooled(name, pool[::-1])
    renamed = pooled(name, [replace(e, id=f"{k}") for k, e in enumerate(pool)])
    for episode in (*pool, moved(make_episode(rng), 1.0)):
        expected = forwards.score(episode)
        assert backwards.score(episode) == expected
        assert renamed.score(episode) == expected


@pytest.mark.parametrize("name", POOLED)
def test_fit_of_summaries_is_fit(name: str, rng: np.random.Generator) -> None:
    pool = make_pool(rng)
    scorer = pool_scorer(name)
    rows = [scorer.summary(e) for e in pool]
    assert {row.shape for row in rows} == {rows[0].shape}
    scorer.fit_summaries([e.id for e in pool], rows)
    assert state_bytes(scorer) == state_bytes(pooled(name, pool))


@pytest.mark.parametrize("name", POOLED)
def test_episodes_that_cannot_be_used_are_skipped(name: str, rng: np.random.Generator) -> None:
    pool = make_pool(rng)
    episode = make_episode(rng)
    foreign = with_fields(
        episode,
        twist=np.tile(episode.fields["twist"], 2),
        eef_position=np.tile(episode.fields["eef_position"], 2),
    )
    bad = [degenerate("NaN"), make_episode(n_steps=1, episode_id="short"), foreign]
    assert state_bytes(pooled(name, [*bad, *pool])) == state_bytes(pooled(name, pool))
    with pytest.raises(EpisodeError, match="4 episodes that can be used, at least 5"):
        pooled(name, [*bad, *pool[:4]])
    with pytest.raises(EpisodeError, match=f"{pool[0].id} twice"):
        pooled(name, [*pool, pool[0]])


@pytest.mark.parametrize("name", POOLED)
def test_too_few_other_starts_abstain_with_the_number(name: str, rng: np.random.Generator) -> None:
    same = [moved(make_episode(rng, noise=0.0), 0.0) for _ in range(6)]
    scorer = pooled(name, [*same, *make_pool(rng, 6)[3:]])
    with pytest.raises(Abstain, match="only 3 episodes of other starts, at least 5"):
        scorer.score(same[0])
    assert np.isfinite(scorer.score(moved(make_episode(rng), 1.0)))
    with pytest.raises(Abstain, match="only 0 episodes of other starts"):
        pooled(name, same).score(same[0])


@pytest.mark.parametrize("name", POOLED)
def test_starts_are_the_same_within_the_tolerance(name: str, rng: np.random.Generator) -> None:
    def bowl_at(x_m: float) -> Episode:
        bowl = np.tile([x_m, 0.0, 0.9], (240, 1))
        return with_fields(make_episode(rng), bowl_position=bowl)

    pool = [bowl_at(x) for x in (0.0, 0.0009, 0.002, 0.1, 0.2, 0.3, 0.4, 0.5)]
    scorer = pooled(name, pool)
    groups = {x: k for x, k in zip(scorer.starts_[:, 0], scorer.fold_, strict=True)}
    assert groups[0.0] == groups[0.0009]
    assert len(set(groups.values())) == 7
    with pytest.raises(Abstain, match="between starts"):
        scorer.score(bowl_at(0.0015))


def test_start_without_objects_is_that_of_the_effector(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    kept = {k: v for k, v in episode.topic_map.fields.items() if v.role != "object"}
    state = ("eef_position", "finger_position")
    bare = replace(episode, topic_map=replace(episode.topic_map, fields=kept, state=state))
    np.testing.assert_array_equal(start_state(bare), episode.fields["eef_position"][0])
    start = [episode.fields[name][0] for name in ("bowl_position", "plate_position")]
    np.testing.assert_array_equal(start_state(episode), np.concatenate(start))
    gone = with_fields(episode, bowl_position=np.full((240, 3), np.nan))
    with pytest.raises(Abstain, match="start is not finite"):
        start_state(gone)
