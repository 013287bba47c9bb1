"""How well a score tells good episodes from bad ones.

This is for evaluation only. Labels enter the core here and in `length_confound`, and nowhere
else. `good` is true for episodes that ought to be kept. Higher scores are better, so an AUROC of
1 is a perfect ranking and 0 an inverted one. Scores must be finite: the caller leaves out the
episodes on which a scorer abstained, and counts them.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.permutations import ROUNDING, block_sizes
from curation_ros.core.statistics.ranks import mid_ranks
from curation_ros.core.types import Floats, Mask


def checked(scores: Sequence[float] | Floats, good: Sequence[bool] | Mask) -> tuple[Floats, Mask]:
    """Scores and labels as arrays.

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.
    """
    values, flags = np.asarray(scores, dtype=np.float64), np.asarray(good, dtype=np.bool_)
    if values.ndim != 1 or values.shape != flags.shape:
        raise ConfigError(
            f"scores {values.shape} and labels {flags.shape}: expected one of each per episode"
        )
    if not np.isfinite(values).all():
        raise ConfigError("a score is not finite: leave out episodes without a score")
    if flags.all() or not flags.any():
        raise ConfigError(f"{int(flags.sum())} of {len(flags)} are good: both kinds are needed")
    return values, flags


def auroc(scores: Sequence[float] | Floats, good: Sequence[bool] | Mask) -> float:
    """Probability that a good episode scores higher than a bad one; a tie counts half.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.

    Source: Mann, Whitney, Ann. Math. Statist. 18:50-60, 1947, by mid-ranks.
    """
    values, flags = checked(scores, good)
    n_good = int(flags.sum())
    u = float(mid_ranks(-values)[flags].sum()) - n_good * (n_good + 1) / 2
    return u / (n_good * (len(flags) - n_good))


def auroc_interval(
    estimate: float, n_good: int, n_bad: int, confidence: float = 0.95
) -> tuple[float, float]:
    """Score-type confidence interval of an AUROC; it has a width even at 0 and 1.

    The interval holds every value from which the estimate is less than z standard errors away.
    The standard error is the one *at that value*. So at an estimate of 1 the lower bound still
    depends on the number of episodes. An interval around the estimate (DeLong's, a bootstrap)
    would shrink to the point 1. The variance is that of Hanley and McNeil for exponential scores.
    Both numbers of episodes are replaced by their mean there, so that the interval mirrors when
    labels are exchanged.

    The episodes are assumed to be independent. See `auroc_interval_over_clusters` if they are not.

    Args:
        estimate: the AUROC, from 0 to 1.
        n_good: number of good episodes, positive.
        n_bad: number of bad episodes, positive.
        confidence: nominal coverage, between 0 and 1.

    Raises:
        ConfigError: if a number is out of range.

    Source: Newcombe, Statist. Med. 25:559-573, 2006, method 5; the variance is that of his
    method 4, after Hanley, McNeil, Radiology 143:29-36, 1982.
    """
    if not (0 <= estimate <= 1 and n_good > 0 and n_bad > 0 and 0 < confidence < 1):
        raise ConfigError(
            f"AUROC {estimate!r} of {n_good!r} good and {n_bad!r} bad at {confidence!r}: expected "
            "an estimate from 0 to 1, positive numbers and a confidence between 0 and 1"
        )
    from scipy.optimize import brentq  # takes a second to import; only audits need it

    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    others = (n_good + n_bad) / 2 - 1

    def half_width(value: float) -> float:
        spread = (1 - value) / (2 - value) + value / (1 + value)
        variance = value * (1 - value) * (1 + others * spread) / (n_good * n_bad)
        return z * math.sqrt(variance)

    def lower(best: float) -> float:
        # half_width(1) is 0, so at an estimate of 1 the value 1 itself is a root: stay below it.
        inside = best * (1 - 1e-12)
        return float(brentq(lambda v: v + half_width(v) - best, 0.0, inside, xtol=1e-15))

    low = lower(estimate) if estimate > 0 else 0.0
    high = 1.0 - lower(1.0 - estimate) if estimate < 1 else 1.0
    return min(low, estimate), max(high, estimate)


def auroc_interval_over_clusters(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Mask,
    clusters: Sequence[Hashable],
    *,
    seed: int = 0,
    n_resamples: int = 2000,
    confidence: float = 0.95,
) -> tuple[float, float] | None:
    """Percentile interval of an AUROC by a bootstrap over groups of episodes.

    Episodes of one start state are not independent, so whole start states are drawn with
    replacement.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        clusters: (n,) the group of each episode.
        seed: seed of the resampling.
        n_resamples: number of draws. Draws that hold only good or only bad episodes are dropped.
        confidence: nominal coverage.

    Returns:
        The interval, or None if the bootstrap has nothing to say. That is so if every group has
        one episode, or if every resample gives the same value (as for a perfect ranking).

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.

    Source: Efron, Tibshirani, An Introduction to the Bootstrap, 1993, chapter 13, on groups.
    """
    values, flags = checked(scores, good)
    names = sorted(set(clusters), key=repr)
    index_of = {name: k for k, name in enumerate(names)}
    group = np.array([index_of[c] for c in clusters])
    n_groups = len(names)
    if n_groups == len(values) or n_groups < 2:
        return None
    n_good = np.bincount(group[flags], minlength=n_groups).astype(np.float64)
    n_bad = np.bincount(group[~flags], minlength=n_groups).astype(np.float64)
    # (good group, bad group): pairs in which the good episode scores higher.
    wins = np.zeros((n_groups, n_groups))
    for value, own in zip(values[flags], group[flags], strict=True):
        won = (value > values[~flags]) + 0.5 * (value == values[~flags])
        wins[own] += np.bincount(group[~flags], weights=won, minlength=n_groups)
    rng = np.random.default_rng(seed)
    aurocs = []
    for size in block_sizes(n_resamples, n_groups):
        times = rng.multinomial(n_groups, np.full(n_groups, 1 / n_groups), size=size)
        pairs = (times @ n_good) * (times @ n_bad)
        won = ((times @ wins) * times).sum(axis=1)
        aurocs.append(won[pairs > 0] / pairs[pairs > 0])
    resampled = np.concatenate(aurocs)
    if not len(resampled) or np.ptp(resampled) < ROUNDING:
        return None
    tail = 100 * (1 - confidence) / 2
    low, high = np.percentile(resampled, [tail, 100 - tail])
    return (float(low), float(high)) if high > low else None


def partial_auroc(
    scores: Sequence[float] | Floats, good: Sequence[bool] | Mask, max_fpr: float = 0.2
) -> float:
    """AUROC of the top of the ranking, up to a given share of bad episodes accepted.

    It is standardised: 0.5 is chance and 1 is perfect for any `max_fpr`.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        max_fpr: largest share of bad episodes accepted, between 0 and 1.

    Raises:
        ConfigError: if a score is not finite, the shapes differ, or one kind is missing.

    Source: McClish, Med. Decis. Making 9:190-195, 1989, as scikit-learn computes it.
    """
    from sklearn.metrics import roc_auc_score  # takes seconds to import; only audits need it

    values, flags = checked(scores, good)
    return float(roc_auc_score(flags, values, max_fpr=max_fpr))


@dataclass(frozen=True)
class Kept:
    """What the best K episodes of a ranking hold.

    Where the cut runs through episodes of equal score, the values are expectations over the order
    of these episodes.

    Attributes:
        n_kept: K.
        precision: share of good episodes among those kept.
        clean_recall: share of all good episodes that are kept.
        tied_at_cut: share of the ranked episodes that have the score at the cut, if some of them
            are kept and some are not; otherwise 0.
        purity_ceiling: the precision of a perfect ranking at this K.
    """

    n_kept: int
    precision: float
    clean_recall: float
    tied_at_cut: float
    purity_ceiling: float


def evaluate_kept(
    scores: Sequence[float] | Floats,
    good: Sequence[bool] | Mask,
    n_kept: int,
    *,
    n_good: int | None = None,
) -> Kept:
    """Evaluate the best `n_kept` episodes of a ranking.

    Args:
        scores: (n,) finite.
        good: (n,) whether the episode ought to be kept.
        n_kept: number of episodes to keep.
        n_good: number of good episodes, including those without a score. The default is the
            number of good episodes in `good`.

    Raises:
        ConfigError: if `n_kept` is not from 1 to the number of scores, or as in `auroc`.
    """
    values, flags = checked(scores, good)
    if not 1 <= n_kept <= len(values):
        raise ConfigError(f"keep {n_kept}: expected 1 to {len(values)} scored episodes")
    total = int(flags.sum()) if n_good is None else n_good
    cut = np.sort(values)[len(values) - n_kept]
    above, at = values > cut, values == cut
    missing = n_kept - int(above.sum())
    expected = float(flags[above].sum() + missing * flags[at].mean())
    is_split = missing < int(at.sum())
    return Kept(
        n_kept=n_kept,
        precision=expected / n_kept,
        clean_recall=expected / total,
        tied_at_cut=float(at.mean()) if is_split else 0.0,
        purity_ceiling=min(total, n_kept) / n_kept,
    )
