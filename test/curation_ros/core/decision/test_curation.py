"""The curation as a whole: early release found and explained, hashes, refusals, no reference."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from decided import decide_on
from episodes import copied, make_episode, make_reference, shifted

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.rules import RULES
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_reference(rng)


@pytest.fixture
def curation(reference: list[Episode]) -> Curation:
    return Curation.fit(reference=reference)


# --- decisions ----------------------------------------------------------------------------------


def test_early_release_is_discarded_with_time_and_phase(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    early = make_episode(rng, 500, task_steps=240, open_at=140)
    decision = decide_on(Curation.fit(CurationSettings(rule="threshold"), reference), early)
    assert decision.verdict == "discard"
    assert decision.reason == (
        "the gripper opened at 7.0 s, in LIFT; clean demonstrations open at 11.6 s or later"
    )
    offset = int(early.stamps_ns[140]) - early.start_ns
    assert decision.evidence["seen"]["gripper_timing"] == {
        "span": [offset, offset],
        "phase": "LIFT",
    }
    assert decision.scores["gripper_timing"] == 140 / 234


@pytest.mark.parametrize("n_steps", [225, 234, 240, 255])
@pytest.mark.parametrize("rule", ["threshold", "evidence"])
def test_good_episodes_of_other_lengths_are_kept(
    reference: list[Episode], rng: np.random.Generator, n_steps: int, rule: str
) -> None:
    decision = decide_on(
        Curation.fit(CurationSettings(rule=rule), reference), make_episode(rng, n_steps)
    )
    assert decision.verdict == "keep", decision.reason
    assert ("fitted on 6 references" in decision.reason) == (rule == "threshold")


def test_references_themselves_are_kept(curation: Curation, reference: list[Episode]) -> None:
    assert {decide_on(curation, e).verdict for e in reference} == {"keep"}


@pytest.mark.parametrize("rule_scorer", DEFAULT_SCORERS)
def test_any_scorer_may_decide(
    rule_scorer: str, reference: list[Episode], rng: np.random.Generator
) -> None:
    curation = Curation.fit(CurationSettings(rule="threshold", rule_scorer=rule_scorer), reference)
    decision = decide_on(curation, make_episode(rng))
    assert decision.verdict in ("keep", "discard")
    assert np.isfinite(decision.evidence["threshold"])
    assert Decision.from_json(json.loads(json.dumps(decision.to_json()))) == decision


def test_no_reference_leaves_everything_for_review(rng: np.random.Generator) -> None:
    curation = Curation.fit(CurationSettings(rule="threshold"))
    decision = decide_on(curation, make_episode(rng, open_at=140))
    assert (decision.verdict, decision.reason) == ("review", "no reference")
    needing = {k for k in DEFAULT_SCORERS if SCORERS[k].needs == "reference"}
    assert {k for k, v in decision.abstained.items() if v == "no reference"} == needing
    assert decision.scores["gripper_timing"] == 140 / 240
    assert decision.evidence["length_steps"] is None


def test_given_threshold_decides_without_reference(rng: np.random.Generator) -> None:
    curation = Curation.fit(CurationSettings(rule="threshold", rule_params={"threshold": 0.9}))
    assert decide_on(curation, make_episode(rng, open_at=140)).verdict == "discard"
    assert decide_on(curation, make_episode(rng)).verdict == "keep"


def test_rule_none_is_review(reference: list[Episode], rng: np.random.Generator) -> None:
    assert (
        decide_on(
            Curation.fit(CurationSettings(rule="none"), reference), make_episode(rng)
        ).verdict
        == "review"
    )


def test_inverted_gripper_is_review_with_the_sign(
    curation: Curation, rng: np.random.Generator
) -> None:
    decision = decide_on(curation, make_episode(rng, opens=1))
    assert decision.verdict == "review"
    assert "looks inverted" in decision.reason
    assert [f.id for f in decision.findings] == ["gripper-meaning"]
    assert "gripper_timing" in decision.abstained
    assert decision.scores["length"] == -240


@pytest.mark.parametrize("bad", ["gap", "aborted"])
def test_faulty_recording_is_review_whatever_it_scores(
    curation: Curation, rng: np.random.Generator, bad: str
) -> None:
    finding = Finding(bad, "what was found", (0, 9))
    decision = decide_on(curation, make_episode(rng, findings=[finding]))
    assert (decision.verdict, decision.reason) == ("review", f"{bad}: what was found")


def test_degenerate_episodes_are_review_and_never_raise(curation: Curation) -> None:
    for episode in (make_episode(n_steps=0), make_episode(n_steps=1), make_episode(n_steps=2)):
        decision = decide_on(curation, episode)
        assert decision.verdict == "review"
        assert set(decision.scores) == set(DEFAULT_SCORERS)
        assert all((v is None) == (k in decision.abstained) for k, v in decision.scores.items())


def test_decision_ignores_where_in_time_the_episode_lies(
    curation: Curation, rng: np.random.Generator
) -> None:
    episode = make_episode(rng, open_at=140)
    assert decide_on(curation, shifted(episode, 10**15)) == decide_on(curation, copied(episode))


# --- the default: the first evidence that can tell ----------------------------------------------

OBJECTS = ("bowl_position", "plate_position")


def without(episode: Episode, *fields: str) -> Episode:
    """The same episode of a graph that has none of these."""
    kept = {k: v for k, v in episode.topic_map.fields.items() if k not in fields}
    gripper = episode.topic_map.gripper
    if gripper is not None and gripper.fingers in fields:
        gripper = replace(gripper, fingers="")
    state = tuple(part for part in episode.topic_map.state if part.split("[")[0] not in fields)
    topic_map = replace(episode.topic_map, fields=kept, state=state, gripper=gripper)
    values = {k: v for k, v in episode.fields.items() if k not in fields}
    return replace(episode, topic_map=topic_map, fields=values)


def test_drop_is_salvaged_up_to_a_margin_before_the_command_to_open(
    rng: np.random.Generator,
) -> None:
    early = make_episode(rng, 500, task_steps=240, open_at=140)
    decision = decide_on(Curation.fit(), early)
    last = int(early.stamps_ns[140 - 15]) - early.start_ns
    assert decision.verdict == "salvage"
    assert decision.span == (int(early.stamps_ns[0]) - early.start_ns, last)
    assert decision.evidence["decided_by"] == "object_coupling"
    assert decision.evidence["salvage"] == {
        "scorer": "object_coupling",
        "broke_ns": int(early.stamps_ns[140]) - early.start_ns,
        "margin_s": 0.75,
    }
    assert decision.reason.endswith("; kept until 6.26 s")
    assert Decision.from_json(json.loads(json.dumps(decision.to_json()))) == decision


@pytest.mark.parametrize(("margin_s", "last"), [(0.0, 139), (0.5, 130), (0.51, 129), (1.5, 110)])
def test_margin_is_kept_to_the_step(rng: np.random.Generator, margin_s: float, last: int) -> None:
    early = make_episode(rng, open_at=140)
    decision = decide_on(Curation.fit(CurationSettings(salvage_margin_s=margin_s)), early)
    assert decision.span[1] == int(early.stamps_ns[last]) - early.start_ns


def test_without_a_margin_or_a_beginning_it_is_discarded(rng: np.random.Generator) -> None:
    early = make_episode(rng, open_at=140)
    whole = (0, early.end_ns - early.start_ns)
    never = decide_on(Curation.fit(CurationSettings(salvage_margin_s=None)), early)
    assert (never.verdict, never.span) == ("discard", whole)
    assert "salvage" not in never.evidence
    nothing = decide_on(Curation.fit(CurationSettings(salvage_margin_s=6.5)), early)
    assert (nothing.verdict, nothing.span) == ("discard", whole)
    assert nothing.reason.endswith("; too little was good before that")


@pytest.mark.parametrize(
    ("missing", "decides"),
    [
        ((), "object_coupling"),
        (OBJECTS, "grip_consistency"),
        ((*OBJECTS, "finger_position"), "phase_events"),
        ((*OBJECTS, "finger_position", "phase"), "gripper_timing"),
        (("phase",), "gripper_timing"),
    ],
)
def test_weaker_evidence_decides_where_the_stronger_is_missing(
    reference: list[Episode],
    rng: np.random.Generator,
    missing: tuple[str, ...],
    decides: str,
) -> None:
    good, early = make_episode(rng), make_episode(rng, open_at=140)
    curation = Curation.fit(reference=[without(e, *missing) for e in reference])
    kept, dropped = (decide_on(curation, without(e, *missing)) for e in (good, early))
    assert kept.verdict == "keep"
    assert dropped.verdict == ("discard" if decides == "gripper_timing" else "salvage")
    assert {kept.evidence["decided_by"], dropped.evidence["decided_by"]} == {decides}
    assert ("threshold" in kept.evidence) == (decides == "gripper_timing")
    silent = [n for n in RULES["evidence"].consults if n in kept.abstained]
    for name in silent if decides == "gripper_timing" else []:
        assert f"{name} cannot tell: {kept.abstained[name]}" in kept.reason
    assert ("object_coupling cannot tell" in kept.reason) == (decides != "object_coupling")


def test_nothing_to_go_by_is_review(rng: np.random.Generator) -> None:
    blind = without(make_episode(rng), *OBJECTS, "finger_position", "phase")
    decision = decide_on(Curation.fit(), blind)
    assert decision.verdict == "review"
    assert decision.reason.startswith("object_coupling cannot tell: the topic map declares no")
    assert decision.reason.endswith("; no reference")


def test_law_that_most_of_the_reference_breaks_is_none(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    """A graph on which the object's pose means something else, say the frame of its shelf."""

    def shelved(episode: Episode) -> Episode:
        still = np.tile(episode.fields["bowl_position"][:1], (len(episode), 1))
        still[:, 0] += 1e-4 * np.sin(np.arange(len(episode)))  # it is seen, and lies there
        return replace(episode, fields={**episode.fields, "bowl_position": still})

    for params in ({}, {"threshold": 0.5}):
        curation = Curation.fit(
            CurationSettings(rule_params=params), [shelved(e) for e in reference]
        )
        decision = decide_on(curation, shelved(make_episode(rng)))
        decided_by = decision.evidence["decided_by"]
        assert (decision.verdict, decided_by) == ("keep", "grip_consistency")
    assert decision.reason.endswith(
        "; object_coupling is no law here: most of the reference breaks it"
    )
    one_bad = [shelved(reference[0]), *reference[1:]]
    kept = decide_on(Curation.fit(reference=one_bad), make_episode(rng))
    assert kept.evidence["decided_by"] == "object_coupling"
    doubted = decide_on(Curation.fit(), shelved(make_episode(rng)))
    assert doubted.verdict == "review"
    assert "; but grip_consistency: the fingers held" in doubted.reason
    unseen = decide_on(Curation.fit(), without(shelved(make_episode(rng)), "finger_position"))
    assert unseen.verdict == "discard"


