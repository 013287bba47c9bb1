"""Ranks with ties."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Floats


def mid_ranks(scores: Sequence[float] | Floats) -> Floats:
    """Rank scores, 1 for the highest; equal scores share the mean of their ranks.

    Args:
        scores: (n,) finite.

    Returns:
        (n,) ranks.

    Raises:
        ConfigError: if a score is not finite.
    """
    values = np.asarray(scores, dtype=np.float64)
    if not np.isfinite(values).all():
        raise ConfigError("ranks: a score is not finite; leave out episodes without a score")
    _, index, counts = np.unique(-values, return_inverse=True, return_counts=True)
    last = np.cumsum(counts)
    ranks: Floats = (last - (counts - 1) / 2.0)[index]
    return ranks
