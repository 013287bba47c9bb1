"""What counts of policies' successes can say: the training seed is the unit of every claim.

Rollouts of one policy are not independent evidence about a selection: another training seed gives
another policy. So intervals resample seeds and start states crossed, p-values permute seeds, and
nothing here pools rollouts. Outcomes are keyed by (seed, start), never by position; a pair that is
missing is left out, and counted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import TypeAlias

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.intervals import clopper_pearson
from curation_ros.core.statistics.ranks import mid_ranks
from curation_ros.core.types import Floats, Mask

#: (training seed, start) -> whether the rollout succeeded.
Outcomes: TypeAlias = Mapping[tuple[int, str], bool]
Interval: TypeAlias = tuple[float, float]

N_DRAWS = 10_000
#: All permutations are gone through up to so many conditions (9! = 362 880); above, so many drawn.
_EXHAUSTIVE_RANKS, _N_PERMUTATIONS = 9, 99_999
#: All sign changes are gone through up to so many seeds; above, so many are drawn.
_EXHAUSTIVE_SEEDS, _N_FLIPS = 16, 65_536
#: Two statistics that differ by rounding alone are equal.
_ROUNDING = 1e-9
#: Seeds at or beyond these count as failing and as working, to show what is bimodal.
LOW, HIGH = 0.2, 0.8


@dataclass(frozen=True)
class Estimate:
    """A success rate, or a difference of two.

    Attributes:
        value: mean over the seeds' own means.
        interval: None with fewer than two seeds: nothing is known of other seeds then.
        n_seeds, n_starts: that it is made of.
        n_rollouts: (seed, start) pairs with an outcome; with a difference, in both conditions.
        n_unpaired: outcomes of one condition that have no partner in the other.
        is_degenerate: whether every outcome is the same, so that `interval` is a bound of its own
            and no bootstrap.
    """

    value: float
    interval: Interval | None
    n_seeds: int
    n_starts: int
    n_rollouts: int
    n_unpaired: int = 0
    is_degenerate: bool = False


@dataclass(frozen=True)
class Contrast:
    """Condition a against condition b, paired by training seed and start state.

    Attributes:
        estimate: of a's success minus b's.
        p: two-sided, exact, by changing signs of the seeds' differences.
        p_floor: the smallest p that so many seeds can give.
        sd_of_seeds: sample standard deviation of the seeds' differences; None with one seed.
        minimum_detectable: see `minimum_detectable_difference`; None with one seed.
    """

    estimate: Estimate
    p: float
    p_floor: float
    sd_of_seeds: float | None
    minimum_detectable: float | None


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rho over a handful of conditions.

    Attributes:
        rho: from -1 to 1.
        p: two-sided, over all permutations of the ranks (drawn ones above 9 conditions).
        interval: None below 4 conditions, where there is none.
        n: conditions.
        is_exact: whether all permutations were gone through.
    """

    rho: float
    p: float
    interval: Interval | None
    n: int
    is_exact: bool


@dataclass(frozen=True)
class SeedCount:
    """Rollouts of the policy of one training seed."""

    seed: int
    successes: int
    n: int


@dataclass(frozen=True)
class Modes:
    """How many seeds' policies fail (at most LOW), work (at least HIGH), or neither."""

    low: int
    middle: int
    high: int

    @property
    def is_bimodal(self) -> bool:
        """Whether some fail and some work, so that a mean describes none of them."""
        return self.low > 0 and self.high > 0


def seed_counts(outcomes: Outcomes) -> list[SeedCount]:
    """Raw counts of each seed, in the order of the seeds."""
    found: dict[int, list[bool]] = {}
    for (seed, _), success in outcomes.items():
        found.setdefault(seed, []).append(success)
    return [SeedCount(seed, sum(found[seed]), len(found[seed])) for seed in sorted(found)]


def modes(counts: Sequence[SeedCount]) -> Modes:
    """What the policies of single seeds do, where a mean would hide it."""
    rates = [c.successes / c.n for c in counts if c.n]
    low = sum(rate <= LOW + _ROUNDING for rate in rates)
    high = sum(rate >= HIGH - _ROUNDING for rate in rates)
    return Modes(low, len(rates) - low - high, high)


def deviations(values: Sequence[float]) -> tuple[float | None, float]:
    """Sample and population standard deviation; the paper's is the population's.

    Args:
        values: at least one, one a seed.

    Returns:
        With n - 1 (None for one value) and with n in the denominator.

    Raises:
        ConfigError: if there is no value.
    """
    if not len(values):
        raise ConfigError("standard deviation: no value")
    array = np.asarray(values, dtype=np.float64)
    return (float(array.std(ddof=1)) if len(array) > 1 else None), float(array.std())


