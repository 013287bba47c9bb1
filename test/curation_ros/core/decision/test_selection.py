"""Selections: what is chosen, in which order, and what never is."""

from __future__ import annotations

from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.decision import CURATOR, Decision, Verdict
from curation_ros.core.decision.manifest import Entry
from curation_ros.core.decision.rules import RULES, make_rule
from curation_ros.core.decision.selection import Candidate, Selection, select
from curation_ros.core.decision.ties import tie_key
from curation_ros.core.errors import ConfigError, CurationError


def pool(*scores: float | None) -> list[Candidate]:
    return [Candidate(f"id-{k}", f"n{k}", score) for k, score in enumerate(scores)]


def chosen(
    candidates: list[Candidate], name: str, value: float | None = None, **options: object
) -> Selection:
    kind = RULES[name]
    params = {} if value is None else {kind.value_param: value}
    return select(candidates, make_rule(name, "s", params), **options)


def kept(selection: Selection) -> list[str]:
    return [e.name for e in selection.entries]


def decided(verdict: Verdict, k: int, by: str = CURATOR) -> Candidate:
    decision = Decision(f"id-{k}", f"n{k}", verdict, "r", (3, 9), by=by)
    return Candidate(f"id-{k}", f"n{k}", decision=decision)


# --- rules --------------------------------------------------------------------------------------


def test_rules_that_rank_keep_the_best_first() -> None:
    candidates = pool(0.1, 0.9, 0.5, 0.7)
    assert kept(chosen(candidates, "top-k", 2)) == ["n1", "n3"]
    assert kept(chosen(candidates, "top-fraction", 0.75)) == ["n1", "n3", "n2"]
    assert kept(chosen(candidates, "threshold", 0.5)) == ["n1", "n3", "n2"]
    assert chosen(candidates, "top-k", 2).kept_of == 4


def test_abstained_episodes_are_never_kept_by_score() -> None:
    candidates = pool(None, 0.2, None, 0.1)
    for rule, value in (("top-fraction", 1.0), ("top-k", 2), ("top-k", 3), ("threshold", -1.0)):
        selection = chosen(candidates, rule, value)
        assert kept(selection) == ["n1", "n3"]
        assert sorted(selection.abstained) == ["id-0", "id-2"]


def test_all_keeps_everything() -> None:
    candidates = [*pool(None, 0.2), decided("discard", 7, "ada")]
    selection = chosen(candidates, "all")
    assert sorted(kept(selection)) == ["n0", "n1", "n7"]
    assert selection.abstained == ()


def test_decisions_keep_and_salvage_with_span() -> None:
    verdicts: list[Verdict] = ["keep", "salvage", "review", "discard"]
    candidates = [decided(v, k) for k, v in enumerate(verdicts)] + [Candidate("id-9", "n9")]
    selection = chosen(candidates, "decisions")
    assert set(selection.entries) == {Entry("id-0", "n0"), Entry("id-1", "n1", (3, 9))}
    assert selection.abstained == ("id-9",)


def test_gap_without_two_groups_selects_nothing_and_says_why() -> None:
    with pytest.raises(CurationError, match=r"rule 'gap': s: no two groups among 8 .* nothing"):
        chosen(pool(*[1.0] * 8), "gap")
    with pytest.raises(CurationError, match=r"needs 8 scored episodes; there are 3; nothing"):
        chosen(pool(1.0, 2.0, 9.0), "gap")


def test_method_of_gap_is_the_one_that_is_asked_for() -> None:
    # Two of ten are far away: a gap for one method, too small a group for the other.
    scores = [0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07, 0.08, 0.09, 5.0]
    widest = make_rule("gap", "s", {"method": "largest-gap"})
    assert kept(select(pool(*scores), widest)) == ["n10"]
    with pytest.raises(CurationError, match="no two groups"):
        select(pool(*scores), make_rule("gap", "s", {"method": "mixture"}))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("evidence", "run curation score DATASET --write, then curation select --rule decisions"),
        ("none", "it selects nothing"),
        ("threshold", "without a value it is fitted on a reference: give --value"),
    ],
)
def test_rule_that_cannot_select_is_refused_with_what_to_do_instead(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"rule '{name}': .*{said}"):
        chosen(pool(1.0, 2.0), name)


