"""What is added to a decision log: nothing twice, and no number of anybody else."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from streams import record, short_episode

from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.errors import EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_decision, log_override

N_STEPS = 100
EPISODE = short_episode(np.random.default_rng(3), N_STEPS, name="good")
WHOLE = (0, EPISODE.end_ns - EPISODE.start_ns)
KEPT = Decision(EPISODE.id, "good", "keep", "r", WHOLE, {"knn": 1.0}, evidence={"basis": "final"})


@pytest.fixture
def recorded(dataset: Dataset) -> Dataset:
    record(dataset, EPISODE)
    return dataset


# --- the curator's ------------------------------------------------------------------------------


def test_first_decision_is_new_and_in_force(dataset: Dataset) -> None:
    logged = log_decision(dataset, KEPT)
    assert (logged.in_force, logged.previous, logged.is_new) == (KEPT, None, True)
    assert dataset.decisions(EPISODE.id) == [KEPT]


def test_repeated_decision_is_logged_once_and_its_evidence_is_added(dataset: Dataset) -> None:
    log_decision(dataset, KEPT)
    again = log_decision(dataset, KEPT)
    assert (again.in_force, again.previous, again.is_new) == (KEPT, KEPT, False)
    other = replace(KEPT, verdict="review", reason="another")
    changed = log_decision(dataset, other)
    assert (changed.in_force.revision, changed.previous, changed.is_new) == (2, KEPT, True)
    amended = log_decision(dataset, replace(other, evidence={"bag": "alone"}))
    assert (amended.in_force.evidence, amended.is_new) == ({"bag": "alone"}, True)
    assert [d.revision for d in dataset.decisions(EPISODE.id)] == [1, 2, 2]


def test_decision_that_several_make_at_once_is_logged_once(dataset: Dataset) -> None:
    with ThreadPoolExecutor(8) as pool:
        logged = list(pool.map(lambda _: log_decision(dataset, KEPT), range(16)))
    assert dataset.decisions(EPISODE.id) == [KEPT]
    assert [one.in_force for one in logged] == [KEPT] * 16
    assert sum(one.is_new for one in logged) == 1


def test_evidence_added_after_a_person_decided_takes_nobodys_number(recorded: Dataset) -> None:
    log_decision(recorded, KEPT)
    person = log_override(recorded, "good", "discard", "", "Ada")
    logged = log_decision(recorded, replace(KEPT, evidence={"bag": "alone"}))
    assert (logged.in_force, logged.previous, logged.is_new) == (person, person, True)
    assert recorded.latest_decisions()[EPISODE.id] == person
    assert {d.revision: d.by for d in recorded.decisions(EPISODE.id)} == {1: CURATOR, 2: "Ada"}


# --- a person's ---------------------------------------------------------------------------------


def test_person_may_decide_on_a_bag_that_was_never_scored(recorded: Dataset) -> None:
    decision = log_override(recorded, "good", "keep", "I saw it", "Ada", state_hash="f00")
    assert (decision.revision, decision.by, decision.scores) == (1, "Ada", {})
    assert (decision.reason, decision.span) == ("Ada: I saw it", WHOLE)
    assert decision.state_hash == "f00"
    logged = log_decision(recorded, KEPT)
    assert (logged.in_force, logged.is_new) == (decision, True)


def test_person_salvages_the_beginning_of_what_the_curator_kept(recorded: Dataset) -> None:
    log_decision(recorded, KEPT)
    cut = log_override(recorded, "good", "salvage", "it shook", "Ada", until_s=2.15)
    assert (cut.verdict, cut.by, cut.span) == ("salvage", "Ada", (0, 2_150_000_000))
    assert cut.reason == f"Ada: it shook; kept until 2.15 s of {WHOLE[1] / 1e9:.2f} s"
    # A later cut may reach further than an earlier one, and to keep is to keep all of it.
    later = log_override(recorded, "good", "salvage", "", "Ada", until_s=3.0)
    assert (later.span, later.reason[:11]) == ((0, 3_000_000_000), "Ada decided")
    assert log_override(recorded, "good", "keep", "", "Ada").span == WHOLE
    assert len(recorded.decisions(EPISODE.id)) == 4


@pytest.mark.parametrize("until_s", [0.5, 5.0, float("nan"), float("inf")])
def test_part_that_is_too_short_or_the_whole_is_refused(recorded: Dataset, until_s: float) -> None:
    with pytest.raises(EpisodeError, match=r"expected from 1 s to less than 4\.96 s"):
        log_override(recorded, "good", "salvage", "", "Ada", until_s=until_s)


@pytest.mark.parametrize(
    ("prefix", "verdict", "by", "until_s", "said"),
    [
        ("nobody", "keep", "Ada", None, "no episode has the id or name 'nobody'"),
        ("", "keep", "Ada", None, "no episode has the id or name ''"),
        ("good", "salvage", "Ada", None, "name its end"),
        ("good", "keep", "Ada", 2.0, "belongs to salvage"),
        ("good", "", "Ada", None, "expected keep, salvage, review, discard"),
        ("good", "keep", "curator", None, "expected the name of a person"),
        ("good", "keep", "", None, "expected the name of a person"),
    ],
)
def test_override_that_makes_no_sense_is_refused_and_not_logged(
    recorded: Dataset, prefix: str, verdict: str, by: str, until_s: float | None, said: str
) -> None:
    with pytest.raises(EpisodeError, match=said):
        log_override(recorded, prefix, verdict, "", by, until_s=until_s)
    assert recorded.decisions(EPISODE.id) == []