def success_rate(
    outcomes: Outcomes, *, seed: int = 0, n_draws: int = N_DRAWS, confidence: float = 0.95
) -> Estimate:
    """Success rate of a condition, for other training seeds and other starts of the same kind.

    Args:
        outcomes: of the rollouts that there are.
        seed: of the bootstrap.
        n_draws: of the bootstrap.
        confidence: nominal coverage.

    Raises:
        ConfigError: if there is no outcome, or a number makes no sense.
    """
    table, mask = _table({k: float(v) for k, v in outcomes.items()}, "success rate")
    return _estimate(table, mask, 0.0, 1.0, seed, n_draws, confidence)


def contrast(
    a: Outcomes,
    b: Outcomes,
    *,
    seed: int = 0,
    n_draws: int = N_DRAWS,
    confidence: float = 0.95,
    power: float = 0.8,
) -> Contrast:
    """Success of condition a minus that of condition b, on seeds and starts that both have.

    The interval is a hierarchical bootstrap: training seeds and start states are drawn with
    replacement, crossed (every drawn seed on every drawn start), and a difference goes with its
    seed and start. Percentiles are widened for the few seeds. The p is no bootstrap's: with ten
    seeds its tail is not to be trusted as far out as Holm's method looks.

    Args:
        a: outcomes by (seed, start).
        b: the same of the other condition.
        seed: of the bootstrap.
        n_draws: of the bootstrap.
        confidence: nominal coverage.
        power: of the minimum detectable difference.

    Raises:
        ConfigError: if they have no seed and start in common, or a number makes no sense.

    Source: Davison, Hinkley, Bootstrap Methods, 1997, section 3.8 (two-way resampling);
    Hesterberg, Am. Stat. 69:371-386, 2015, section 5.3 (expanded percentile interval).
    """
    both = a.keys() & b.keys()
    differences = {key: float(a[key]) - float(b[key]) for key in both}
    table, mask = _table(differences, "contrast: pairs of the same seed and start")
    estimate = _estimate(table, mask, -1.0, 1.0, seed, n_draws, confidence)
    n_unpaired = len(a) + len(b) - 2 * len(both)
    estimate = Estimate(**{**vars(estimate), "n_unpaired": n_unpaired})
    means = table.sum(axis=1) / mask.sum(axis=1)
    sd, detectable = None, None
    if len(means) > 1:
        sd = float(means.std(ddof=1))
        alpha = 1 - confidence
        detectable = minimum_detectable_difference(sd, len(means), alpha=alpha, power=power)
    return Contrast(estimate, sign_flip_p(means), 2.0 ** (1 - len(means)), sd, detectable)


def sign_flip_p(differences: Sequence[float] | Floats, *, seed: int = 0) -> float:
    """Two-sided p of the mean difference: how often other signs give one as far from 0.

    Exact where, under the null hypothesis, each seed's difference is as likely to be x as -x. The
    starts stay as they are.

    Args:
        differences: (n,) of each training seed, paired.
        seed: of the draws, of which there are none up to 16 seeds.

    Raises:
        ConfigError: if there is no difference.

    Source: Fisher, The Design of Experiments, 1935, section 21.
    """
    d = np.asarray(differences, dtype=np.float64)
    if not len(d):
        raise ConfigError("sign changes: no difference")
    limit = abs(float(d.sum())) - _ROUNDING
    if len(d) <= _EXHAUSTIVE_SEEDS:
        bits = np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1
        return float((np.abs((1 - 2 * bits) @ d) >= limit).mean())
    signs = np.random.default_rng(seed).choice((-1, 1), size=(_N_FLIPS, len(d)))
    extreme = int((np.abs(signs @ d) >= limit).sum())
    return (1 + extreme) / (1 + _N_FLIPS)


