"""Rules `top-fraction` and `top-k`: how many they keep, and how they break ties."""

from __future__ import annotations

import random

import pytest
from cases import case, explained, kept, verdicts
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.rules import make_rule
from curation_ros.core.decision.rules.best import TopFraction, TopK
from curation_ros.core.decision.ties import tie_key
from curation_ros.core.errors import ConfigError, EpisodeError

SCORES = st.dictionaries(st.uuids().map(str), st.integers(-4, 4).map(float), min_size=1)


def test_best_share_by_hand() -> None:
    scores = {"a": 4.0, "b": 3.0, "c": 2.0, "d": 1.0}
    rule = TopFraction(scorer="s").fit_dataset(scores)
    assert verdicts(rule, scores) == {"a": "keep", "b": "keep", "c": "keep", "d": "discard"}
    assert rule.cut == 2.0
    assert rule.verdict(case(2.0, "c"))[1] == "s 2.00 is among the best 3 of 4"
    assert rule.verdict(explained(1.0, "it shook", "d"))[1] == (
        "it shook; s 1.00 is not among the best 3 of 4 (cut 2.00)"
    )


@pytest.mark.parametrize(
    ("n", "share", "expected"),
    [(80, 0.75, 60), (3, 0.5, 2), (100, 0.29, 29), (1, 0.5, 1), (3, 0.1, 0)],
)
def test_share_is_rounded_to_the_nearest_number_and_half_up(
    n: int, share: float, expected: int
) -> None:
    scores = {f"e{k}": float(k) for k in range(n)}
    assert len(kept(TopFraction(scorer="s", value=share).fit_dataset(scores), scores)) == expected


@pytest.mark.parametrize(("n", "k", "expected"), [(4, 5, 4), (1, 60, 1), (4, 4, 4), (4, 3, 3)])
def test_k_of_fewer_keeps_all(n: int, k: int, expected: int) -> None:
    scores = {f"e{i}": float(i) for i in range(n)}
    assert len(kept(TopK(scorer="s", value=k).fit_dataset(scores), scores)) == expected


@pytest.mark.parametrize("name", ["top-fraction", "top-k"])
def test_best_of_nothing_is_refused(name: str) -> None:
    with pytest.raises(EpisodeError, match="no episode has a score"):
        make_rule(name, "s").fit_dataset({})


def test_equal_scores_at_the_cut_are_drawn_by_lot_and_it_says_so() -> None:
    scores = dict.fromkeys("abcdef", 1.0)
    rule = TopK(scorer="s", value=2).fit_dataset(scores)
    chosen = sorted(kept(rule, scores))
    assert chosen == sorted(sorted(scores, key=lambda i: tie_key(0, i))[:2])
    reason = rule.verdict(case(1.0, chosen[0]))[1]
    assert reason == "s 1.00 is the cut of the best 2 of 6, which 6 episodes share: kept by lot"
    by_name = TopK(scorer="s", value=2).fit_dataset(scores, tie=lambda i: i)
    assert kept(by_name, scores) == {"a", "b"}


@given(SCORES, st.randoms(use_true_random=False))
def test_order_of_the_dataset_changes_nothing(
    scores: dict[str, float], shuffle: random.Random
) -> None:
    items = list(scores.items())
    shuffle.shuffle(items)
    for name in ("top-fraction", "top-k"):
        for tie in (None, lambda _: "one start"):
            one, other = (
                make_rule(name, "s", {"value": 1}).fit_dataset(d, tie=tie)
                for d in (scores, dict(items))
            )
            assert one.fitted() == other.fitted()


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("top-fraction", 0.0, "a share above 0, up to 1"),
        ("top-fraction", 1.5, "a share above 0, up to 1"),
        ("top-fraction", float("nan"), "a share above 0, up to 1"),
        ("top-k", 0, "a whole number from 1"),
        ("top-k", 2.5, "a whole number from 1"),
        ("top-k", float("inf"), "a whole number from 1"),
        ("top-k", float("nan"), "a whole number from 1"),
    ],
)
def test_value_that_makes_no_sense_is_refused(name: str, value: float, expected: str) -> None:
    with pytest.raises(ConfigError, match=f"rule '{name}': value is {value}, expected {expected}"):
        make_rule(name, "s", {"value": value})
