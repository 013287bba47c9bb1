"""An examination asks every scorer once, and each episode is watched once."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from episodes import make_episode, make_reference, with_fields

from curation_ros.core.decision.examining import examine
from curation_ros.core.decision.fitted_scorers import fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.evidence.carrying import CarryWatch
from curation_ros.core.scorers import Look, Scorer


def test_examine_asks_every_scorer_once_per_view(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    fitted = fit_scorers(CurationSettings(), make_reference(rng))
    asked: Counter[tuple[str, int]] = Counter()
    for name, scorer in fitted.scorers.items():

        def look(episode: Episode, name: str = name, scorer: Scorer = scorer) -> Look:
            asked[name, len(episode)] += 1
            return type(scorer).look(scorer, episode)

        monkeypatch.setattr(scorer, "look", look)
    whole = make_episode(rng, open_at=140)
    examine(fitted, whole)
    assert {name for name, _ in asked} == set(fitted.scorers)
    assert set(asked.values()) == {1}
    asked.clear()
    n = len(whole)
    spoilt = whole.fields["twist"].copy()
    spoilt[n - 20 :] = np.nan
    fault = Finding("not-finite", "the twist ends in NaN", whole.span(n - 20, n - 1))
    torn = replace(with_fields(whole, twist=spoilt), findings=(fault,))
    part = examine(fitted, torn).part
    assert part is not None
    of_whole_episodes = [k for k, s in fitted.scorers.items() if not s.length_controlled]
    for name in of_whole_episodes:
        assert asked[name, n] == asked[name, n - 20] == 1
    assert sum(asked.values()) == 2 * len(fitted.scorers)


def test_examine_watches_a_carry_once(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    fitted = fit_scorers(CurationSettings(), make_reference(rng))
    taken = []
    take = CarryWatch.take

    def counted(watch: CarryWatch, episode: Episode) -> CarryWatch:
        taken.append(len(episode))
        return take(watch, episode)

    monkeypatch.setattr(CarryWatch, "take", counted)
    episode = make_episode(rng, open_at=140)
    found = examine(fitted, episode)
    assert found.scores["object_coupling"] is not None
    assert taken == [len(episode)]