def holm(p_values: Mapping[str, float | None], n_planned: int | None = None) -> dict[str, float]:
    """p-values adjusted for how many contrasts were planned, by Holm's method.

    Args:
        p_values: contrast -> p; None where it could not be made: it counts all the same.
        n_planned: contrasts planned, where more than stand in `p_values`.

    Returns:
        Contrast -> adjusted p, of those that have one.

    Raises:
        ConfigError: if fewer were planned than there are, or a p is no probability.

    Source: Holm, Scand. J. Statist. 6:65-70, 1979.
    """
    n = len(p_values) if n_planned is None else n_planned
    known = {name: p for name, p in p_values.items() if p is not None}
    if n < len(p_values) or not all(0 <= p <= 1 for p in known.values()):
        raise ConfigError(f"Holm's method: {n} planned, p-values {dict(p_values)}")
    adjusted, largest = {}, 0.0
    for rank, name in enumerate(sorted(known, key=lambda k: (known[k], k))):
        largest = max(largest, min(1.0, (n - rank) * known[name]))
        adjusted[name] = largest
    return {name: adjusted[name] for name in known}


def rank_correlation_exact(
    x: Sequence[float], y: Sequence[float], *, seed: int = 0, confidence: float = 0.95
) -> RankCorrelation | None:
    """Spearman's rho of two figures over a handful of conditions, with ties as mid-ranks.

    Args:
        x: (n,) a figure of every condition.
        y: (n,) another one.
        seed: of drawn permutations, of which there are none up to 9 conditions.
        confidence: nominal coverage of the interval.

    Returns:
        None with fewer than 3 conditions, or where one of both figures is constant.

    Raises:
        ConfigError: if the lengths differ or a figure is not finite.

    Source: the interval is Bonett and Wright's, Psychometrika 65:23-28, 2000, on Fisher's scale.
    At -1 and 1, where that has no width, it is the one of the next rho that n conditions without
    ties can have.
    """
    if len(x) != len(y):
        raise ConfigError(f"rank correlation: {len(x)} and {len(y)} figures")
    a, b = mid_ranks(x), mid_ranks(y)
    n = len(a)
    if n < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    a, b = a - a.mean(), b - b.mean()
    norm = math.sqrt(float(a @ a) * float(b @ b))
    rho = float(np.clip(a @ b / norm, -1, 1))
    limit = abs(rho) * norm * (1 - _ROUNDING) - _ROUNDING
    is_exact = n <= _EXHAUSTIVE_RANKS
    if is_exact:
        orders = np.array(list(itertools.permutations(range(n))), dtype=np.int8)
        p = float((np.abs(b[orders] @ a) >= limit).mean())
    else:
        rng = np.random.default_rng(seed)
        drawn = rng.permuted(np.tile(b, (_N_PERMUTATIONS, 1)), axis=1) @ a
        p = (1 + int((np.abs(drawn) >= limit).sum())) / (1 + _N_PERMUTATIONS)
    return RankCorrelation(rho, p, _rho_interval(rho, n, confidence), n, is_exact)


def _rho_interval(rho: float, n: int, confidence: float) -> Interval | None:
    if n < 4:
        return None
    # Exchanging two neighbours takes 12 / (n (n^2 - 1)) from a rho of 1.
    inside = float(np.clip(rho, *np.array([-1, 1]) * (1 - 12 / (n * (n * n - 1)))))
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    half = z * math.sqrt((1 + inside * inside / 2) / (n - 3))
    low, high = math.tanh(math.atanh(inside) - half), math.tanh(math.atanh(inside) + half)
    return (-1.0 if rho <= -1 else low), (1.0 if rho >= 1 else high)


def gap_closed(success: float, baseline: float, oracle: float) -> float | None:
    """Share of the way from the baseline's success to the oracle's; below 0 and above 1 happen.

    Args:
        success: success rate of the condition.
        baseline: of training on everything.
        oracle: of training on what is known to be good.

    Returns:
        None where the oracle is not above the baseline: then there is no gap to close.
    """
    gap = oracle - baseline
    return None if gap <= _ROUNDING else (success - baseline) / gap


def minimum_detectable_difference(
    sd_of_seeds: float, n_seeds: int, *, alpha: float = 0.05, power: float = 0.8
) -> float:
    """The true difference that a paired t-test over seeds would find with the given power.

    Args:
        sd_of_seeds: sample standard deviation of the seeds' paired differences.
        n_seeds: seeds, at least 2.
        alpha: two-sided level.
        power: probability of finding it.

    Returns:
        In the unit of `sd_of_seeds`; 0 for a deviation of 0, which only says that these seeds
        do not differ.

    Raises:
        ConfigError: if a number makes no sense.

    Source: Cohen, Statistical Power Analysis, 1988, section 2.3, with the noncentral t.
    """
    if not (sd_of_seeds >= 0 and n_seeds >= 2 and 0 < alpha < power < 1):
        raise ConfigError(
            f"minimum detectable difference: deviation {sd_of_seeds!r}, {n_seeds!r} seeds, level "
            f"{alpha!r}, power {power!r}: expected at least 0, at least 2, 0 < level < power < 1"
        )
    from scipy.optimize import brentq  # takes a second: only who asks waits for it
    from scipy.stats import nct, t

    df = n_seeds - 1
    critical = float(t.ppf(1 - alpha / 2, df))

    def lacking(noncentrality: float) -> float:
        # The other tail is below alpha / 2 and falls: it is left out.
        return float(nct.sf(critical, df, noncentrality)) - power

    noncentrality = float(brentq(lacking, 0.0, 20 * critical))
    return sd_of_seeds * noncentrality / math.sqrt(n_seeds)


