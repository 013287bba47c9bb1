"""Hashes of states: equal for equal states, different for any other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.decision.state_hash import state_hash

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@given(PLAIN)
def test_equal_states_have_one_hash(state: Any) -> None:
    assert state_hash(state) == state_hash(state)
    assert len(state_hash(state)) == 64


def test_what_looks_alike_is_told_apart() -> None:
    states: list[Any] = [
        None, True, False, 0, 1, 0.0, -0.0, 1.0, "", "1", [], {}, [0], ["0"], {"a": 1}, {"a": 1.0},
        [[1], 2], [1, [2]], {"a": {"b": 1}}, np.zeros(2), np.zeros((1, 2)), np.zeros(2, dtype=int),
    ]  # fmt: skip
    hashes = [state_hash(s) for s in states]
    assert len(set(hashes)) == len(hashes)


def test_order_of_keys_and_width_of_integers_do_not_matter() -> None:
    assert state_hash({"a": 1, "b": 2}) == state_hash({"b": 2, "a": 1})
    assert state_hash(np.int32(3)) == state_hash(3)
    assert state_hash(np.arange(3, dtype=np.int32)) == state_hash(np.arange(3))
    assert state_hash((1, 2)) == state_hash([1, 2])


def test_hash_is_the_same_on_every_machine() -> None:
    state = {"a": [1, 2.5, None, True, "x"], "b": np.array([1.5, -2.0])}
    assert state_hash(state)[:16] == "8b4ad59bc639f702"


def test_what_has_no_canonical_form_is_refused() -> None:
    with pytest.raises(TypeError, match="no canonical form for set"):
        state_hash({1, 2})