def test_duplicate_or_not_finite_candidate_is_refused() -> None:
    with pytest.raises(ConfigError, match="twice"):
        chosen([*pool(1.0), *pool(2.0)], "all")
    with pytest.raises(ConfigError, match="abstained has None"):
        chosen(pool(float("nan")), "top-k", 1)


# --- ties ---------------------------------------------------------------------------------------


@given(
    st.lists(st.sampled_from([0.0, 0.5, 1.0]), min_size=1, max_size=12),
    st.randoms(use_true_random=False),
    st.sampled_from([("top-fraction", 0.5), ("threshold", 0.5), ("all", None)]),
)
def test_order_of_candidates_changes_nothing(
    scores: list[float], random: Random, rule: tuple[str, float | None]
) -> None:
    candidates = [*pool(*scores), Candidate("id-x", "x")]
    mixed = list(candidates)
    random.shuffle(mixed)
    assert chosen(mixed, *rule) == chosen(candidates, *rule)


def test_constant_scorer_keeps_good_ones_at_chance() -> None:
    # 16 of 80 are good and were collected first, as in the paper; keep 20: by chance 4 of them.
    candidates = pool(*[1.0] * 80)
    good = {f"n{k}" for k in range(16)}
    counts = [len(good & set(kept(chosen(candidates, "top-k", 20, seed=s)))) for s in range(400)]
    assert np.mean(counts) == pytest.approx(4.0, abs=0.25)
    assert np.std(counts) > 1.0


def test_tie_key_of_start_and_repetition_decides_before_the_id() -> None:
    starts = {f"id-{k}": (k * 7) % 5 for k in range(5)}

    def tie(episode_id: str) -> str:
        return tie_key(3, "task", starts[episode_id], 0)

    first = [starts[e.episode] for e in chosen(pool(*[0.0] * 5), "all", tie=tie).entries]
    # The same starts under other ids come out in the same order.
    starts = {f"id-{k}": (k * 3) % 5 for k in range(5)}
    assert [starts[e.episode] for e in chosen(pool(*[0.0] * 5), "all", tie=tie).entries] == first


def test_equal_tie_keys_do_not_fall_back_to_the_order_given() -> None:
    candidates = pool(1.0, 1.0, 1.0)
    selections = {
        tuple(kept(chosen(order, "top-k", 1, tie=lambda _: "same")))
        for order in (candidates, candidates[::-1], candidates[1:] + candidates[:1])
    }
    assert len(selections) == 1


# --- people and faults --------------------------------------------------------------------------


def by(
    name: str, score: float, who: str, verdict: Verdict, *, is_trusted: bool = True
) -> Candidate:
    decision = Decision(name, "", verdict, "r", (0, 9), by=who)
    return Candidate(name, "", score, decision, is_trusted)


def test_no_score_outranks_a_person() -> None:
    candidates = [
        by("a", 9.0, "ada", "discard"),
        by("b", 8.0, "ada", "review"),
        by("c", 7.0, CURATOR, "discard"),
        by("d", 6.0, "ada", "keep"),
        Candidate("e", "", 5.0),
    ]
    for rule, value in (("top-k", 2), ("top-fraction", 0.67), ("threshold", 5.5)):
        selection = chosen(candidates, rule, value)
        assert [e.episode for e in selection.entries] == ["c", "d"], rule
        assert selection.kept_of == 5
    assert len(chosen(candidates, "all").entries) == 5


def test_fault_of_the_recording_leaves_the_pool_unless_a_person_keeps_it() -> None:
    candidates = [
        by("a", 9.0, CURATOR, "review", is_trusted=False),
        by("b", 8.0, "ada", "keep", is_trusted=False),
        Candidate("c", "", 7.0),
        Candidate("d", "", 6.0),
    ]
    selection = chosen(candidates, "top-k", 2)
    assert [e.episode for e in selection.entries] == ["b", "c"]
    assert selection.abstained == ("a",)
    assert len(chosen(candidates, "all").entries) == 4
