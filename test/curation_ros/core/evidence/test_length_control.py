"""Length control: modes, and what it leaves alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from episodes import make_episode, with_fields
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.evidence.length_control import MODES, LengthControl


def test_shortest_reference_is_the_papers_t(rng: np.random.Generator) -> None:
    control = LengthControl("shortest-reference").fit([make_episode(rng, n) for n in (230, 215)])
    assert control.steps_ == 215
    assert [len(control.apply(make_episode(rng, n))) for n in (500, 215, 120)] == [215, 215, 120]


def test_percentile_of_reference_lengths(rng: np.random.Generator) -> None:
    reference = [make_episode(rng, n) for n in (100, 200, 300)]
    assert LengthControl("percentile", 50).fit(reference).steps_ == 200
    assert LengthControl("percentile", 0).fit(reference).steps_ == 100
    assert LengthControl("percentile", 25).fit(reference).steps_ == 150


def test_none_and_fixed_need_no_reference(rng: np.random.Generator) -> None:
    episode = make_episode(rng, 300)
    assert LengthControl().apply(episode) is episode
    assert len(LengthControl("fixed", 150).apply(episode)) == 150
    assert len(LengthControl("fixed", 150).fit([]).apply(episode)) == 150


def test_truncation_keeps_identity_window_and_prefix(rng: np.random.Generator) -> None:
    episode = make_episode(rng, 300)
    cut = LengthControl("fixed", 150).apply(episode)
    assert (cut.id, cut.name, cut.start_ns, cut.end_ns) == (
        episode.id,
        episode.name,
        episode.start_ns,
        episode.end_ns,
    )
    np.testing.assert_array_equal(cut.action, episode.action[:150])
    assert LengthControl("fixed", 150).apply(cut) is cut


def test_refit_forgets(rng: np.random.Generator) -> None:
    control = LengthControl("shortest-reference")
    assert control.fit([make_episode(rng, 100)]).fit([make_episode(rng, 200)]).steps_ == 200


def test_unfitted_raises(rng: np.random.Generator) -> None:
    with pytest.raises(NotFittedError, match="shortest-reference"):
        LengthControl("shortest-reference").apply(make_episode(rng))
    with pytest.raises(EpisodeError, match="no reference"):
        LengthControl("percentile", 10).fit([])
    with pytest.raises(EpisodeError, match="1 steps"):
        LengthControl("shortest-reference").fit([make_episode(rng, 1)])


@pytest.mark.parametrize(
    ("mode", "value"),
    [
        ("median", None),
        ("none", 3),
        ("shortest-reference", 100),
        ("fixed", None),
        ("fixed", 1),
        ("fixed", 99.5),
        ("fixed", "100"),
        ("fixed", float("nan")),
        ("percentile", None),
        ("percentile", 101),
        ("percentile", True),
        ("phase-normalised", 1),
        ("phase-normalised", 2.5),
    ],
)
def test_bad_configuration_is_refused(mode: str, value: float | None) -> None:
    with pytest.raises(ConfigError, match=mode):
        LengthControl(mode, value)


def test_every_mode_is_described() -> None:
    assert all(text for text in MODES.values())
    assert LengthControl("fixed", 9).describe() == {"mode": "fixed", "value": 9, "steps": 9}
    assert LengthControl("phase-normalised").describe()["steps"] == 50


def test_lengths_of_an_unlabelled_dataset_will_do(rng: np.random.Generator) -> None:
    lengths = [100, 300, 200]
    control = LengthControl("percentile", 50).fit_lengths(lengths)
    assert control.steps_ == 200
    assert LengthControl("percentile", 50).fit_lengths([0, 1, *lengths]).steps_ == 200
    assert LengthControl("fixed", 9).fit_lengths([]).steps_ == 9
    with pytest.raises(EpisodeError, match="none of 2 episodes has 2 steps"):
        LengthControl("percentile", 50).fit_lengths([0, 1])


@given(
    st.lists(st.integers(2, 5000), min_size=1, max_size=20),
    st.floats(0, 100),
    st.randoms(use_true_random=False),
)
def test_percentile_is_a_length_within_and_knows_no_order(
    lengths: list[int], share: float, random: object
) -> None:
    steps = LengthControl("percentile", share).fit_lengths(lengths).steps_
    assert steps is not None
    assert min(lengths) <= steps <= max(lengths)
    shuffled = sorted(lengths, key=lambda _: random.random())  # type: ignore[attr-defined]
    assert LengthControl("percentile", share).fit_lengths(shuffled).steps_ == steps


@given(st.integers(0, 40), st.integers(2, 50))
def test_a_prefix_is_never_longer_never_other_and_cut_once(n: int, n_steps: int) -> None:
    episode = make_episode(n_steps=n)
    control = LengthControl("fixed", n_steps)
    cut = control.apply(episode)
    assert len(cut) == min(n, n_steps)
    for name, values in episode.fields.items():
        np.testing.assert_array_equal(cut.fields[name], values[: len(cut)])
    assert control.apply(cut) is cut
    assert np.isnan(cut.rate_hz) == (len(cut) < 2)


# --- phases -------------------------------------------------------------------------------------


def in_phases(phases: list[int]) -> Episode:
    """An episode with these phases; its twist counts the steps."""
    n = len(phases)
    return with_fields(
        make_episode(n_steps=n, close_at=1),
        phase=np.array(phases, dtype=float)[:, None],
        twist=np.tile(np.arange(n, dtype=float)[:, None], 3),
    )


def test_every_phase_gets_its_steps_by_the_nearest_recorded_one() -> None:
    # Positions in the four steps of phase 0: 0, 1.5, 3; in the two of phase 2: 0, 0.5, 1.
    episode = in_phases([0, 0, 0, 0, 2, 2])
    view = LengthControl("phase-normalised", 3).apply(episode)
    np.testing.assert_array_equal(view.fields["twist"][:, 0], [0, 2, 3, 4, 4, 5])
    np.testing.assert_array_equal(view.fields["phase"][:, 0], [0, 0, 0, 2, 2, 2])
    since_ms = (view.stamps_ns - episode.stamps_ns[0]) / 1e6  # 50 ms a step
    np.testing.assert_array_equal(since_ms, [0, 75, 150, 200, 225, 250])
    assert view.rate_hz == episode.rate_hz == 20.0
    assert (view.id, view.start_ns, view.end_ns) == (episode.id, episode.start_ns, episode.end_ns)


def test_unknown_steps_are_dropped_and_visits_of_a_phase_count_as_one() -> None:
    view = LengthControl("phase-normalised", 2).apply(in_phases([-1, 1, 0, 0, -1, 1, 3]))
    np.testing.assert_array_equal(view.fields["twist"][:, 0], [2, 3, 1, 5, 6, 6])


@given(
    st.lists(st.integers(-1, 5), min_size=2, max_size=60),
    st.integers(2, 12),
)
def test_phase_normalised_views(phases: list[int], n_steps: int) -> None:
    episode, control = in_phases(phases), LengthControl("phase-normalised", n_steps)
    present = {p for p in phases if p >= 0}
    if not present:
        with pytest.raises(EpisodeError, match=r"none of its .* known"):
            control.apply(episode)
        return
    view = control.apply(episode)
    assert len(view) == n_steps * len(present)
    rows = view.fields["twist"][:, 0].astype(int)
    for name, values in episode.fields.items():
        np.testing.assert_array_equal(view.fields[name], values[rows])
    assert (np.diff(view.stamps_ns) > 0).all()
    assert episode.stamps_ns[0] - len(view) < view.stamps_ns[0]
    assert view.stamps_ns[-1] <= episode.stamps_ns[-1]
    again = control.apply(view)
    np.testing.assert_array_equal(again.action, view.action)
    assert again.rate_hz == view.rate_hz == episode.rate_hz


def test_episodes_that_differ_only_in_tempo_look_alike() -> None:
    quick, slow = in_phases([0] * 21 + [1] * 11), in_phases([0] * 41 + [1] * 31)
    control = LengthControl("phase-normalised", 11)
    for phase, length in ((0, (20, 40)), (1, (10, 30))):
        done = []
        for episode, steps in zip((quick, slow), length, strict=True):
            view = control.apply(episode)
            counted = view.fields["twist"][view.fields["phase"][:, 0] == phase, 0]
            done.append((counted - counted[0]) / steps)
        np.testing.assert_allclose(done[0], done[1])


def test_no_phase_in_the_map_is_an_error_with_that_reason() -> None:
    episode = make_episode()
    fields = {k: v for k, v in episode.topic_map.fields.items() if v.role != "phase"}
    bare = replace(episode, topic_map=replace(episode.topic_map, fields=fields))
    with pytest.raises(EpisodeError, match=rf"{episode.id}.*no field with role phase"):
        LengthControl("phase-normalised").apply(bare)