def test_hold_whose_end_has_no_known_phase_is_not_known(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    phase = episode.fields["phase"].copy()
    phase[130:] = np.nan
    cut = replace(episode, fields={**episode.fields, "phase": phase})
    decision = decide_on(Curation.fit(), cut)
    assert decision.verdict == "review"
    assert {"object_coupling", "grip_consistency", "phase_events"} <= set(decision.abstained)


def test_one_that_saw_it_break_outweighs_one_of_its_kind_that_did_not(
    rng: np.random.Generator,
) -> None:
    early = make_episode(rng, open_at=140)
    stuck = early.fields["finger_position"].copy()
    stuck[120:] = stuck[120]  # the fingers' topic repeats itself: they seem to hold on
    frozen = replace(early, fields={**early.fields, "finger_position": stuck})
    decision = decide_on(Curation.fit(), without(frozen, *OBJECTS))
    assert decision.evidence["decided_by"] == "phase_events"
    assert decision.verdict == "salvage"


# --- state hash ---------------------------------------------------------------------------------


def test_hash_and_scores_do_not_depend_on_the_order_of_the_reference(
    curation: Curation, reference: list[Episode], rng: np.random.Generator
) -> None:
    other = Curation.fit(reference=reference[::-1])
    assert other.rule.state_hash == curation.rule.state_hash
    episode = make_episode(rng)
    assert decide_on(other, episode) == decide_on(curation, episode)


def test_hash_survives_scoring(curation: Curation, reference: list[Episode]) -> None:
    before = curation.rule.state_hash
    decide_on(curation, reference[0])
    assert curation.rule.state_hash == before
    assert Curation.fit(reference=reference[:4]).rule.state_hash != before


def test_hash_is_the_one_that_decisions_have() -> None:
    # Of commit d434e8b: the defaults without a reference.
    assert Curation.fit().rule.state_hash == (
        "52d12ceb4be8bfe21c0ec32e0c191c36e308f78e5de1c70b99c6b309ac10ecf4"
    )


def test_hash_sees_configuration_ids_and_values(
    curation: Curation, reference: list[Episode]
) -> None:
    renamed = [replace(reference[0], id="0" * 8), *reference[1:]]
    touched = copied(reference[0])
    touched.fields["eef_position"][5, 0] += 1e-9
    hashes = {
        curation.rule.state_hash,
        Curation.fit().rule.state_hash,
        Curation.fit(reference=renamed).rule.state_hash,
        Curation.fit(reference=[touched, *reference[1:]]).rule.state_hash,
        Curation.fit(CurationSettings(rule="none"), reference).rule.state_hash,
        Curation.fit(
            CurationSettings(rule_params={"false_alarm": 0.02}), reference
        ).rule.state_hash,
        Curation.fit(CurationSettings(length="none"), reference).rule.state_hash,
        Curation.fit(CurationSettings(scorer_params={"knn": {"k": 3}}), reference).rule.state_hash,
        Curation.fit(CurationSettings(scorers=["gripper_timing"]), reference).rule.state_hash,
    }
    assert len(hashes) == 9


def test_hash_is_stable_across_processes(curation: Curation) -> None:
    code = (
        "import numpy as np; from episodes import make_reference;"
        "from curation_ros.core.decision.curation import Curation;"
        "r = make_reference(np.random.default_rng(20260608));"
        "print(Curation.fit(reference=r[::-1]).rule.state_hash)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": f"{ROOT}:{Path(__file__).parents[1]}", "PYTHONHASHSEED": "7"},
    )
    assert done.stdout.strip() == curation.rule.state_hash


