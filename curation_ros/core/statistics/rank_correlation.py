"""Spearman's rank correlation, over many episodes or over a handful of conditions."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.permutations import count_as_extreme
from curation_ros.core.statistics.ranks import mid_ranks
from curation_ros.core.types import Floats

#: Up to this many conditions all permutations are enumerated (9! = 362 880). Above, this many are
#: drawn.
_EXHAUSTIVE_CONDITIONS, _N_PERMUTATIONS = 9, 99_999


def rank_correlation(
    scores: Sequence[float] | Floats, lengths: Sequence[float] | Floats
) -> tuple[float, float] | None:
    """Spearman's rho over episodes, with its asymptotic two-sided p.

    Args:
        scores: (n,) score of each episode.
        lengths: (n,) length of each episode.

    Returns:
        rho and p, or None for fewer than 3 episodes or if scores or lengths are constant.
    """
    a, b = np.asarray(scores, dtype=np.float64), np.asarray(lengths, dtype=np.float64)
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    from scipy.stats import spearmanr  # takes seconds to import; only audits need it

    result = spearmanr(a, b)
    return float(result.statistic), float(result.pvalue)


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rho over a handful of conditions.

    Attributes:
        rho: from -1 to 1.
        p: two-sided, over all permutations of the ranks (drawn ones above 9 conditions).
        interval: confidence interval of rho; None below 4 conditions, where there is none.
        n: number of conditions.
        is_exact: whether all permutations were enumerated.
    """

    rho: float
    p: float
    interval: tuple[float, float] | None
    n: int
    is_exact: bool


def rank_correlation_exact(
    x: Sequence[float], y: Sequence[float], *, seed: int = 0, confidence: float = 0.95
) -> RankCorrelation | None:
    """Spearman's rho over a handful of conditions, with ties as mid-ranks.

    Args:
        x: (n,) one value per condition.
        y: (n,) another value per condition.
        seed: seed of the drawn permutations. Up to 9 conditions nothing is drawn.
        confidence: nominal coverage of the interval.

    Returns:
        None with fewer than 3 conditions, or if `x` or `y` is constant.

    Raises:
        ConfigError: if the lengths differ or a value is not finite.

    Source: the interval is Bonett and Wright's, Psychometrika 65:23-28, 2000, on Fisher's scale.
    It has no width at -1 and 1. There, the interval of the nearest rho that n conditions without
    ties can have is used.
    """
    if len(x) != len(y):
        raise ConfigError(f"rank correlation: {len(x)} and {len(y)} values")
    a, b = mid_ranks(x), mid_ranks(y)
    n = len(a)
    if n < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    a, b = a - a.mean(), b - b.mean()
    norm = math.sqrt(float(a @ a) * float(b @ b))
    rho = float(np.clip(a @ b / norm, -1, 1))
    is_exact = n <= _EXHAUSTIVE_CONDITIONS
    if is_exact:
        orders = np.array(list(itertools.permutations(range(n))), dtype=np.int8)
        p = count_as_extreme(b[orders] @ a, rho * norm) / len(orders)
    else:
        rng = np.random.default_rng(seed)
        drawn = rng.permuted(np.tile(b, (_N_PERMUTATIONS, 1)), axis=1) @ a
        p = (1 + count_as_extreme(drawn, rho * norm)) / (1 + _N_PERMUTATIONS)
    return RankCorrelation(rho, p, _rho_interval(rho, n, confidence), n, is_exact)


def _rho_interval(rho: float, n: int, confidence: float) -> tuple[float, float] | None:
    if n < 4:
        return None
    # Exchanging two neighbours takes 12 / (n (n^2 - 1)) from a rho of 1.
    inside = float(np.clip(rho, *np.array([-1, 1]) * (1 - 12 / (n * (n * n - 1)))))
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    half = z * math.sqrt((1 + inside * inside / 2) / (n - 3))
    low, high = math.tanh(math.atanh(inside) - half), math.tanh(math.atanh(inside) + half)
    return (-1.0 if rho <= -1 else low), (1.0 if rho >= 1 else high)
