"""How well a score tells good episodes from bad ones, and how much of that is length.

For evaluation only: labels come in here and nowhere else in the core. `good` is true for the
episodes that ought to be kept; higher scores are better, so AUROC 1 is a perfect ranking and 0 an
inverted one. Scores are finite: who abstained is left out, and counted, by the caller.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.ranks import mid_ranks
from curation_ros.core.types import Floats

Flags: TypeAlias = npt.NDArray[np.bool_]
Indices: TypeAlias = npt.NDArray[np.int64]

#: Permutations and resamples are drawn in blocks of about so many numbers.
_BLOCK = 2_000_000
#: Two statistics of a permutation that differ by rounding alone are equal.
_ROUNDING = 1e-9


def _check(scores: Sequence[float] | Floats, good: Sequence[bool] | Flags) -> tuple[Floats, Flags]:
    values, flags = np.asarray(scores, dtype=np.float64), np.asarray(good, dtype=np.bool_)
    if values.ndim != 1 or values.shape != flags.shape:
        raise ConfigError(f"scores {values.shape} and labels {flags.shape}: expected one of each")
    if not np.isfinite(values).all():
        raise ConfigError("a score is not finite: leave out what abstained")
    if flags.all() or not flags.any():
        raise ConfigError(f"{int(flags.sum())} of {len(flags)} are good: both kinds are needed")
    return values, flags


def _ranks(values: Floats) -> Floats:
    """(n,) mid-ranks from 1 for the lowest."""
    return mid_ranks(-values)


def auroc(scores: Sequence[float] | Floats, good: Sequence[bool] | Flags) -> float:
    """Probability that a good episode scores higher than a bad one; a tie counts half.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.

    Source: Mann, Whitney, Ann. Math. Statist. 18:50-60, 1947, by mid-ranks.
    """
    values, flags = _check(scores, good)
    n_good = int(flags.sum())
    u = float(_ranks(values)[flags].sum()) - n_good * (n_good + 1) / 2
    return u / (n_good * (len(flags) - n_good))


def auroc_interval(
    estimate: float, n_good: int, n_bad: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Score-type confidence interval of an AUROC: never of zero width, also at 0 and 1.

    It holds every value from which the estimate is less than z standard errors away, with the
    standard error *at that value*: at an estimate of 1 the lower bound still falls with the
    number of episodes, where an interval around the estimate (DeLong's, a bootstrap) would end
    at 1. The variance is that of Hanley and McNeil for exponential scores, with both numbers of
    episodes replaced by their mean, so that the interval mirrors when labels are exchanged.

    It takes the episodes to be independent; see `auroc_interval_over_clusters`.

    Args:
        estimate: the AUROC, from 0 to 1.
        n_good: good episodes that it is made of, positive.
        n_bad: bad ones, positive.
        confidence: nominal coverage, between 0 and 1.

    Raises:
        ConfigError: if the numbers make no sense.

    Source: Newcombe, Statist. Med. 25:559-573, 2006, method 5; the variance is that of his
    method 4, after Hanley, McNeil, Radiology 143:29-36, 1982.
    """
    if not (0 <= estimate <= 1 and n_good > 0 and n_bad > 0 and 0 < confidence < 1):
        raise ConfigError(
            f"AUROC {estimate!r} of {n_good!r} good and {n_bad!r} bad at {confidence!r}: expected "
            "an estimate from 0 to 1, positive numbers and a confidence between 0 and 1"
        )
    from scipy.optimize import brentq  # takes a second: only who audits waits for it

    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    others = (n_good + n_bad) / 2 - 1

    def half_width(value: float) -> float:
        spread = (1 - value) / (2 - value) + value / (1 + value)
        variance = value * (1 - value) * (1 + others * spread) / (n_good * n_bad)
        return z * math.sqrt(variance)

    def lower(best: float) -> float:
        """Lower bound; half_width(1) is 0, so that at an estimate of 1 the value 1 is a root."""
        inside = best * (1 - 1e-12)
        return float(brentq(lambda v: v + half_width(v) - best, 0.0, inside, xtol=1e-15))

    low = lower(estimate) if estimate > 0 else 0.0
    high = 1.0 - lower(1.0 - estimate) if estimate < 1 else 1.0
    return min(low, estimate), max(high, estimate)


