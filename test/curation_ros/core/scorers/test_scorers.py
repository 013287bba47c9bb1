"""Each scorer: one value worked by hand, one monotonicity, one invariance, and its own corners."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from episodes import make_episode, make_pool, make_reference, moved, topic_map, with_fields
from hypothesis import given
from hypothesis import strategies as st
from sklearn.ensemble import IsolationForest as SklearnForest

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers import SCORERS, Abstain, PoolScorer
from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.entropy import Entropy
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.isolation_forest import (
    IsolationForest,
    LabelFreeIsolationForest,
    _features,
)
from curation_ros.core.scorers.knn import LabelFreeNearestNeighbours, NearestNeighbours
from curation_ros.core.scorers.length import Length
from curation_ros.core.scorers.smoothness import Smoothness, spectral_arc_length
from curation_ros.core.scorers.trajectory_alignment import (
    LabelFreeTrajectoryAlignment,
    TrajectoryAlignment,
)
from curation_ros.core.types import Floats

ULPS = 1e-12


def falling(scores: list[float]) -> bool:
    return all(a > b for a, b in pairwise(scores))


# --- smoothness ---------------------------------------------------------------------------------


def test_smoothness_of_an_impulse_pair_by_hand() -> None:
    # speed [1, 1] at 4 Hz without padding to speak of: n_fft = 2**(1 + 1) = 4, amplitudes at
    # 0, 1, 2 Hz are 2, sqrt(2), 0, normalised 1, .7071, 0; the threshold drops the last.
    got = spectral_arc_length(np.ones(2), 4.0, cutoff_hz=10.0, pad_level=1)
    assert got == pytest.approx(-math.hypot(1.0, 1.0 - math.sqrt(0.5)), abs=ULPS)


def test_smoothness_of_a_minimum_jerk_profile_is_the_published_one() -> None:
    # A single minimum-jerk movement is about -1.41 (Balasubramanian et al. 2015, figure 3).
    t = np.linspace(0, 1, 200)
    assert spectral_arc_length(30 * t**2 - 60 * t**3 + 30 * t**4, 200.0) == pytest.approx(
        -1.41, abs=0.02
    )


#: (steps, rate, cut-off, threshold, padding level) and what `sparc` of monalysa 0.2.1 gives for
#: `wobble(steps, rate)`: the library of the authors of the measure, on PyPI.
PUBLIC_SPARC = [
    (350, 20.0, 10.0, 0.05, 4, -4.740412888296063),
    (235, 20.0, 10.0, 0.05, 4, -3.8468354303821903),
    (350, 20.0, 2.5, 0.05, 4, -3.156434151256569),
    (350, 20.0, 10.0, 0.01, 4, -5.8543938777028),
    (350, 20.0, 10.0, 0.2, 2, -2.7256426269798784),
    (1750, 100.0, 10.0, 0.05, 4, -4.718961932412804),
    (4375, 250.0, 20.0, 0.05, 4, -4.780576948659657),
    (257, 30.0, 12.5, 0.05, 0, -3.240302247615829),
    (2, 20.0, 10.0, 0.05, 4, -1.398007166081235),
]
#: That of the issue; rounding is some 1e-14.
PUBLIC_TOLERANCE = 1e-9


def wobble(n_steps: int, rate_hz: float) -> Floats:
    """A speed profile with slow, fast and rising parts."""
    t = np.arange(n_steps) / rate_hz
    slow, fast = 0.6 * np.sin(2 * np.pi * 0.4 * t), 0.3 * np.sin(2 * np.pi * 3.0 * t + 1.0)
    return 1.0 + slow + fast + 0.2 * np.cos(2 * np.pi * 7.3 * t * t / t[-1])


@pytest.mark.parametrize("case", PUBLIC_SPARC)
def test_smoothness_is_what_the_authors_of_the_measure_publish(case: tuple[float, ...]) -> None:
    n_steps, rate_hz, cutoff_hz, threshold, pad_level, expected = case
    got = spectral_arc_length(
        wobble(int(n_steps), rate_hz),
        rate_hz,
        cutoff_hz=cutoff_hz,
        threshold=threshold,
        pad_level=int(pad_level),
    )
    assert got == pytest.approx(expected, abs=PUBLIC_TOLERANCE, rel=0)


@given(
    st.integers(2, 700),
    st.sampled_from([20.0, 30.0, 100.0, 250.0]),
    st.floats(0.1, 1.0),
    st.floats(0.01, 0.5),
    st.integers(0, 5),
    st.integers(0, 2**32 - 1),
)
def test_smoothness_agrees_with_the_public_implementation(
    n_steps: int, rate_hz: float, share: float, threshold: float, pad_level: int, seed: int
) -> None:
    public = pytest.importorskip("monalysa.quality.smoothness", reason="monalysa is not installed")
    speed = np.abs(np.cumsum(np.random.default_rng(seed).standard_normal(n_steps))) + 0.01
    cutoff_hz = share * rate_hz / 2
    try:
        got = spectral_arc_length(
            speed, rate_hz, cutoff_hz=cutoff_hz, threshold=threshold, pad_level=pad_level
        )
    except Abstain:  # the public one divides by 0 where one frequency is left
        return
    expected = public.sparc(speed, rate_hz, padlevel=pad_level, fc=cutoff_hz, amp_th=threshold)[0]
    assert got == pytest.approx(float(expected), abs=PUBLIC_TOLERANCE, rel=0)


def test_smoothness_falls_with_tremor() -> None:
    scores = [
        Smoothness(gripper_channel=False).score(make_episode(tremor=a)) for a in (0.0, 0.1, 0.4)
    ]
    assert falling(scores)


def test_smoothness_does_not_depend_on_amplitude(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    double = with_fields(episode, twist=2 * episode.fields["twist"])
    scorer = Smoothness(gripper_channel=False)
    assert scorer.score(double) == pytest.approx(scorer.score(episode), abs=ULPS)


def test_smoothness_takes_the_rate_from_the_episode(rng: np.random.Generator) -> None:
    slow, fast = (
        make_episode(np.random.default_rng(3), rate_hz=r, noise=0.5) for r in (20.0, 100.0)
    )
    np.testing.assert_array_equal(slow.fields["twist"], fast.fields["twist"])
    scorer = Smoothness(gripper_channel=False)
    assert scorer.score(slow) < scorer.score(fast)  # at 100 Hz most of the noise is above 10 Hz
    assert Smoothness(gripper_channel=False, rate_hz=100.0).score(slow) == scorer.score(fast)
    # Above half the rate there is nothing: a higher cut-off changes nothing.
    assert Smoothness(cutoff_hz=10.0).score(slow) == Smoothness(cutoff_hz=500.0).score(slow)


def test_smoothness_abstains_without_speed() -> None:
    with pytest.raises(Abstain, match="zero"):
        spectral_arc_length(np.zeros(10), 20.0)
    with pytest.raises(Abstain, match="rate"):
        spectral_arc_length(np.ones(10), float("nan"))


def test_smoothness_of_commanded_positions_is_that_of_their_changes(
    rng: np.random.Generator,
) -> None:
    episode = make_episode(rng, noise=0.1)
    velocity = episode.fields["twist"]
    position = np.concatenate([[[0.0, 0, 0]], np.cumsum(velocity[:-1], axis=0)])
    positions = with_fields(episode, twist=position)
    got = Smoothness(profile="change", gripper_channel=False).score(positions)
    expected = Smoothness(gripper_channel=False).score(episode.steps(len(episode) - 1))
    assert got == pytest.approx(expected, abs=1e-9)


# --- entropy ------------------------------------------------------------------------------------


def two_step_episode() -> Episode:
    """Action rows (0, 0, 0, -1) and (2, 0, 0, 1)."""
    return with_fields(
        make_episode(n_steps=2),
        twist=np.array([[0.0, 0, 0], [2, 0, 0]]),
        gripper=np.array([[-1.0], [1]]),
    )


def test_entropy_by_hand() -> None:
    # Standard deviations over time: 1, 0, 0, 1. All eight values: mean 0.25, mean square 0.75.
    assert Entropy().score(two_step_episode()) == -0.5
    assert Entropy(gripper_channel=False).score(two_step_episode()) == pytest.approx(-1 / 3)
    assert Entropy(over="values").score(two_step_episode()) == pytest.approx(
        -math.sqrt(0.75 - 0.0625)
    )


def test_entropy_falls_with_spread() -> None:
    assert falling([Entropy().score(make_episode(noise=n)) for n in (0.0, 0.1, 0.5)])


def test_entropy_does_not_depend_on_the_order_of_steps(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    order = rng.permutation(len(episode))
    mixed = replace(episode, fields={k: v[order] for k, v in episode.fields.items()})
    assert Entropy().score(mixed) == pytest.approx(Entropy().score(episode), abs=ULPS)


# --- gripper timing -----------------------------------------------------------------------------


def test_gripper_timing_by_hand(rng: np.random.Generator) -> None:
    assert GripperTiming().score(make_episode(rng, 240, open_at=180)) == 0.75
    assert GripperTiming().score(make_episode(rng, open_at=None)) == 1.0


def test_gripper_that_never_opens_again_counts_as_latest_or_not_at_all(
    rng: np.random.Generator,
) -> None:
    with pytest.raises(Abstain, match="never opened again"):
        GripperTiming(never="abstain").score(make_episode(rng, open_at=None))
    assert GripperTiming(never="abstain").score(make_episode(rng, open_at=180)) == 0.75


def test_gripper_timing_falls_with_earlier_release(rng: np.random.Generator) -> None:
    scores = [GripperTiming().score(make_episode(rng, open_at=k)) for k in (237, 200, 150, 120)]
    assert falling(scores)


def test_gripper_timing_does_not_see_the_motion(rng: np.random.Generator) -> None:
    calm, shaky = make_episode(rng, open_at=140), make_episode(rng, open_at=140, noise=0.5)
    assert GripperTiming().score(calm) == GripperTiming().score(shaky)


def test_gripper_timing_by_fingers_lags_the_command(rng: np.random.Generator) -> None:
    episode = make_episode(rng, open_at=140, finger_lag=2)
    assert GripperTiming(on="fingers").look(episode).steps == (142, 142)
    assert GripperTiming().look(episode).steps == (140, 140)


def test_gripper_timing_abstains_where_it_cannot_know(rng: np.random.Generator) -> None:
    with pytest.raises(Abstain, match="never commanded to close"):
        GripperTiming().score(make_episode(rng, close_at=None))
    with pytest.raises(Abstain, match="never closed"):
        GripperTiming(on="fingers").score(make_episode(rng, close_at=None))
    with pytest.raises(Abstain, match="looks inverted"):
        GripperTiming().score(make_episode(rng, opens=1))
    without = replace(topic_map(), gripper=None)
    with pytest.raises(Abstain, match="no gripper"):
        GripperTiming().score(replace(make_episode(rng), topic_map=without))


def test_gripper_timing_explains_when_and_where(rng: np.random.Generator) -> None:
    early = make_episode(rng, open_at=140)
    scorer = GripperTiming()
    assert scorer.look(early).explanation == (
        "the gripper opened at 7.0 s, in LIFT, after 58% of 240 steps"
    )
    scorer.fit([make_episode(rng, open_at=None), make_episode(rng)])
    assert scorer.look(early).explanation == (
        "the gripper opened at 7.0 s, in LIFT; clean demonstrations open at 11.9 s or later"
    )
    assert scorer.look(make_episode(rng, open_at=None)).explanation is None
    assert scorer.look(make_episode(rng)).explanation == (
        "the gripper opened at 11.9 s, in RELEASE, after 99% of 240 steps"
    )


# --- isolation forest ---------------------------------------------------------------------------


@pytest.mark.parametrize("n", [2, 3, 6, 40])
def test_isolation_forest_equals_scikit_learn(n: int, rng: np.random.Generator) -> None:
    reference = [make_episode(rng, noise=0.05) for _ in range(n)]
    others = [make_episode(rng, noise=x) for x in (0.0, 0.05, 0.3)]
    ours = IsolationForest(n_trees=30).fit(reference)
    theirs = SklearnForest(n_estimators=30, max_samples=min(256, n), random_state=0).fit(
        np.array([_features(e, "signed") for e in reference])
    )
    for episode in (*others, *reference):
        expected = theirs.score_samples(_features(episode, "signed")[None])[0]
        assert ours.score(episode) == pytest.approx(expected, abs=ULPS)


def test_isolation_forest_features_by_hand() -> None:
    # First action 0, 2: mean 1, std 1, max 2, min 0, rms sqrt(2); four dimensions.
    features = _features(two_step_episode(), "signed").reshape(5, 4)[:, 0]
    np.testing.assert_allclose(features, [1, 1, 2, 0, math.sqrt(2)])


def test_isolation_forest_of_magnitudes_does_not_see_the_sign(rng: np.random.Generator) -> None:
    features = _features(two_step_episode(), "magnitudes").reshape(5, 4)
    np.testing.assert_allclose(features[:, 3], [1, 0, 1, 1, 1])  # a gripper of -1 and 1
    reference, episode = make_reference(rng), make_episode(rng)
    mirrored = with_fields(episode, twist=-episode.fields["twist"])
    forest = IsolationForest(of="magnitudes").fit(reference)
    assert forest.score(mirrored) == forest.score(episode)
    assert IsolationForest().fit(reference).score(mirrored) != forest.score(episode)


def test_isolation_forest_falls_with_distance(rng: np.random.Generator) -> None:
    forest = IsolationForest().fit([make_episode(rng, noise=0.05) for _ in range(20)])
    scores = [forest.score(make_episode(rng, noise=n)) for n in (0.05, 0.1, 1.0)]
    assert falling(scores)


def test_isolation_forest_does_not_depend_on_the_order_of_steps(rng: np.random.Generator) -> None:
    reference, episode = make_reference(rng), make_episode(rng)
    order = rng.permutation(len(episode))
    mixed = replace(episode, fields={k: v[order] for k, v in episode.fields.items()})
    forest = IsolationForest().fit(reference)
    assert forest.score(mixed) == pytest.approx(forest.score(episode), abs=ULPS)


def test_isolation_forest_is_decided_by_its_seed(rng: np.random.Generator) -> None:
    reference, episode = make_reference(rng), make_episode(rng)
    assert IsolationForest(seed=1).fit(reference).score(episode) == IsolationForest(seed=1).fit(
        reference
    ).score(episode)
    assert IsolationForest(seed=1).fit(reference).score(episode) != IsolationForest(seed=2).fit(
        reference
    ).score(episode)


# --- ensemble -----------------------------------------------------------------------------------


def test_ensemble_by_hand(rng: np.random.Generator) -> None:
    episode = make_episode(rng, open_at=180)
    smooth = Smoothness().score(episode)
    assert Ensemble().score(episode) == pytest.approx(0.5 * smooth + 0.5 * 0.75)
    assert Ensemble(smoothness_weight=0.0, gripper_weight=2.0).score(episode) == 1.5


def test_ensemble_takes_the_choices_of_its_parts(rng: np.random.Generator) -> None:
    episode = make_episode(rng, open_at=180, finger_lag=12)
    parts = Smoothness(rate_hz=50.0, gripper_channel=False), GripperTiming(on="fingers")
    expected = 0.5 * parts[0].score(episode) + 0.5 * parts[1].score(episode)
    scorer = Ensemble(rate_hz=50.0, gripper_channel=False, on="fingers")
    assert scorer.score(episode) == pytest.approx(expected, abs=ULPS)
    assert scorer.score(episode) != Ensemble().score(episode)


def test_standardised_ensemble_by_hand(rng: np.random.Generator) -> None:
    # All references open at 3/4: the timing has no spread, so its resolution 0.05 is the scale.
    reference = [make_episode(rng, open_at=180, tremor=t) for t in (0.0, 5.0)]
    a, b = (Smoothness().score(e) for e in reference)
    assert abs(a - b) / 2 > Smoothness.resolution
    scorer = Ensemble(standardised=True).fit(reference)
    z = 1.0 if a > b else -1.0
    assert scorer.score(reference[0]) == pytest.approx(0.5 * z)
    early = with_fields(reference[0], gripper=make_episode(open_at=120).fields["gripper"])
    timing = (0.5 - 0.75) / 0.05
    smooth = (Smoothness().score(early) - (a + b) / 2) / (abs(a - b) / 2)
    lag = with_fields(early, finger_position=make_episode(open_at=120).fields["finger_position"])
    assert scorer.score(lag) == pytest.approx(0.5 * smooth + 0.5 * timing)


def test_ensemble_falls_with_earlier_release_of_the_same_motion(rng: np.random.Generator) -> None:
    # Raw, SPARC moves with the gripper's channel as well; weighed by timing alone it must fall.
    scorer = Ensemble(smoothness_weight=0.0, gripper_weight=1.0)
    assert falling([scorer.score(make_episode(rng, open_at=k)) for k in (237, 180, 120)])


def test_ensemble_does_not_see_the_objects(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    moved = with_fields(episode, bowl_position=episode.fields["bowl_position"] + 1.0)
    assert Ensemble().score(moved) == Ensemble().score(episode)


# --- kNN ----------------------------------------------------------------------------------------


def test_knn_by_hand(rng: np.random.Generator) -> None:
    # Two references that differ in one state column only, by 2 metres throughout: of that column
    # mean and rms differ by 2 m and 2 m (positive values), std does not; standardised, each lies
    # at -1 and +1 of two features, 2 sqrt(2) apart.
    a = make_episode(rng)
    a = with_fields(a, eef_position=np.abs(a.fields["eef_position"]) * [0, 0, 0] + [1.0, 1, 1])
    b = replace(
        a, id="b", fields={**a.fields, "eef_position": a.fields["eef_position"] + [2, 0, 0]}
    )
    scorer = NearestNeighbours().fit([a, b])
    assert scorer.score(a) == pytest.approx(-2 * math.sqrt(2))
    assert scorer.score(replace(a, id="c")) == pytest.approx(-(0 + 2 * math.sqrt(2)) / 2)
    assert NearestNeighbours(k=1).fit([a, b]).score(replace(a, id="c")) == pytest.approx(0)


def test_knn_falls_with_distance(rng: np.random.Generator) -> None:
    scorer = NearestNeighbours().fit(make_reference(rng))
    assert falling([scorer.score(make_episode(rng, noise=n)) for n in (0.01, 0.1, 0.5)])


def test_knn_does_not_depend_on_the_order_of_the_reference(rng: np.random.Generator) -> None:
    reference, episode = make_reference(rng), make_episode(rng)
    forwards = NearestNeighbours().fit(reference).score(episode)
    assert NearestNeighbours().fit(reference[::-1]).score(episode) == pytest.approx(
        forwards, abs=1e-9
    )


def test_knn_never_counts_an_episode_as_its_own_neighbour(rng: np.random.Generator) -> None:
    reference = make_reference(rng, 2)
    scorer = NearestNeighbours(k=1).fit(reference)
    assert scorer.score(reference[0]) < -0.1
    assert scorer.score(replace(reference[0], id="a copy")) == pytest.approx(0, abs=1e-9)
    alone = NearestNeighbours().fit(reference[:1])
    with pytest.raises(Abstain, match="no other"):
        alone.score(reference[0])


def test_knn_with_few_references_uses_all_or_abstains(rng: np.random.Generator) -> None:
    reference, episode = make_reference(rng, 3), make_episode(rng)
    assert NearestNeighbours(k=5).fit(reference).k_ == 3
    assert NearestNeighbours(k=5).fit(reference).score(episode) == NearestNeighbours(k=3).fit(
        reference
    ).score(episode)
    with pytest.raises(Abstain, match="only 3 of 5"):
        NearestNeighbours(k=5, few="abstain").fit(reference).score(episode)


def test_knn_is_not_decided_by_columns_that_the_reference_never_varied(
    rng: np.random.Generator,
) -> None:
    reference, episode = make_reference(rng), make_episode(rng)
    flat = [with_fields(e, bowl_position=np.full((len(e), 3), 0.9)) for e in (*reference, episode)]
    off = with_fields(flat[-1], bowl_position=np.full((len(episode), 3), 0.9005))
    scorer = NearestNeighbours().fit(flat[:-1])
    assert scorer.score(off) == pytest.approx(scorer.score(flat[-1]), abs=0.5)


def test_knn_of_raw_features_is_in_their_unit(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    at = {x: with_fields(episode, eef_position=np.full((240, 3), x)) for x in (1.0, 2.0)}
    scorer = NearestNeighbours(standardised=False).fit([replace(at[1.0], id="a")])
    # Mean and root mean square of three columns differ by 1 m each.
    assert scorer.score(at[2.0]) == pytest.approx(-math.sqrt(6))


# --- trajectory alignment -----------------------------------------------------------------------


@pytest.mark.parametrize("of", ["time-mean", "flattened"])
def test_alignment_by_hand(of: str, rng: np.random.Generator) -> None:
    # A state of one column, +1 throughout in the reference.
    one = replace(topic_map(), state=("plate_position",))

    def constant(*xyz: float) -> Episode:
        episode = make_episode(rng, 20, close_at=5)
        plate = np.tile(np.array(xyz, dtype=float), (20, 1))
        return replace(with_fields(episode, plate_position=plate), topic_map=one)

    scorer = TrajectoryAlignment(of=of).fit([constant(1, 0, 0), constant(3, 0, 0)])
    assert scorer.score(constant(5, 0, 0)) == pytest.approx(1)
    assert scorer.score(constant(1, 1, 0)) == pytest.approx(math.sqrt(0.5))
    assert scorer.score(constant(0, 0, 7)) == pytest.approx(0)
    assert scorer.score(constant(-2, 0, 0)) == pytest.approx(-1)
    with pytest.raises(Abstain, match="zero throughout"):
        scorer.score(constant(0, 0, 0))


@pytest.mark.parametrize("of", ["time-mean", "flattened"])
def test_alignment_falls_with_deviation(of: str, rng: np.random.Generator) -> None:
    scorer = TrajectoryAlignment(of=of).fit(make_reference(rng))
    episode = make_episode(rng)
    scores = [
        scorer.score(with_fields(episode, eef_position=episode.fields["eef_position"] + [d, 0, 0]))
        for d in (0.0, 0.5, 1.5)
    ]
    assert falling(scores)


def test_alignment_does_not_depend_on_the_scale_of_all_states(rng: np.random.Generator) -> None:
    one = replace(topic_map(), state=("eef_position", "finger_position"))
    reference = [replace(e, topic_map=one) for e in make_reference(rng)]
    episode = replace(make_episode(rng), topic_map=one)
    scaled = with_fields(
        episode,
        eef_position=3 * episode.fields["eef_position"],
        finger_position=3 * episode.fields["finger_position"],
    )
    scorer = TrajectoryAlignment(of="flattened").fit(reference)
    assert scorer.score(scaled) == pytest.approx(scorer.score(episode), abs=ULPS)


def test_flattened_alignment_of_a_short_episode_uses_what_both_have(
    rng: np.random.Generator,
) -> None:
    episode = make_episode(rng)
    scorer = TrajectoryAlignment(of="flattened").fit([episode])
    assert scorer.mean_.shape[0] == len(episode)
    assert scorer.score(episode.steps(120)) == pytest.approx(1)


# --- label-free twins ---------------------------------------------------------------------------


def test_label_free_knn_is_knn_on_the_episodes_of_other_starts(rng: np.random.Generator) -> None:
    pool = make_pool(rng, 8)
    twin = LabelFreeNearestNeighbours(k=3).fit(pool)
    for k, episode in enumerate(pool):
        others = NearestNeighbours(k=3).fit(pool[:k] + pool[k + 1 :])
        assert twin.score(episode) == pytest.approx(others.score(episode), abs=1e-9)
    stranger = moved(make_episode(rng), 1.0)
    everybody = NearestNeighbours(k=3).fit(pool)
    assert twin.score(stranger) == pytest.approx(everybody.score(stranger), abs=1e-9)


def test_label_free_forest_is_the_forest_of_the_episodes_of_other_starts(
    rng: np.random.Generator,
) -> None:
    pool = make_pool(rng, 8)
    twin = LabelFreeIsolationForest(n_trees=20).fit(pool)
    rows = np.array([twin.summary(e) for e in pool])
    for k, episode in enumerate(pool):
        others = np.delete(rows, k, axis=0)
        others = others[np.lexsort(others.T[::-1])][:, 7:]  # behind 6 numbers of the start
        forest = SklearnForest(n_estimators=20, max_samples=7, random_state=0).fit(others)
        expected = forest.score_samples(_features(episode, "signed")[None])[0]
        assert twin.score(episode) == pytest.approx(expected, abs=ULPS)


def test_label_free_alignment_is_alignment_with_the_episodes_of_other_starts(
    rng: np.random.Generator,
) -> None:
    pool = make_pool(rng, 8)
    twin = LabelFreeTrajectoryAlignment().fit(pool)
    flat = LabelFreeTrajectoryAlignment(of="flattened", n_points=240).fit(
        [e.steps(230) for e in pool]
    )
    for k, episode in enumerate(pool):
        rest = pool[:k] + pool[k + 1 :]
        others = TrajectoryAlignment().fit(rest)
        assert twin.score(episode) == pytest.approx(others.score(episode), abs=ULPS)
        assert 0.9 < flat.score(episode.steps(230)) < 1


def test_label_free_flattened_alignment_by_hand(rng: np.random.Generator) -> None:
    # Two numbers an episode, the first and the last x of the plate: (1, 0), five times; (1, 1).
    one = replace(topic_map(), state=("plate_position",))

    def from_to(first: float, last: float, x_m: float) -> Episode:
        plate = np.zeros((20, 3))
        plate[:, 0] = np.linspace(first, last, 20)
        episode = moved(make_episode(rng, 20, close_at=5), x_m)
        # The start is that of the bowl and the plate.
        return replace(with_fields(episode, plate_position=plate), topic_map=one)

    pool = [from_to(1, 0, 0.1 * k) for k in range(6)]
    scorer = LabelFreeTrajectoryAlignment(of="flattened", n_points=2).fit(pool)
    assert scorer.score(from_to(1, 1, 9.0)) == pytest.approx(math.sqrt(0.5))
    assert scorer.score(pool[0]) == pytest.approx(1)
    assert scorer.score(from_to(0, 1, 9.0)) == pytest.approx(0)


@pytest.mark.parametrize(
    ("scorer", "amounts"),
    [
        (LabelFreeIsolationForest(), (0.01, 0.1, 1.0)),
        (LabelFreeNearestNeighbours(), (0.01, 0.1, 0.5)),
    ],
)
def test_label_free_twins_fall_with_distance_from_the_majority(
    scorer: PoolScorer, amounts: tuple[float, ...], rng: np.random.Generator
) -> None:
    scorer.fit(make_pool(rng, 12))
    assert falling([scorer.score(moved(make_episode(rng, noise=n), 1.0)) for n in amounts])


def test_label_free_alignment_falls_with_deviation(rng: np.random.Generator) -> None:
    scorer = LabelFreeTrajectoryAlignment().fit(make_pool(rng))
    episode = moved(make_episode(rng), 1.0)
    off = [np.array([d, 0.0, 0.0]) for d in (0, 1, 3)]
    reached = episode.fields["eef_position"]
    assert falling([scorer.score(with_fields(episode, eef_position=reached + d)) for d in off])


def test_label_free_twins_follow_the_majority_even_where_it_is_the_defect(
    rng: np.random.Generator,
) -> None:
    good = [moved(make_episode(rng), 0.02 * k) for k in range(4)]
    defect = [moved(make_episode(rng, open_at=120), 0.02 * k) for k in range(4, 20)]
    for twin in (LabelFreeNearestNeighbours(), LabelFreeIsolationForest()):
        twin.fit([*good, *defect])
        assert max(twin.score(e) for e in good) < min(twin.score(e) for e in defect)


# --- length -------------------------------------------------------------------------------------


def test_length_by_hand(rng: np.random.Generator) -> None:
    episode = make_episode(rng, 5, close_at=2)
    corner = np.array([[0.0, 0, 0], [3, 4, 0], [3, 4, 0], [3, 4, 1], [3, 4, 0]])
    assert Length().score(episode) == -5
    assert Length(of="path").score(with_fields(episode, eef_position=corner)) == -7


def test_length_falls_with_steps(rng: np.random.Generator) -> None:
    assert falling([Length().score(make_episode(rng, n)) for n in (200, 240, 500)])


def test_path_does_not_depend_on_where_it_lies(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    moved = with_fields(episode, eef_position=episode.fields["eef_position"] + [1.0, -2.0, 0.5])
    assert Length(of="path").score(moved) == pytest.approx(Length(of="path").score(episode))


# --- parameters ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "params"),
    [
        ("smoothness", {"cutoff_hz": 0.0}),
        ("entropy", {"over": "all"}),
        ("gripper_timing", {"on": "arm"}),
        ("isolation_forest", {"max_samples": 1}),
        ("ensemble", {"gripper_weight": -1.0}),
        ("knn", {"k": 0}),
        ("knn", {"few": "guess"}),
        ("trajectory_alignment", {"of": "median"}),
        ("length", {"of": "time"}),
        ("smoothness", {"rate_hz": -1.0}),
        ("smoothness", {"profile": "jerk"}),
        ("gripper_timing", {"never": "once"}),
        ("isolation_forest", {"of": "squares"}),
        ("ensemble", {"on": "arm"}),
        ("ensemble", {"rate_hz": math.inf}),
        ("isolation_forest_label_free", {"n_trees": 0}),
        ("knn_label_free", {"same_start": -1.0}),
        ("knn_label_free", {"k": 0}),
        ("trajectory_alignment_label_free", {"n_points": 1}),
        ("trajectory_alignment_label_free", {"min_others": 1}),
    ],
)
def test_bad_parameter_is_named(
    name: str, params: dict[str, object], rng: np.random.Generator
) -> None:
    scorer = SCORERS[name](**params)
    with pytest.raises(ConfigError, match=next(iter(params))):
        scorer.check_params()
    with pytest.raises(ConfigError):
        scorer.fit(make_reference(rng)).score(make_episode(rng))


def test_reference_of_two_robots_is_refused(rng: np.random.Generator) -> None:
    a, b = make_episode(rng), make_episode(rng)
    wider = with_fields(b, eef_position=np.tile(b.fields["eef_position"], 2))
    with pytest.raises(EpisodeError, match=b.id):
        NearestNeighbours().fit([a, wider])
