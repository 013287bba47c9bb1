"""What a baseline learns from trusted episodes."""

from __future__ import annotations

import numpy as np
import pytest
from checking import (
    ids_of,
    restamped,
)
from episodes import (
    TASK_STEPS,
    make_episode,
    make_reference,
)

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode

PERIOD_S = 0.05


def test_baseline_is_plain_numbers_in_any_order(rng: np.random.Generator) -> None:
    reference = make_reference(rng, 6)
    fitted = Baseline().fit(reference).fitted()
    assert fitted == Baseline().fit(reversed(reference)).fitted()
    assert fitted["n_"] == 6
    np.testing.assert_allclose(fitted["rate_hz_"], (20.0, 20.0))
    assert fitted["duration_s_"] == pytest.approx((TASK_STEPS - 7) * PERIOD_S)
    assert (fitted["first_phase_"], fitted["last_phase_"], fitted["open_phase_"]) == (0, 5, 5)
    assert (fitted["starts_open_"], fitted["closes_"], fitted["opens_"]) == (1, 1, 1)
    assert fitted["still_s_"] == {"eef_pose": 0.0, "joint_states": 0.0}
    assert fitted["held_s_"] == pytest.approx(min(first_opening_s(e) for e in reference), abs=1e-9)
    plain = (int, float, tuple, dict)
    assert all(isinstance(v, plain) for v in fitted.values())


def first_opening_s(episode: Episode) -> float:
    command = episode.fields["gripper"][:, 0]
    closed = np.flatnonzero(command > 0)
    return float(closed[-1] + 1 - closed[0]) * PERIOD_S


def test_baseline_of_nothing_judges_as_none_does() -> None:
    nothing = Baseline().fit([])
    for options in ({}, {"open_at": 140}, {"open_at": None}, {"close_at": None}):
        episode = make_episode(**options)
        assert check_episode(episode, nothing) == check_episode(episode)


def test_second_fit_forgets_the_first(rng: np.random.Generator) -> None:
    reference = make_reference(rng, 6)
    again = Baseline().fit(reference).fit(reference[:3])
    assert again.fitted() == Baseline().fit(reference[:3]).fitted()


def test_spread_of_too_few_references_is_not_judged(rng: np.random.Generator) -> None:
    slow = restamped(make_episode(rng), np.full(TASK_STEPS - 1, 0.1))
    assert ids_of(slow, Baseline().fit(make_reference(rng, 2))) == []
    assert ids_of(slow, Baseline().fit(make_reference(rng, 3))) == ["rate"]


def test_too_short_reference_is_refused_by_name(rng: np.random.Generator) -> None:
    short = make_episode(rng, 4, close_at=1)
    with pytest.raises(EpisodeError, match=f"{short.id}: 4 steps"):
        Baseline().fit([make_episode(rng), short])