# --- refusals -----------------------------------------------------------------------------------


def test_reference_that_shows_no_gripper_leaves_the_stronger_evidence(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    """A robot with a suction cup: no threshold on gripper timing, and none is needed."""

    def cup(episode: Episode) -> Episode:
        bare = without(episode, "gripper", "finger_position")
        return replace(bare, topic_map=replace(bare.topic_map, gripper=None, action=("twist",)))

    trusted = [cup(e) for e in reference]
    curation = Curation.fit(reference=trusted)
    kept = decide_on(curation, cup(make_episode(rng)))
    assert (kept.verdict, kept.evidence["decided_by"]) == ("keep", "object_coupling")
    blind = without(cup(make_episode(rng)), *OBJECTS)
    told = decide_on(curation, blind)
    assert told.verdict == "review"
    assert "gripper_timing cannot score it: the topic map declares no gripper" in told.reason
    with pytest.raises(EpisodeError, match="gripper_timing cannot score it"):
        Curation.fit(CurationSettings(rule="threshold"), trusted)


def test_describe_says_what_scores_what_it_needs_and_the_threshold(
    reference: list[Episode],
) -> None:
    text = Curation.fit(reference=reference[:3]).describe()
    for name in DEFAULT_SCORERS:
        assert f"scorer {name}: needs {SCORERS[name].needs}" in text
    assert "shortest-reference, 234 steps" in text
    assert "only 3 reference episodes" in text
    assert "keep where gripper_timing >= 0.937" in text
    assert "review: no reference" in Curation.fit().describe()
