"""Selections: keep rules, ties by hash alone, what abstained, and the manifest."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.balance import Balance, Shown
from curation_ros.core.decision.decision import CURATOR, Decision, Verdict
from curation_ros.core.decision.selection import (
    KEEP_RULES,
    Candidate,
    Entry,
    Manifest,
    Selection,
    select,
    tie_key,
)
from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.ranks import mid_ranks

FINITE = st.floats(-10, 10)


def pool(*scores: float | None) -> list[Candidate]:
    return [Candidate(f"id-{k}", f"n{k}", score) for k, score in enumerate(scores)]


def kept(selection: Selection) -> list[str]:
    return [e.name for e in selection.entries]


def decided(verdict: Verdict, k: int) -> Candidate:
    decision = Decision(f"id-{k}", f"n{k}", verdict, "r", (3, 9))
    return Candidate(f"id-{k}", f"n{k}", decision=decision)


# --- rules --------------------------------------------------------------------------------------


def test_top_rules_keep_the_best_first() -> None:
    candidates = pool(0.1, 0.9, 0.5, 0.7)
    assert kept(select(candidates, "top-k", 2)) == ["n1", "n3"]
    assert kept(select(candidates, "top-fraction", 0.75)) == ["n1", "n3", "n2"]
    assert kept(select(candidates, "threshold", 0.5)) == ["n1", "n3", "n2"]
    assert select(candidates, "top-k", 2).kept_of == 4


@pytest.mark.parametrize(
    ("n", "fraction", "expected"), [(80, 0.75, 60), (3, 0.5, 2), (100, 0.29, 29)]
)
def test_fraction_rounds_to_the_nearest_count(n: int, fraction: float, expected: int) -> None:
    assert len(select(pool(*np.arange(n)), "top-fraction", fraction).entries) == expected


def test_abstained_episodes_are_never_kept_by_score() -> None:
    candidates = pool(None, 0.2, None, 0.1)
    for rule, value in (("top-fraction", 1.0), ("top-k", 2), ("threshold", -1.0)):
        selection = select(candidates, rule, value)
        assert kept(selection) == ["n1", "n3"]
        assert sorted(selection.abstained) == ["id-0", "id-2"]
    with pytest.raises(ConfigError, match="only 2 of 4"):
        select(candidates, "top-k", 3)


def test_all_keeps_everything() -> None:
    assert sorted(kept(select(pool(None, 0.2), "all"))) == ["n0", "n1"]


def test_decisions_keep_and_salvage_with_span() -> None:
    verdicts: list[Verdict] = ["keep", "salvage", "review", "discard"]
    candidates = [decided(v, k) for k, v in enumerate(verdicts)] + [Candidate("id-9", "n9")]
    selection = select(candidates, "decisions")
    assert set(selection.entries) == {Entry("id-0", "n0"), Entry("id-1", "n1", (3, 9))}
    assert selection.abstained == ("id-9",)


@pytest.mark.parametrize(
    ("rule", "value"),
    [
        ("best", 1),
        ("top-k", None),
        ("top-k", 0),
        ("top-k", 1.5),
        ("top-k", float("inf")),
        ("top-k", float("nan")),
        ("top-fraction", 0.0),
        ("top-fraction", 1.1),
        ("threshold", float("nan")),
        ("all", 3),
        ("decisions", 0.5),
    ],
)
def test_bad_rule_or_value_is_refused(rule: str, value: float | None) -> None:
    with pytest.raises(ConfigError, match="keep rule"):
        select(pool(1.0, 2.0), rule, value)


def test_duplicate_or_not_finite_candidate_is_refused() -> None:
    with pytest.raises(ConfigError, match="twice"):
        select([*pool(1.0), *pool(2.0)], "all")
    with pytest.raises(ConfigError, match="abstained has None"):
        select(pool(float("nan")), "top-k", 1)


# --- ties ---------------------------------------------------------------------------------------


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0, None]), min_size=1, max_size=12),
    st.randoms(use_true_random=False),
    st.sampled_from([("top-fraction", 0.5), ("threshold", 0.5), ("all", None)]),
)
def test_order_of_candidates_changes_nothing(
    scores: list[float | None], random: object, rule: tuple[str, float | None]
) -> None:
    candidates = pool(*scores)
    mixed = list(candidates)
    random.shuffle(mixed)  # type: ignore[attr-defined]
    assert select(mixed, *rule) == select(candidates, *rule)


def test_constant_scorer_keeps_good_ones_at_chance() -> None:
    # 16 of 80 are good and were collected first, as in the paper; keep 20: by chance 4 of them.
    candidates = pool(*[1.0] * 80)
    good = {f"n{k}" for k in range(16)}
    counts = [len(good & set(kept(select(candidates, "top-k", 20, seed=s)))) for s in range(400)]
    assert np.mean(counts) == pytest.approx(4.0, abs=0.25)
    assert np.std(counts) > 1.0


def test_tie_key_of_start_and_repetition_decides_before_the_id() -> None:
    starts = {f"id-{k}": (k * 7) % 5 for k in range(5)}

    def tie(episode_id: str) -> str:
        return tie_key(3, "task", starts[episode_id], 0)

    first = [starts[e.episode] for e in select(pool(*[0.0] * 5), "all", tie=tie).entries]
    # The same starts under other ids come out in the same order.
    starts = {f"id-{k}": (k * 3) % 5 for k in range(5)}
    assert [starts[e.episode] for e in select(pool(*[0.0] * 5), "all", tie=tie).entries] == first


def test_no_score_outranks_a_person() -> None:
    def by(who: str, verdict: str) -> Decision:
        return Decision("x", "", verdict, "r", (0, 9), by=who)  # type: ignore[arg-type]

    pool = [
        Candidate("a", "", 9.0, by("ada", "discard")),
        Candidate("b", "", 8.0, by("ada", "review")),
        Candidate("c", "", 7.0, by(CURATOR, "discard")),
        Candidate("d", "", 6.0, by("ada", "keep")),
        Candidate("e", "", 5.0),
    ]
    for rule, value in (("top-k", 2), ("top-fraction", 0.67), ("threshold", 5.5)):
        chosen = select(pool, rule, value)
        assert [e.episode for e in chosen.entries] == ["c", "d"], rule
        assert chosen.kept_of == 5
    assert len(select(pool, "all").entries) == 5


def test_equal_tie_keys_do_not_fall_back_to_the_order_given() -> None:
    candidates = pool(1.0, 1.0, 1.0)
    selections = {
        tuple(kept(select(order, "top-k", 1, tie=lambda _: "same")))
        for order in (candidates, candidates[::-1], candidates[1:] + candidates[:1])
    }
    assert len(selections) == 1


def test_tie_key_depends_on_every_part() -> None:
    keys = {
        tie_key(0, "t", 1, 2),
        tie_key(1, "t", 1, 2),
        tie_key(0, "u", 1, 2),
        tie_key(0, "t", 12),
        tie_key(0, "t", 2, 1),
    }
    assert len(keys) == 5


def test_mid_ranks_by_hand() -> None:
    np.testing.assert_array_equal(mid_ranks([0.5, 0.9, 0.5, 0.1]), [2.5, 1.0, 2.5, 4.0])
    np.testing.assert_array_equal(mid_ranks([7.0] * 5), [3.0] * 5)
    assert mid_ranks([]).shape == (0,)
    with pytest.raises(ConfigError):
        mid_ranks([float("nan")])


@given(st.lists(FINITE, min_size=1, max_size=20), st.randoms(use_true_random=False))
def test_mid_ranks_follow_a_permutation_and_keep_their_sum(
    scores: list[float], random: object
) -> None:
    ranks = mid_ranks(scores)
    n = len(scores)
    assert ranks.sum() == pytest.approx(n * (n + 1) / 2)
    order = list(range(n))
    random.shuffle(order)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(mid_ranks([scores[k] for k in order]), ranks[order])


# --- manifest -----------------------------------------------------------------------------------


def manifest(**changes: object) -> Manifest:
    given = {
        "name": "top-60",
        "created_at": "2026-11-22T01:00:00Z",
        "dataset": "demo",
        "scorer": "knn",
        "rule": "top-fraction",
        "entries": (Entry("a", "n1"), Entry("b", "n2", (0, 5)), Entry("b", "n2", (9, 12))),
        "kept_of": 3,
        "rule_params": {"value": 0.75, "seed": 0},
        "state_hash": "f00",
        "abstained": ("c",),
    }
    return Manifest(**{**given, **changes})  # type: ignore[arg-type]


def test_manifest_survives_json() -> None:
    text = json.dumps(manifest().to_json(), allow_nan=False)
    assert Manifest.from_json(json.loads(text)) == manifest()
    assert json.loads(text)["entries"][1] == {"episode": "b", "name": "n2", "span": [0, 5]}
    assert Manifest.from_json({**manifest().to_json(), "later": 1}) == manifest()


def test_manifest_keeps_the_phases_and_reads_those_of_before() -> None:
    counted = manifest(phases=Balance(2, 2, {"LIFT": Shown(2, 90), "RELEASE": Shown(1, 3)}))
    raw = json.loads(json.dumps(counted.to_json()))
    assert raw["phases"]["shown"]["RELEASE"] == {"demonstrations": 1, "steps": 3}
    assert Manifest.from_json(raw) == counted
    assert "phases" not in manifest().to_json()
    assert manifest().phases is None
    with pytest.raises(ConfigError, match="phases"):
        Manifest.from_json({**raw, "phases": {"shown": 3}})


@pytest.mark.parametrize(
    "changes",
    [
        {"name": ""},
        {"name": "../up"},
        {"name": "a b"},
        {"created_at": "yesterday"},
        {"rule": ""},
        {"entries": (Entry("a", "n"), Entry("a", "n"))},
        {"entries": (Entry("", "n"),)},
        {"entries": (Entry("a", "n", (5, 1)),)},
        {"kept_of": 1},
    ],
)
def test_bad_manifest_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match="selection"):
        manifest(**changes)


def test_bad_manifest_json_is_refused() -> None:
    raw = manifest().to_json()
    for key in raw:
        with pytest.raises(ConfigError):
            Manifest.from_json({k: v for k, v in raw.items() if k != key})
    for bad in ([], None, {**raw, "entries": [{"episode": "a"}]}, {**raw, "kept_of": "many"}):
        with pytest.raises(ConfigError):
            Manifest.from_json(bad)


def test_every_rule_is_described_and_the_candidate_is_frozen() -> None:
    assert all(KEEP_RULES.values())
    assert replace(pool(1.0)[0], score=None).score is None
