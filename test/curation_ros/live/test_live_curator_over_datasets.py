"""Rules over the dataset, live: provisional at first, final when asked for."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_reference
from live_takes import (
    SCORERS,
    good_take,
    live_curator,
    only_decision,
    watch,
)
from streams import record, samples_of, started

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection

pytestmark = pytest.mark.slow

# --- rules over the dataset ---------------------------------------------------------------------


def _share(share: float = 0.5) -> Curation:
    options: dict[str, Any] = {"rule_scorer": "length", "rule_params": {"value": share}}
    reference = make_reference(np.random.default_rng(7))
    return Curation.fit(
        CurationSettings(scorers=SCORERS, rule="top-fraction", **options), reference
    )


def _episodes(n: int, first: int = 100) -> list[Episode]:
    """Each is a little shorter than the one before."""
    options = [{"n_steps": 260 - 5 * k, "name": f"pick-{k}"} for k in range(n)]
    return [
        make_episode(
            np.random.default_rng(first + k),
            episode_id=f"00000000-0000-7000-8000-{k:012d}",
            **o,  # type: ignore[arg-type]
        )
        for k, o in enumerate(options)
    ]


def test_rule_over_the_dataset_is_provisional_live_and_says_what_it_has_seen(
    dataset: Dataset,
) -> None:
    live = live_curator(dataset, _share())
    told = [watch(live, e, samples_of(e))[0].decision for e in _episodes(6)]
    assert [d.verdict for d in told[:3]] == ["review"] * 3
    assert told[2].reason == "the rule needs 4 scored episodes; there are 3"
    # Each is better than all before it, so each is among the best half when it comes.
    assert [d.verdict for d in told[3:]] == ["keep"] * 3
    assert [d.evidence["basis"] for d in told] == ["provisional"] * 6
    assert [d.evidence["fitted_on"]["episodes"] for d in told] == [1, 2, 3, 4, 5, 6]
    assert len({d.state_hash for d in told}) == 6
    assert len({d.evidence["scoring"] for d in told}) == 1


def test_curator_that_starts_again_goes_on_with_what_was_scored(dataset: Dataset) -> None:
    episodes = _episodes(5)
    for episode in episodes[:4]:
        watch(live_curator(dataset, _share()), episode, samples_of(episode))
    [decided] = watch(live_curator(dataset, _share()), episodes[4], samples_of(episodes[4]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 5
    other = Curation.fit(
        CurationSettings(scorers=SCORERS, rule="top-fraction")
    )  # has another hash
    [decided] = watch(live_curator(dataset, other), episodes[0], samples_of(episodes[0]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1


def test_final_decisions_are_over_the_whole_dataset_whatever_came_first(dataset: Dataset) -> None:
    live = live_curator(dataset, _share())
    episodes = _episodes(6)
    for episode in episodes:
        watch(live, episode, samples_of(episode))
        record(dataset, episode)
        live.bag_closed(episode.id)
    new = live.finish()
    decided = dataset.latest_decisions()
    assert [decided[e.id].verdict for e in episodes] == ["discard"] * 3 + ["keep"] * 3
    assert {d.evidence["basis"] for d in decided.values()} == {"final"}
    assert {d.evidence["fitted_on"]["episodes"] for d in decided.values()} == {6}
    assert len({d.state_hash for d in decided.values()}) == 1
    assert {d.episode for d in new} == {e.id for e in episodes}
    assert live.finish() == []  # nothing new
    manifest, _ = save_selection(dataset, rule="decisions")
    assert {e.episode for e in manifest.entries} == {e.id for e in episodes[3:]}


def test_episode_whose_bag_has_a_fault_counts_no_more(dataset: Dataset) -> None:
    live = live_curator(dataset, _share())
    first, *rest = _episodes(6)
    samples = samples_of(first)
    [decided] = watch(live, first, samples)
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1
    record(dataset, first, samples=[s for s in samples if not 50 < s.seq < 90])
    assert only_decision(live.bag_closed(first.id)).evidence["fitted_on"]["episodes"] == 0
    [decided] = watch(live, rest[0], samples_of(rest[0]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1


def test_after_a_final_decision_the_next_episode_is_one_more(dataset: Dataset) -> None:
    options: dict[str, Any] = {"rule": "top-fraction", "rule_scorer": "knn_label_free"}
    live = live_curator(
        dataset, Curation.fit(CurationSettings(scorers=("knn_label_free", "length"), **options))
    )
    *episodes, last = _episodes(7)
    for episode in episodes:
        [decided] = watch(live, episode, samples_of(episode))
        assert "compares with the whole dataset" in decided.decision.reason
        record(dataset, episode)
        live.bag_closed(episode.id)
    live.finish()
    [decided] = watch(live, last, samples_of(last))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 7
    assert decided.decision.evidence["basis"] == "provisional"


def test_curator_that_starts_again_leaves_a_final_decision_as_it_is(dataset: Dataset) -> None:
    live = live_curator(dataset, _share())
    episodes = _episodes(6)
    for episode in episodes:
        watch(live, episode, samples_of(episode))
        record(dataset, episode)
        live.bag_closed(episode.id)
    live.finish()
    final = dataset.latest_decisions()
    [told] = live_curator(dataset, _share()).bag_closed(episodes[0].id)
    assert told.decision == final[episodes[0].id]
    assert dataset.latest_decisions() == final


def test_finishing_waits_for_the_running_episode(dataset: Dataset) -> None:
    live = live_curator(dataset, _share())
    live.event(started(good_take()), 0.0)
    with pytest.raises(EpisodeError, match="an episode is running"):
        live.finish()


def test_final_rule_leaves_a_person_s_decision_in_force(dataset: Dataset) -> None:
    live = live_curator(dataset, _share())
    for episode in _episodes(6):
        watch(live, episode, samples_of(episode))
        record(dataset, episode)
    worst = _episodes(1)[0]
    live.override(worst.id, "keep", "the only one from this side", "Ada")
    live.finish()
    assert dataset.latest_decisions()[worst.id].by == "Ada"


def test_rule_on_the_reference_is_final_at_once(dataset: Dataset) -> None:
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), samples_of(good_take()))
    assert decided.decision.evidence["basis"] == "final"
    assert decided.decision.evidence["fitted_on"]["what"] == "reference"
    assert live.finish() == []


def test_copy_that_is_played_live_is_found(dataset: Dataset) -> None:
    live = live_curator(dataset)
    first = _episodes(1)[0]
    watch(live, first, samples_of(first))
    copy = replace(first, id="00000000-0000-7000-8000-00000000ffff", name="copy")
    [decided] = watch(live, copy, samples_of(copy))
    assert decided.decision.verdict == "review"
    assert decided.decision.reason.startswith(f"duplicate: same content as episode {first.id}")
    record(dataset, copy)
    assert live.bag_closed(copy.id) == []  # equal to the bag, copy or not
