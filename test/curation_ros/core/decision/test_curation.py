"""The curation as a whole: early release found and explained, hashes, refusals, no reference."""

from __future__ import annotations

import json
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from episodes import copied, make_episode, make_reference, shifted, with_fields

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.rules import RULES
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError
from curation_ros.core.evidence.carrying import CarryWatch
from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS, Look, Scorer

ROOT = Path(__file__).resolve().parents[4]


@pytest.fixture
def reference(rng: np.random.Generator) -> list[Episode]:
    return make_reference(rng)


@pytest.fixture
def curation(reference: list[Episode]) -> Curation:
    return Curation().fit(reference)


# --- decisions ----------------------------------------------------------------------------------


def test_early_release_is_discarded_with_time_and_phase(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    early = make_episode(rng, 500, task_steps=240, open_at=140)
    decision = Curation(rule="threshold").fit(reference).decide(early)
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
    decision = Curation(rule=rule).fit(reference).decide(make_episode(rng, n_steps))
    assert decision.verdict == "keep", decision.reason
    assert ("fitted on 6 references" in decision.reason) == (rule == "threshold")


def test_references_themselves_are_kept(curation: Curation, reference: list[Episode]) -> None:
    assert {curation.decide(e).verdict for e in reference} == {"keep"}


@pytest.mark.parametrize("rule_scorer", DEFAULT_SCORERS)
def test_any_scorer_may_decide(
    rule_scorer: str, reference: list[Episode], rng: np.random.Generator
) -> None:
    curation = Curation(rule="threshold", rule_scorer=rule_scorer).fit(reference)
    decision = curation.decide(make_episode(rng))
    assert decision.verdict in ("keep", "discard")
    assert np.isfinite(decision.evidence["threshold"])
    json.dumps(decision.to_json(), allow_nan=False)
    assert Decision.from_line(decision.to_line()) == decision


@pytest.mark.parametrize("rule_scorer", ["knn", "trajectory_alignment"])
def test_reference_is_scored_by_scorers_that_had_not_seen_it(
    rule_scorer: str, reference: list[Episode]
) -> None:
    curation = Curation(rule_scorer=rule_scorer).fit(reference)
    seen = [curation.score(e)[0][rule_scorer] for e in reference]
    rule = curation.ruling_.rule
    assert rule is not None
    assert rule.fitted()["low_"] < min(s for s in seen if s is not None)


def test_length_is_scored_whole_and_the_others_truncated(
    curation: Curation, rng: np.random.Generator
) -> None:
    long = make_episode(rng, 500, task_steps=240)
    scores, abstained = curation.score(long)
    cut, _ = curation.score(long.steps(234))
    assert scores["length"] == -500
    truncated = [k for k in scores if SCORERS[k].length_controlled]
    assert {k: scores[k] for k in truncated} == {k: cut[k] for k in truncated}
    assert abstained == {}


def test_no_reference_leaves_everything_for_review(rng: np.random.Generator) -> None:
    curation = Curation(rule="threshold").fit([])
    decision = curation.decide(make_episode(rng, open_at=140))
    assert (decision.verdict, decision.reason) == ("review", "no reference")
    needing = {k for k in DEFAULT_SCORERS if SCORERS[k].needs == "reference"}
    assert {k for k, v in decision.abstained.items() if v == "no reference"} == needing
    assert decision.scores["gripper_timing"] == 140 / 240
    assert decision.evidence["length_steps"] is None


def test_given_threshold_decides_without_reference(rng: np.random.Generator) -> None:
    curation = Curation(rule="threshold", rule_params={"threshold": 0.9}).fit([])
    assert curation.decide(make_episode(rng, open_at=140)).verdict == "discard"
    assert curation.decide(make_episode(rng)).verdict == "keep"


def test_two_references_are_too_few(reference: list[Episode], rng: np.random.Generator) -> None:
    decision = Curation(rule="threshold").fit(reference[:2]).decide(make_episode(rng))
    assert decision.verdict == "review"
    assert decision.reason == "the rule needs 3 reference episodes, there are 2"


def test_rule_none_is_review(reference: list[Episode], rng: np.random.Generator) -> None:
    assert Curation(rule="none").fit(reference).decide(make_episode(rng)).verdict == "review"


def test_inverted_gripper_is_review_with_the_sign(
    curation: Curation, rng: np.random.Generator
) -> None:
    decision = curation.decide(make_episode(rng, opens=1))
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
    decision = curation.decide(make_episode(rng, findings=[finding]))
    assert (decision.verdict, decision.reason) == ("review", f"{bad}: what was found")


def test_degenerate_episodes_are_review_and_never_raise(curation: Curation) -> None:
    for episode in (make_episode(n_steps=0), make_episode(n_steps=1), make_episode(n_steps=2)):
        decision = curation.decide(episode)
        assert decision.verdict == "review"
        assert set(decision.scores) == set(DEFAULT_SCORERS)
        assert all((v is None) == (k in decision.abstained) for k, v in decision.scores.items())


def test_decision_ignores_where_in_time_the_episode_lies(
    curation: Curation, rng: np.random.Generator
) -> None:
    episode = make_episode(rng, open_at=140)
    assert curation.decide(shifted(episode, 10**15)) == curation.decide(copied(episode))


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
    decision = Curation().fit([]).decide(early)
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
    assert Decision.from_line(decision.to_line()) == decision


@pytest.mark.parametrize(("margin_s", "last"), [(0.0, 139), (0.5, 130), (0.51, 129), (1.5, 110)])
def test_margin_is_kept_to_the_step(rng: np.random.Generator, margin_s: float, last: int) -> None:
    early = make_episode(rng, open_at=140)
    decision = Curation(salvage_margin_s=margin_s).fit([]).decide(early)
    assert decision.span[1] == int(early.stamps_ns[last]) - early.start_ns


def test_without_a_margin_or_a_beginning_it_is_discarded(rng: np.random.Generator) -> None:
    early = make_episode(rng, open_at=140)
    whole = (0, early.end_ns - early.start_ns)
    never = Curation(salvage_margin_s=None).fit([]).decide(early)
    assert (never.verdict, never.span) == ("discard", whole)
    assert "salvage" not in never.evidence
    nothing = Curation(salvage_margin_s=6.5).fit([]).decide(early)
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
    curation = Curation().fit([without(e, *missing) for e in reference])
    kept, dropped = (curation.decide(without(e, *missing)) for e in (good, early))
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
    decision = Curation().fit([]).decide(blind)
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
        curation = Curation(rule_params=params).fit([shelved(e) for e in reference])
        decision = curation.decide(shelved(make_episode(rng)))
        decided_by = decision.evidence["decided_by"]
        assert (decision.verdict, decided_by) == ("keep", "grip_consistency")
    assert decision.reason.endswith(
        "; object_coupling is no law here: most of the reference breaks it"
    )
    one_bad = [shelved(reference[0]), *reference[1:]]
    kept = Curation().fit(one_bad).decide(make_episode(rng))
    assert kept.evidence["decided_by"] == "object_coupling"
    doubted = Curation().fit([]).decide(shelved(make_episode(rng)))
    assert doubted.verdict == "review"
    assert "; but grip_consistency: the fingers held" in doubted.reason
    unseen = Curation().fit([]).decide(without(shelved(make_episode(rng)), "finger_position"))
    assert unseen.verdict == "discard"


def test_hold_whose_end_has_no_known_phase_is_not_known(rng: np.random.Generator) -> None:
    episode = make_episode(rng)
    phase = episode.fields["phase"].copy()
    phase[130:] = np.nan
    cut = replace(episode, fields={**episode.fields, "phase": phase})
    decision = Curation().fit([]).decide(cut)
    assert decision.verdict == "review"
    assert {"object_coupling", "grip_consistency", "phase_events"} <= set(decision.abstained)


def test_one_that_saw_it_break_outweighs_one_of_its_kind_that_did_not(
    rng: np.random.Generator,
) -> None:
    early = make_episode(rng, open_at=140)
    stuck = early.fields["finger_position"].copy()
    stuck[120:] = stuck[120]  # the fingers' topic repeats itself: they seem to hold on
    frozen = replace(early, fields={**early.fields, "finger_position": stuck})
    decision = Curation().fit([]).decide(without(frozen, *OBJECTS))
    assert decision.evidence["decided_by"] == "phase_events"
    assert decision.verdict == "salvage"


# --- state hash ---------------------------------------------------------------------------------


def test_hash_and_scores_do_not_depend_on_the_order_of_the_reference(
    curation: Curation, reference: list[Episode], rng: np.random.Generator
) -> None:
    other = Curation().fit(reference[::-1])
    assert other.state_hash == curation.state_hash
    episode = make_episode(rng)
    assert other.decide(episode) == curation.decide(episode)


def test_hash_survives_refit_and_scoring(curation: Curation, reference: list[Episode]) -> None:
    before = curation.state_hash
    curation.decide(reference[0])
    assert curation.state_hash == before
    assert curation.fit(reference[:4]).state_hash != before
    assert curation.fit(reference).state_hash == before


def test_hash_sees_configuration_ids_and_values(
    curation: Curation, reference: list[Episode]
) -> None:
    renamed = [replace(reference[0], id="0" * 8), *reference[1:]]
    touched = copied(reference[0])
    touched.fields["eef_position"][5, 0] += 1e-9
    hashes = {
        curation.state_hash,
        Curation().fit([]).state_hash,
        Curation().fit(renamed).state_hash,
        Curation().fit([touched, *reference[1:]]).state_hash,
        Curation(rule="none").fit(reference).state_hash,
        Curation(rule_params={"false_alarm": 0.02}).fit(reference).state_hash,
        Curation(length="none").fit(reference).state_hash,
        Curation(scorer_params={"knn": {"k": 3}}).fit(reference).state_hash,
        Curation(scorers=["gripper_timing"]).fit(reference).state_hash,
    }
    assert len(hashes) == 9


def test_hash_is_stable_across_processes(curation: Curation) -> None:
    code = (
        "import numpy as np; from episodes import make_reference;"
        "from curation_ros.core.decision.curation import Curation;"
        "r = make_reference(np.random.default_rng(20260608));"
        "print(Curation().fit(r[::-1]).state_hash)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env={"PYTHONPATH": f"{ROOT}:{Path(__file__).parents[1]}", "PYTHONHASHSEED": "7"},
    )
    assert done.stdout.strip() == curation.state_hash


# --- refusals -----------------------------------------------------------------------------------


def test_reference_with_faults_is_refused_by_name(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    gap = make_episode(rng, name="bad-1", findings=[Finding("gap", "silent for 2 s", (0, 9))])
    inverted = make_episode(rng, name="bad-2", opens=1)
    with pytest.raises(EpisodeError, match=r"bad-1 .*gap: silent for 2 s") as caught:
        Curation().fit([*reference, gap, inverted])
    assert "bad-2" in str(caught.value)
    assert "good-" not in str(caught.value)
    with pytest.raises(EpisodeError, match="there twice"):
        Curation().fit([*reference, reference[0]])
    with pytest.raises(EpisodeError, match="too-short: 1 steps"):
        Curation().fit([*reference, make_episode(rng, 1)])


def test_mistake_of_all_references_is_said_once_and_not_fifty_times(
    rng: np.random.Generator,
) -> None:
    gap = Finding("gap", "silent", (0, 9))
    with pytest.raises(EpisodeError) as caught:
        Curation().fit([make_episode(rng, name=f"bad-{k}", findings=[gap]) for k in range(9)])
    assert str(caught.value).count("gap: silent") == 3
    assert str(caught.value).endswith("; and 6 more")


def test_rule_over_the_dataset_says_why_its_scorer_is_silent(rng: np.random.Generator) -> None:
    curation = Curation(rule="gap", rule_scorer="knn").fit([])
    ruling = curation.ruling({"a": None, "b": None}, final=True)
    assert ruling.no_rule == "knn cannot tell: no reference"
    decision = curation.judge(curation.examine(make_episode(rng)), ruling)
    assert (decision.verdict, decision.reason) == ("review", "knn cannot tell: no reference")


def test_reference_that_the_deciding_scorer_cannot_score_is_refused_by_name(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    never = make_episode(rng, name="bad-3", close_at=None)
    with pytest.raises(EpisodeError, match=r"bad-3 .*gripper_timing cannot score it: the gripper"):
        Curation().fit([*reference, never])
    fitted = Curation(rule_scorer="knn").fit([*reference, never])
    assert fitted.decide(make_episode(rng)).verdict in ("keep", "discard")


def test_reference_that_shows_no_gripper_leaves_the_stronger_evidence(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    """A robot with a suction cup: no threshold on gripper timing, and none is needed."""

    def cup(episode: Episode) -> Episode:
        bare = without(episode, "gripper", "finger_position")
        return replace(bare, topic_map=replace(bare.topic_map, gripper=None, action=("twist",)))

    trusted = [cup(e) for e in reference]
    curation = Curation().fit(trusted)
    kept = curation.decide(cup(make_episode(rng)))
    assert (kept.verdict, kept.evidence["decided_by"]) == ("keep", "object_coupling")
    blind = without(cup(make_episode(rng)), *OBJECTS)
    told = curation.decide(blind)
    assert told.verdict == "review"
    assert "gripper_timing cannot score it: the topic map declares no gripper" in told.reason
    with pytest.raises(EpisodeError, match="gripper_timing cannot score it"):
        Curation(rule="threshold").fit(trusted)


def test_scorer_that_cannot_be_fitted_abstains_and_the_others_score(
    reference: list[Episode], rng: np.random.Generator
) -> None:
    curation = Curation().fit(reference[:1])
    scores, abstained = curation.score(make_episode(rng))
    assert set(abstained) == {"isolation_forest"}
    assert "at least 2" in abstained["isolation_forest"]
    assert scores["knn"] is not None


def test_failed_fit_leaves_it_unfitted(curation: Curation, reference: list[Episode]) -> None:
    with pytest.raises(EpisodeError):
        curation.fit([*reference, reference[0]])
    with pytest.raises(NotFittedError):
        curation.score(reference[0])


def test_unfitted_curation_raises(rng: np.random.Generator) -> None:
    with pytest.raises(NotFittedError, match="call fit"):
        Curation().decide(make_episode(rng))
    with pytest.raises(NotFittedError):
        _ = Curation().state_hash


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"scorers": ["smoothnes"]}, ["smoothnes", *SCORERS]),
        ({"scorers": []}, ["expected names"]),
        ({"scorers": ["knn", "knn"]}, ["each once"]),
        ({"rule": "vote"}, ["vote", *RULES]),
        ({"rule_scorer": "knn", "scorers": ["length"]}, ["knn", "length"]),
        ({"length": "median"}, ["median", "shortest-reference"]),
        ({"scorer_params": {"nn": {}}}, ["nn", *SCORERS]),
        ({"scorer_params": {"knn": {"n": 3}}}, ["knn", "'n'", "scale_floor"]),
        ({"scorer_params": {"knn": {"k": "5"}}}, ["knn", "k is '5'"]),
        ({"scorer_params": {"smoothness": {"gripper_channel": "False"}}}, ["'False'"]),
        ({"scorer_params": {"entropy": {"over": "x"}}}, ["over", "values"]),
        ({"scorers": ["gripper_timing"], "scorer_params": {"knn": {}}}, ["knn"]),
        ({"rule_params": {"limit": 3}}, ["'limit'", "threshold", "false_alarm"]),
        ({"rule": "gap", "rule_params": {"value": 3}}, ["rule 'gap'", "'value'", "has method"]),
        ({"rule_params": {"threshold": "high"}}, ["threshold"]),
    ],
)
def test_bad_configuration_names_what_exists(config: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        Curation(**config)  # type: ignore[arg-type]
    for word in words:
        assert word in str(caught.value)


def test_describe_says_what_scores_what_it_needs_and_the_threshold(
    reference: list[Episode],
) -> None:
    text = Curation().fit(reference[:3]).describe()
    for name in DEFAULT_SCORERS:
        assert f"scorer {name}: needs {SCORERS[name].needs}" in text
    assert "shortest-reference, 234 steps" in text
    assert "only 3 reference episodes" in text
    assert "keep where gripper_timing >= 0.937" in text
    assert "review: no reference" in Curation().fit([]).describe()


def test_examine_asks_every_scorer_once_per_view(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    curation = Curation().fit(make_reference(rng))
    asked: Counter[tuple[str, int]] = Counter()
    for name, scorer in curation.scorers_.items():

        def look(episode: Episode, name: str = name, scorer: Scorer = scorer) -> Look:
            asked[name, len(episode)] += 1
            return type(scorer).look(scorer, episode)

        monkeypatch.setattr(scorer, "look", look)
    whole = make_episode(rng, open_at=140)
    curation.examine(whole)
    assert {name for name, _ in asked} == set(curation.scorers_)
    assert set(asked.values()) == {1}
    asked.clear()
    n = len(whole)
    spoilt = whole.fields["twist"].copy()
    spoilt[n - 20 :] = np.nan
    fault = Finding("not-finite", "the twist ends in NaN", whole.span(n - 20, n - 1))
    torn = replace(with_fields(whole, twist=spoilt), findings=(fault,))
    part = curation.examine(torn).part
    assert part is not None
    of_whole_episodes = [k for k, s in curation.scorers_.items() if not s.length_controlled]
    for name in of_whole_episodes:
        assert asked[name, n] == asked[name, n - 20] == 1
    assert sum(asked.values()) == 2 * len(curation.scorers_)


def test_examine_watches_a_carry_once(
    monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    curation = Curation().fit(make_reference(rng))
    taken = []
    take = CarryWatch.take

    def counted(watch: CarryWatch, episode: Episode) -> CarryWatch:
        taken.append(len(episode))
        return take(watch, episode)

    monkeypatch.setattr(CarryWatch, "take", counted)
    episode = make_episode(rng, open_at=140)
    found = curation.examine(episode)
    assert found.scores["object_coupling"] is not None
    assert taken == [len(episode)]
