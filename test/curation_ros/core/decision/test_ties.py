"""Ties are broken by a hash, and by nothing else."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.ties import ranking, tie_key, unique


def test_tie_key_depends_on_every_part() -> None:
    keys = {
        tie_key(0, "t", 1, 2),
        tie_key(1, "t", 1, 2),
        tie_key(0, "u", 1, 2),
        tie_key(0, "t", 12),
        tie_key(0, "t", 2, 1),
    }
    assert len(keys) == 5


def test_ranking_goes_by_score_and_then_by_the_key() -> None:
    scores = {"a": 1.0, "b": 2.0, "c": 1.0, "d": 3.0}
    assert ranking(scores, lambda i: i) == ["d", "b", "a", "c"]
    assert ranking(scores, lambda i: -ord(i)) == ["d", "b", "c", "a"]


@given(st.lists(st.text("ab", max_size=3), min_size=2, max_size=8), st.integers(0, 3))
def test_unique_key_orders_by_the_first_key_and_never_leaves_a_tie(
    starts: list[str], seed: int
) -> None:
    ids = [f"id-{k}" for k in range(len(starts))]
    start = dict(zip(ids, starts, strict=True))
    key = unique(start.__getitem__, seed)
    assert len({key(i) for i in ids}) == len(ids)
    assert sorted(ids, key=key) == sorted(ids, key=lambda i: (start[i], tie_key(seed, i)))


def test_unique_key_without_a_first_one_is_that_of_the_id() -> None:
    assert unique(None, 3)("x") == tie_key(3, "x")
