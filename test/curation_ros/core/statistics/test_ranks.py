"""Mid-ranks: equal scores share the middle of their ranks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.ranks import mid_ranks

FINITE = st.floats(-10, 10)


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