def auroc_interval_over_clusters(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Flags,
    clusters: Sequence[Hashable],
    *,
    seed: int = 0,
    n_resamples: int = 2000,
    confidence: float = 0.95,
) -> tuple[float, float] | None:
    """Percentile interval of an AUROC by a bootstrap over groups of episodes.

    Episodes of one start state are not independent; whole starts are drawn with replacement.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        clusters: (n,) the group of each episode.
        seed: of the resampling.
        n_resamples: number of draws; those that hold one kind of episode only do not count.
        confidence: nominal coverage.

    Returns:
        The interval; None where it says nothing: no group holds more than one episode, or every
        resample gives the same value (a ranking without a fault stays one in every resample).

    Source: Efron, Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13, on groups.
    """
    values, flags = _check(scores, good)
    names = sorted(set(clusters), key=repr)
    index_of = {name: k for k, name in enumerate(names)}
    group = np.array([index_of[c] for c in clusters])
    n_groups = len(names)
    if n_groups == len(values) or n_groups < 2:
        return None
    n_good = np.bincount(group[flags], minlength=n_groups).astype(np.float64)
    n_bad = np.bincount(group[~flags], minlength=n_groups).astype(np.float64)
    wins = np.zeros((n_groups, n_groups))
    for value, own in zip(values[flags], group[flags], strict=True):
        won = (value > values[~flags]) + 0.5 * (value == values[~flags])
        wins[own] += np.bincount(group[~flags], weights=won, minlength=n_groups)
    rng = np.random.default_rng(seed)
    found = []
    for size in _blocks(n_resamples, n_groups):
        times = rng.multinomial(n_groups, np.full(n_groups, 1 / n_groups), size=size)
        pairs = (times @ n_good) * (times @ n_bad)
        won = ((times @ wins) * times).sum(axis=1)
        found.append(won[pairs > 0] / pairs[pairs > 0])
    resampled = np.concatenate(found)
    if not len(resampled) or np.ptp(resampled) < _ROUNDING:
        return None
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(resampled, [tail, 100 - tail])
    return (float(low), float(high)) if high > low else None


def partial_auroc(
    scores: Sequence[float] | Floats, good: Sequence[bool] | Flags, max_fpr: float = 0.2
) -> float:
    """AUROC of the top of the ranking alone, up to a share of bad episodes let through.

    Standardised: 0.5 is chance and 1 is perfect, whatever `max_fpr`.

    Source: McClish, Med. Decis. Making 9:190-195, 1989, as scikit-learn computes it.
    """
    from sklearn.metrics import roc_auc_score  # takes seconds: only who audits waits for it

    values, flags = _check(scores, good)
    return float(roc_auc_score(flags, values, max_fpr=max_fpr))


@dataclass(frozen=True)
class Kept:
    """What is in the best K of a ranking; of equal scores at the cut, what is to be expected.

    Attributes:
        n_kept: K.
        precision: share of good ones among the kept.
        clean_recall: share of all good ones that are kept.
        tied_at_cut: share of the ranked episodes that have the score at which the cut runs, if
            some of them are kept and others are not; else 0.
        purity_ceiling: the precision of a perfect ranking at this K.
    """

    n_kept: int
    precision: float
    clean_recall: float
    tied_at_cut: float
    purity_ceiling: float


def kept(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Flags,
    n_kept: int,
    *,
    n_good: int | None = None,
) -> Kept:
    """Judge the best `n_kept` of a ranking.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        n_kept: number of episodes to keep.
        n_good: good episodes there are, those with no score among them; by default those ranked.

    Raises:
        ConfigError: if `n_kept` is not from 1 to the number of scores.
    """
    values, flags = _check(scores, good)
    if not 1 <= n_kept <= len(values):
        raise ConfigError(f"keep {n_kept}: expected 1 to {len(values)} scored episodes")
    total = int(flags.sum()) if n_good is None else n_good
    cut = np.sort(values)[len(values) - n_kept]
    above, at = values > cut, values == cut
    missing = n_kept - int(above.sum())
    expected = float(flags[above].sum() + missing * flags[at].mean())
    split = missing < int(at.sum())
    return Kept(
        n_kept=n_kept,
        precision=expected / n_kept,
        clean_recall=expected / total,
        tied_at_cut=float(at.mean()) if split else 0.0,
        purity_ceiling=min(total, n_kept) / n_kept,
    )


def rank_correlation(
    scores: Sequence[float] | Floats, lengths: Sequence[float] | Floats
) -> tuple[float, float] | None:
    """Spearman's rank correlation with its two-sided p; None where one of both is constant."""
    a, b = np.asarray(scores, dtype=np.float64), np.asarray(lengths, dtype=np.float64)
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    from scipy.stats import spearmanr  # takes seconds: only who audits waits for it

    result = spearmanr(a, b)
    return float(result.statistic), float(result.pvalue)


def separates(lengths: Sequence[float] | Floats, good: Sequence[bool] | Flags) -> bool:
    """Whether every good episode is shorter than every bad one, or every one longer.

    Then no two episodes of different label are of equal length, and what a score tells at equal
    length is a question that the data cannot answer.
    """
    return auroc(lengths, good) in (0.0, 1.0)


