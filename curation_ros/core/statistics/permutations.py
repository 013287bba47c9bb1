"""What permutation tests and resampling share."""

from __future__ import annotations

import numpy as np

from curation_ros.core.types import Floats

#: Two statistics that differ by less than this differ by rounding alone.
ROUNDING = 1e-9
#: Draws are made in blocks of about this many numbers, which bounds the memory they take.
_BLOCK = 2_000_000


def block_sizes(n_draws: int, n_per_draw: int) -> list[int]:
    """Split draws into blocks.

    Args:
        n_draws: number of permutations or resamples.
        n_per_draw: how many numbers each of them holds.

    Returns:
        Number of draws in each block; they sum to `n_draws`.
    """
    size = max(1, _BLOCK // max(1, n_per_draw))
    return [min(size, n_draws - at) for at in range(0, n_draws, size)]


def count_as_extreme(drawn: Floats, observed: float) -> int:
    """Count the drawn statistics that are at least as far from 0 as the observed one."""
    return int((np.abs(drawn) >= abs(observed) * (1 - ROUNDING) - ROUNDING).sum())
