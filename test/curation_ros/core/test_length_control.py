"""Length control: modes, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from episodes import make_episode

from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.length_control import MODES, LengthControl


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
    ],
)
def test_bad_configuration_is_refused(mode: str, value: float | None) -> None:
    with pytest.raises(ConfigError, match=mode):
        LengthControl(mode, value)


def test_every_mode_is_described() -> None:
    assert all(text for text in MODES.values())
    assert LengthControl("fixed", 9).describe() == {"mode": "fixed", "value": 9, "steps": 9}