# --- the bootstrap ------------------------------------------------------------------------------


def _table(values: Mapping[tuple[int, str], float], what: str) -> tuple[Floats, Mask]:
    """(seeds, starts) values, 0 where there is none, and where there is one."""
    if not values:
        raise ConfigError(f"{what}: there are none")
    seeds = {s: k for k, s in enumerate(sorted({seed for seed, _ in values}))}
    starts = {s: k for k, s in enumerate(sorted({start for _, start in values}))}
    table, mask = np.zeros((len(seeds), len(starts))), np.zeros((len(seeds), len(starts)), bool)
    for (seed, start), value in values.items():
        table[seeds[seed], starts[start]], mask[seeds[seed], starts[start]] = value, True
    return table, mask


def _estimate(
    table: Floats,
    mask: Mask,
    lowest: float,
    highest: float,
    seed: int,
    n_draws: int,
    confidence: float,
) -> Estimate:
    if n_draws < 1 or not 0 < confidence < 1:
        raise ConfigError(f"bootstrap: {n_draws} draws at {confidence}: expected 1, 0 to 1")
    n_seeds, n_starts = table.shape
    value = float((table.sum(axis=1) / mask.sum(axis=1)).mean())
    known = table[mask]
    is_degenerate = bool(np.ptp(known) == 0)
    interval = None
    if n_seeds > 1 and is_degenerate:
        interval = _bound(float(known[0]), lowest, highest, min(n_seeds, n_starts), confidence)
    elif n_seeds > 1:
        interval = _bootstrap(table, mask, seed, n_draws, confidence)
        interval = min(interval[0], value), max(interval[1], value)
    return Estimate(
        value, interval, n_seeds, n_starts, int(mask.sum()), is_degenerate=is_degenerate
    )


def _bootstrap(table: Floats, mask: Mask, seed: int, n_draws: int, confidence: float) -> Interval:
    """Expanded percentile interval of the mean over seeds, seeds and starts drawn crossed."""
    from scipy.special import stdtrit

    n_seeds, n_starts = table.shape
    rng = np.random.default_rng(seed)
    of_seeds = rng.multinomial(n_seeds, np.full(n_seeds, 1 / n_seeds), size=n_draws)
    of_starts = rng.multinomial(n_starts, np.full(n_starts, 1 / n_starts), size=n_draws)
    # Of each draw and seed, the mean over the drawn starts; a seed with none of them is left out.
    times = of_starts @ mask.T.astype(np.float64)
    means = np.divide(of_starts @ table.T, times, out=np.zeros_like(times), where=times > 0)
    weights = of_seeds * (times > 0)
    total = weights.sum(axis=1)
    drawn = (weights * means).sum(axis=1)[total > 0] / total[total > 0]
    # The spread of so few seeds is drawn too small; percentiles further out make up for it.
    t = float(stdtrit(n_seeds - 1, 0.5 + confidence / 2))
    tail = 100 * NormalDist().cdf(-math.sqrt(n_seeds / (n_seeds - 1)) * t)
    low, high = np.percentile(drawn, [tail, 100 - tail])
    return float(low), float(high)


def _bound(value: float, lowest: float, highest: float, n: int, confidence: float) -> Interval:
    """Bound for outcomes that are all alike: exact for one rollout a seed, a start each.

    How much seeds differ cannot be seen in such outcomes, so that more rollouts of the same seeds
    count for nothing here; a bootstrap would be of zero width.
    """
    # How far off the mean may be: one that would rarely show no other outcome in n.
    room = clopper_pearson(0, n, confidence)[1]
    return (
        max(lowest, value - room * (value - lowest > 0)),
        min(highest, value + room * (highest - value > 0)),
    )
