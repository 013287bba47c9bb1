"""What is left of a recording that is bad at an end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from decided import decide_on
from episodes import make_episode, make_reference, with_fields

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.salvage import sound_part
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding

NOT_FINITE = Finding("not-finite", "NaN", (0, 0))


def spoilt(steps: slice) -> Episode:
    episode = make_episode()
    eef = episode.field("eef_position").copy()
    eef[steps] = np.nan
    return with_fields(episode, eef_position=eef)


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        (slice(230, None), (0, 229)),
        (slice(0, 5), (5, 239)),
        (slice(100, 101), None),
        (slice(100, None), None),
        (slice(0, 0), None),
    ],
)
def test_spoilt_ends_are_cut_off(steps: slice, expected: tuple[int, int] | None) -> None:
    assert sound_part(spoilt(steps), [NOT_FINITE]) == expected


def test_other_faults_are_for_a_person() -> None:
    gap = Finding("gap", "silent", (0, 5))
    assert sound_part(spoilt(slice(230, None)), [NOT_FINITE, gap]) is None
    assert sound_part(spoilt(slice(230, None)), []) is None


def test_padding_is_what_the_finding_says() -> None:
    episode = make_episode()
    span = episode.span(200, 239)
    assert sound_part(episode, [Finding("padded-tail", "repeats", span)]) == (0, 199)


def test_curation_salvages_the_sound_part_of_a_good_demonstration(
    rng: np.random.Generator,
) -> None:
    curation = Curation.fit(reference=make_reference(rng))
    episode = make_episode(rng, 250, task_steps=240)
    eef = episode.field("eef_position").copy()
    eef[245:] = np.nan
    fault = Finding("not-finite", "5 samples", (1, 1))
    bad = replace(with_fields(episode, eef_position=eef), findings=(fault,))
    decision = decide_on(curation, bad)
    assert (decision.verdict, decision.span) == ("salvage", bad.span(0, 244)), decision.reason
    assert "without not-finite" in decision.reason