def length_strata(lengths: Sequence[float] | Floats, n_strata: int = 5) -> Indices:
    """(n,) stratum of each episode, by quantiles of length; equal lengths are never parted."""
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
        n_compared: episodes in the strata that have anything to compare.
    """

    value: float
    p: float
    n_compared: int


def label_test_within(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Flags,
    strata: Sequence[int] | Indices,
    *,
    seed: int = 0,
    n_permutations: int = 9999,
) -> WithinStrata | None:
    """Does the score tell good from bad among episodes of one stratum (of about equal length)?

    The statistic is the AUROC over the pairs within a stratum; labels are permuted within strata.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        strata: (n,) stratum of each episode.
        seed: of the permutations.
        n_permutations: how many.

    Returns:
        The AUROC within strata and its p; None where no stratum holds both kinds.

    Source: van Elteren, Bull. ISI 37:351-361, 1960, with weights that make it an AUROC; the p is
    that of Davison, Hinkley, Bootstrap Methods, 1997, equation 4.11.
    """
    values, flags = _check(scores, good)
    groups = np.asarray(strata)
    parts: list[tuple[Floats, Flags]] = []
    pairs = least = 0.0
    for stratum in np.unique(groups):
        inside = groups == stratum
        n, n_good = int(inside.sum()), int(flags[inside].sum())
        if 0 < n_good < n:
            parts.append((_ranks(values[inside]), flags[inside]))
            pairs += n_good * (n - n_good)
            least += n_good * (n_good + 1) / 2
    if not parts:
        return None
    seen = sum(float(ranks[chosen].sum()) for ranks, chosen in parts) - least
    rng = np.random.default_rng(seed)
    extreme, n_compared = 0, sum(len(ranks) for ranks, _ in parts)
    for size in _blocks(n_permutations, n_compared):
        drawn = np.full(size, -least)
        for ranks, chosen in parts:
            drawn += rng.permuted(np.tile(chosen, (size, 1)), axis=1) @ ranks
        extreme += _as_extreme(drawn - pairs / 2, seen - pairs / 2)
    return WithinStrata(seen / pairs, (1 + extreme) / (1 + n_permutations), n_compared)


def correlation_test_within(
    scores: Sequence[float] | Floats,
    lengths: Sequence[float] | Floats,
    strata: Sequence[int] | Indices | Flags,
    *,
    seed: int = 0,
    n_permutations: int = 9999,
) -> WithinStrata | None:
    """Does the score follow length among episodes of one stratum (of one label)?

    The statistic is the rank correlation with ranks taken within each stratum; lengths are
    permuted within strata.

    Args:
        scores: (n,) finite.
        lengths: (n,) length of each episode.
        strata: (n,) stratum of each episode, its label.
        seed: of the permutations.
        n_permutations: how many.

    Returns:
        The correlation within strata and its p; None where in no stratum both vary.
    """
    values = np.asarray(scores, dtype=np.float64)
    sizes, groups = np.asarray(lengths, dtype=np.float64), np.asarray(strata)
    parts: list[tuple[Floats, Floats]] = []
    for stratum in np.unique(groups):
        inside = groups == stratum
        if np.ptp(values[inside]) > 0 and np.ptp(sizes[inside]) > 0:
            ranks = [_ranks(x[inside]) for x in (values, sizes)]
            parts.append((ranks[0] - ranks[0].mean(), ranks[1] - ranks[1].mean()))
    if not parts:
        return None
    seen = sum(float(a @ b) for a, b in parts)
    norm = math.sqrt(sum(float(a @ a) for a, _ in parts) * sum(float(b @ b) for _, b in parts))
    rng = np.random.default_rng(seed)
    extreme, n_compared = 0, sum(len(a) for a, _ in parts)
    for size in _blocks(n_permutations, n_compared):
        drawn = np.zeros(size)
        for a, b in parts:
            drawn += rng.permuted(np.tile(b, (size, 1)), axis=1) @ a
        extreme += _as_extreme(drawn, seen)
    return WithinStrata(seen / norm, (1 + extreme) / (1 + n_permutations), n_compared)


def _as_extreme(drawn: Floats, seen: float) -> int:
    return int((np.abs(drawn) >= abs(seen) * (1 - _ROUNDING) - _ROUNDING).sum())


def _blocks(n: int, width: int) -> list[int]:
    """Sizes of blocks that make up n rows of a width."""
    size = max(1, _BLOCK // max(1, width))
    return [min(size, n - at) for at in range(0, n, size)]
