"""Poses that show less than they should: what is not known is said, nothing is cut by guess.

Made from the sample bag, with the curation that is used where nobody configures anything.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from decided import decide_on
from episodes import with_fields
from scenes import without
from streams import record, samples_of

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.salvage import DEFAULT_MARGIN_S
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.types import Floats
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

SAMPLE = Path(__file__).resolve().parents[3] / "bags" / "sample"
BOWL_TOPIC = "objects/akita_black_bowl_1/pose"
PERIOD_NS = 50_000_000
#: Steps of the sample: it lifts from 97 to 145, carries to 199, and has let go at 200.
LIFT_AT, OPENED_AT = 97, 140
#: Where the poses go wrong: in LIFT, well before the object is lost.
SPOILT_AT = 120
HELD = "grip_consistency: the fingers held something for as long as something was to be carried"


@pytest.fixture(scope="module")
def good() -> Episode:
    return read_episode(SAMPLE)


@pytest.fixture(scope="module")
def early(good: Episode) -> Episode:
    return _opened(good, OPENED_AT)


@pytest.fixture(scope="module")
def curation() -> Curation:
    return Curation.fit()


def _opened(episode: Episode, at: int) -> Episode:
    """The same, but the gripper opens at a step, and the bowl falls to the table from there."""
    fields = {name: values.copy() for name, values in episode.fields.items()}
    steps = np.arange(len(episode) - at)
    bowl = fields["bowl_position"]
    table_m = bowl[LIFT_AT - 5, 2]
    fallen_m = 0.5 * 9.81 * ((steps + 1) / episode.rate_hz) ** 2
    bowl[at:] = bowl[at - 1]
    bowl[at:, 2] = np.maximum(bowl[at, 2] - fallen_m, table_m)
    bowl[at:, 0] += 1e-6 * (steps % 3)  # the simulator's poses never repeat to the bit
    fields["gripper"][at:] = -1.0
    fields["finger_position"][at + 2 :] = fields["finger_position"][0]
    return replace(episode, fields=fields)


# --- ways in which a pose says nothing ----------------------------------------------------------


def _missing(episode: Episode, at: int = 0) -> Episode:
    bowl = episode.fields["bowl_position"].copy()
    bowl[at:] = np.nan
    return with_fields(episode, bowl_position=bowl)


def _frozen(episode: Episode, at: int = SPOILT_AT) -> Episode:
    bowl = episode.fields["bowl_position"].copy()
    bowl[at:] = bowl[at - 1]
    return with_fields(episode, bowl_position=bowl)


def _jumped(episode: Episode, at: int = SPOILT_AT) -> Episode:
    bowl = episode.fields["bowl_position"].copy()
    bowl[at:, 0] += 0.2
    return with_fields(episode, bowl_position=bowl)


def _swapped(episode: Episode, at: int = SPOILT_AT) -> Episode:
    bowl, plate = episode.fields["bowl_position"], episode.fields["plate_position"]
    before = np.arange(len(episode))[:, None] < at
    return with_fields(
        episode,
        bowl_position=np.where(before, bowl, plate),
        plate_position=np.where(before, plate, bowl),
    )


def _twin(episode: Episode, at: int = 0) -> Episode:
    plate = episode.fields["plate_position"].copy()
    plate[at:] = episode.fields["bowl_position"][at:]
    plate[at:, 0] += 0.001
    return with_fields(episode, plate_position=plate)


Spoil = Callable[..., Episode]
SPOILT: dict[str, tuple[Spoil, str]] = {
    "missing": (_missing, "plate_position was not carried, and bowl_position has no pose"),
    "frozen": (_frozen, "no new pose of bowl_position for 0.5 s from "),
    "jumped": (_jumped, "the pose of bowl_position jumped by 0.20 m"),
    "swapped": (_swapped, "the pose of bowl_position jumped to where plate_position was"),
    "twin": (_twin, "which was grasped cannot be told: "),
}


def _cut_ns(opened_at: int) -> int:
    """Where a beginning ends at the latest: the margin before the command to open."""
    return opened_at * PERIOD_NS - round(DEFAULT_MARGIN_S * 1e9)


# --- what becomes of them -----------------------------------------------------------------------


def test_poses_as_they_are_decide(good: Episode, early: Episode, curation: Curation) -> None:
    kept, cut = decide_on(curation, good), decide_on(curation, early)
    assert (kept.verdict, kept.evidence["decided_by"]) == ("keep", "object_coupling")
    assert (cut.verdict, cut.evidence["decided_by"]) == ("salvage", "object_coupling")
    assert cut.span == (0, _cut_ns(OPENED_AT))


@pytest.mark.parametrize("way", SPOILT)
def test_good_one_is_kept_by_gripper_and_phase_and_the_reason_says_both(
    good: Episode, curation: Curation, way: str
) -> None:
    spoil, why = SPOILT[way]
    decision = decide_on(curation, spoil(good))
    assert decision.verdict == "keep"
    assert decision.reason.startswith(f"{HELD}; object_coupling cannot tell: {why}")


@pytest.mark.parametrize("way", SPOILT)
def test_early_one_is_cut_by_the_gripper_and_the_reason_says_both(
    early: Episode, curation: Curation, way: str
) -> None:
    spoil, why = SPOILT[way]
    decision = decide_on(curation, spoil(early))
    assert decision.verdict == "salvage"
    assert decision.evidence["decided_by"] in ("grip_consistency", "phase_events")
    assert f"; object_coupling cannot tell: {why}" in decision.reason
    assert decision.span == (0, _cut_ns(OPENED_AT))


@pytest.mark.parametrize("way", SPOILT)
def test_without_gripper_and_phase_a_person_is_asked(
    early: Episode, curation: Curation, way: str
) -> None:
    spoil, _ = SPOILT[way]
    decision = decide_on(curation, without(spoil(early), "gripper", "phase"))
    assert decision.verdict == "review"
    assert decision.reason.startswith("object_coupling cannot tell: ")
    assert decision.reason.endswith("; no reference")
    for scorer in ("grip_consistency", "phase_events"):
        assert f"{scorer} cannot tell: " in decision.reason
    assert "salvage" not in decision.evidence


def test_object_that_nobody_publishes_is_for_review(good: Episode, curation: Curation) -> None:
    other = BOWL_TOPIC.replace("bowl_1", "bowl_2")
    text = json.dumps(good.topic_map.to_json()).replace(BOWL_TOPIC, other)
    episode = read_episode(SAMPLE, topic_map_from_json(json.loads(text)))
    decision = decide_on(curation, episode)
    assert decision.verdict == "review"
    assert decision.reason == f"missing-topic: topic {other!r} has no sample in the episode"
    assert decision.abstained["object_coupling"].endswith("bowl_position has no pose")


def test_early_one_whose_object_nobody_published_is_not_cut(
    early: Episode, curation: Curation, dataset: Dataset
) -> None:
    others = [s for s in samples_of(early) if s.topic != BOWL_TOPIC]
    decision = decide_on(curation, read_episode(record(dataset, early, samples=others)))
    assert decision.verdict == "review"
    assert decision.reason.startswith(f"missing-topic: topic {BOWL_TOPIC!r} has no sample")
    assert "salvage" not in decision.evidence


def test_episode_that_ends_in_mid_lift_is_for_review(good: Episode, curation: Curation) -> None:
    decision = decide_on(curation, good.steps(SPOILT_AT))
    assert decision.verdict == "review"
    assert decision.reason.endswith("; no reference")
    for said in (
        "object_coupling cannot tell: it ends in LIFT, bowl_position still held",
        "grip_consistency cannot tell: it ends in LIFT",
        "phase_events cannot tell: it ends in LIFT",
    ):
        assert said in decision.reason


def test_what_broke_before_an_episode_ends_in_mid_lift_is_known(
    early: Episode, curation: Curation
) -> None:
    decision = decide_on(curation, early.steps(OPENED_AT + 5))
    assert (decision.verdict, decision.span) == ("salvage", (0, _cut_ns(OPENED_AT)))
    assert decision.evidence["decided_by"] == "object_coupling"


# --- one object after the other -----------------------------------------------------------------

WAY = 60


def _in_turn(first: Episode, second: Episode) -> Episode:
    """The bowl, then on to the plate 30 cm beside, which is taken as the second takes its bowl."""
    aside = np.array([0.3, 0.0, 0.0])
    moved = dict(second.fields)
    moved["eef_position"] = moved["eef_position"] + aside
    taken = moved["bowl_position"] + aside

    def joined(before: Floats, after: Floats) -> Floats:
        share = np.linspace(0.0, 1.0, WAY + 2)[1:-1, None]
        between = (1.0 - share) * before[-1] + share * after[0]
        return np.concatenate([before, between, after])

    fields = {name: joined(values, moved[name]) for name, values in first.fields.items()}
    n = len(first) + WAY
    tremor = np.zeros((len(taken) + n, 3))
    tremor[:, 0] = 1e-6 * (np.arange(len(tremor)) % 3)
    fields["phase"][len(first) : n] = 0.0
    fields["gripper"][len(first) : n] = -1.0
    bowl = first.fields["bowl_position"]
    fields["bowl_position"] = np.concatenate([bowl, np.tile(bowl[-1], (WAY + len(taken), 1))])
    fields["plate_position"] = np.concatenate([np.tile(taken[0], (n, 1)), taken])
    stamps_ns = first.start_ns + PERIOD_NS * np.arange(len(tremor), dtype=np.int64)
    return replace(
        first,
        stamps_ns=stamps_ns,
        end_ns=int(stamps_ns[-1]),
        fields={
            name: values + tremor if name in ("bowl_position", "plate_position") else values
            for name, values in fields.items()
        },
    )


def _second(episode: Episode, at: int) -> int:
    """A step of the second of two, in the whole."""
    return len(episode) + WAY + at


def test_two_objects_carried_in_turn_are_kept(good: Episode, curation: Curation) -> None:
    decision = decide_on(curation, _in_turn(good, good))
    assert (decision.verdict, decision.evidence["decided_by"]) == ("keep", "object_coupling")


def test_first_of_two_that_is_lost_ends_what_is_kept(
    good: Episode, early: Episode, curation: Curation
) -> None:
    decision = decide_on(curation, _in_turn(early, good))
    assert decision.reason.startswith("bowl_position left the effector")
    assert (decision.verdict, decision.span) == ("salvage", (0, _cut_ns(OPENED_AT)))


def test_second_of_two_that_is_lost_leaves_the_first(
    good: Episode, early: Episode, curation: Curation
) -> None:
    decision = decide_on(curation, _in_turn(good, early))
    assert decision.reason.startswith("plate_position left the effector")
    opened_at = _second(good, OPENED_AT)
    assert (decision.verdict, decision.span) == ("salvage", (0, _cut_ns(opened_at)))


def test_second_of_two_whose_pose_freezes_is_judged_by_the_gripper(
    good: Episode, early: Episode, curation: Curation
) -> None:
    both = _in_turn(good, early)
    plate = both.fields["plate_position"].copy()
    at = _second(good, SPOILT_AT)
    plate[at:] = plate[at - 1]
    decision = decide_on(curation, with_fields(both, plate_position=plate))
    assert decision.evidence["decided_by"] in ("grip_consistency", "phase_events")
    assert "object_coupling cannot tell: no new pose of plate_position" in decision.reason
    assert decision.verdict == "salvage"
    assert decision.span == (0, _cut_ns(_second(good, OPENED_AT)))


# --- wherever it goes wrong ---------------------------------------------------------------------


@pytest.mark.parametrize("at", [85, 100, 118, 135, 160, 185, 198])
def test_good_one_is_never_cut_wherever_its_poses_go_wrong(
    good: Episode, curation: Curation, at: int
) -> None:
    for way, (spoil, _) in SPOILT.items():
        decision: Decision = decide_on(curation, spoil(good, at))
        assert decision.verdict != "salvage", (way, decision.reason)


@pytest.mark.parametrize("at", [85, 100, 118, 135, 150])
def test_early_one_is_never_cut_but_by_its_command_to_open(
    early: Episode, curation: Curation, at: int
) -> None:
    for way, (spoil, _) in SPOILT.items():
        decision = decide_on(curation, spoil(early, at))
        assert decision.verdict != "keep", (way, decision.reason)
        if decision.verdict == "salvage":
            assert decision.span == (0, _cut_ns(OPENED_AT)), (way, decision.reason)
