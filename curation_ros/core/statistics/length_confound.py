"""How much of what a score detects is the length of the episode.

Failed demonstrations are often longer, so a score that only follows length can look like a good
detector. The tests here compare episodes of about equal length, and episodes of equal label.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from curation_ros.core.statistics.detection import auroc, checked
from curation_ros.core.statistics.permutations import block_sizes, count_as_extreme
from curation_ros.core.statistics.ranks import mid_ranks
from curation_ros.core.types import Floats, Mask

Indices: TypeAlias = npt.NDArray[np.int64]


def separates(lengths: Sequence[float] | Floats, good: Sequence[bool] | Mask) -> bool:
    """Whether every good episode is shorter than every bad one, or every one longer.

    If so, no good and bad episode are equally long. The data then cannot show what a score
    detects at equal length.
    """
    return auroc(lengths, good) in (0.0, 1.0)


def length_strata(lengths: Sequence[float] | Floats, n_strata: int = 5) -> Indices:
    """Divide episodes into strata by quantiles of length.

    Args:
        lengths: (n,) length of each episode.
        n_strata: number of strata; ties can make it fewer.

    Returns:
        (n,) stratum of each episode. Equal lengths are always in one stratum.
    """
    values = np.asarray(lengths, dtype=np.float64)
    inner = np.quantile(values, np.arange(1, n_strata) / n_strata, method="lower")
    strata: Indices = np.searchsorted(np.unique(inner), values).astype(np.int64)
    return strata


@dataclass(frozen=True)
class WithinStrata:
    """An association within strata, and its permutation test.

    Attributes:
        value: the statistic: an AUROC, or a rank correlation.
        p: two-sided, (1 + as extreme) / (1 + permutations).
        n_compared: number of episodes in the strata that allow a comparison.
    """

    value: float
    p: float
    n_compared: int


def label_test_within(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Mask,
    strata: Sequence[int] | Indices,
    *,
    seed: int = 0,
    n_permutations: int = 9999,
) -> WithinStrata | None:
    """Test whether the score tells good from bad within strata (of about equal length).

    The statistic is the AUROC over the pairs within a stratum. Labels are permuted within strata.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        strata: (n,) stratum of each episode.
        seed: seed of the permutations.
        n_permutations: number of permutations.

    Returns:
        The AUROC within strata and its p, or None if no stratum holds both kinds.

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.

    Source: van Elteren, Bull. ISI 37:351-361, 1960, with weights that make it an AUROC; the p is
    that of Davison, Hinkley, Bootstrap Methods, 1997, equation 4.11.
    """
    values, flags = checked(scores, good)
    groups = np.asarray(strata)
    parts: list[tuple[Floats, Mask]] = []
    pairs = least = 0.0
    for stratum in np.unique(groups):
        inside = groups == stratum
        n, n_good = int(inside.sum()), int(flags[inside].sum())
        if 0 < n_good < n:
            parts.append((mid_ranks(-values[inside]), flags[inside]))
            pairs += n_good * (n - n_good)
            least += n_good * (n_good + 1) / 2
    if not parts:
        return None
    observed = sum(float(ranks[chosen].sum()) for ranks, chosen in parts) - least
    rng = np.random.default_rng(seed)
    n_extreme, n_compared = 0, sum(len(ranks) for ranks, _ in parts)
    for size in block_sizes(n_permutations, n_compared):
        drawn = np.full(size, -least)
        for ranks, chosen in parts:
            drawn += rng.permuted(np.tile(chosen, (size, 1)), axis=1) @ ranks
        n_extreme += count_as_extreme(drawn - pairs / 2, observed - pairs / 2)
    return WithinStrata(observed / pairs, (1 + n_extreme) / (1 + n_permutations), n_compared)


def correlation_test_within(
    scores: Sequence[float] | Floats,
    lengths: Sequence[float] | Floats,
    strata: Sequence[int] | Indices | Mask,
    *,
    seed: int = 0,
    n_permutations: int = 9999,
) -> WithinStrata | None:
    """Test whether the score follows length within strata (of equal label).

    The statistic is the correlation of ranks taken within each stratum. Lengths are permuted
    within strata.

    Args:
        scores: (n,) finite.
        lengths: (n,) length of each episode.
        strata: (n,) stratum of each episode, such as its label.
        seed: seed of the permutations.
        n_permutations: number of permutations.

    Returns:
        The correlation within strata and its p, or None if scores and lengths both vary in no
        stratum.
    """
    values = np.asarray(scores, dtype=np.float64)
    sizes, groups = np.asarray(lengths, dtype=np.float64), np.asarray(strata)
    parts: list[tuple[Floats, Floats]] = []
    for stratum in np.unique(groups):
        inside = groups == stratum
        if np.ptp(values[inside]) > 0 and np.ptp(sizes[inside]) > 0:
            ranks = [mid_ranks(-x[inside]) for x in (values, sizes)]
            parts.append((ranks[0] - ranks[0].mean(), ranks[1] - ranks[1].mean()))
    if not parts:
        return None
    observed = sum(float(a @ b) for a, b in parts)
    norm = math.sqrt(sum(float(a @ a) for a, _ in parts) * sum(float(b @ b) for _, b in parts))
    rng = np.random.default_rng(seed)
    n_extreme, n_compared = 0, sum(len(a) for a, _ in parts)
    for size in block_sizes(n_permutations, n_compared):
        drawn = np.zeros(size)
        for a, b in parts:
            drawn += rng.permuted(np.tile(b, (size, 1)), axis=1) @ a
        n_extreme += count_as_extreme(drawn, observed)
    return WithinStrata(observed / norm, (1 + n_extreme) / (1 + n_permutations), n_compared)
