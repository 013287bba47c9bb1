"""Success rates of policies and their contrasts; every claim is about training seeds.

Rollouts of one policy are not independent evidence about a selection, because another training
seed gives another policy. So intervals resample seeds and start states crossed, and p-values
flip the signs of whole seeds. Nothing here pools rollouts. Outcomes are keyed by (seed, start),
never by position. A missing pair is left out and counted.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import TypeAlias

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.intervals import clopper_pearson
from curation_ros.core.statistics.permutations import ROUNDING
from curation_ros.core.statistics.significance import minimum_detectable_difference, sign_flip_p
from curation_ros.core.types import Floats, Mask

#: (training seed, start) -> whether the rollout succeeded.
Outcomes: TypeAlias = Mapping[tuple[int, str], bool]
Interval: TypeAlias = tuple[float, float]

N_DRAWS = 10_000


@dataclass(frozen=True)
class Estimate:
    """A success rate, or a difference of two.

    Attributes:
        value: mean over the seeds' own means.
        interval: confidence interval; None with one seed, which says nothing about other seeds.
        n_seeds, n_starts: number of training seeds and of start states.
        n_rollouts: (seed, start) pairs with an outcome; for a difference, in both conditions.
        n_unpaired: outcomes of one condition without a partner in the other.
        is_degenerate: whether all outcomes are the same; `interval` then comes from an exact
            bound instead of the bootstrap.
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
        estimate: a's success minus b's.
        p: two-sided, exact, by flipping the signs of the seeds' differences.
        p_floor: the smallest p that this number of seeds can give.
        sd_of_seeds: sample standard deviation of the seeds' differences; None with one seed.
        minimum_detectable: see `minimum_detectable_difference`; None with one seed.
    """

    estimate: Estimate
    p: float
    p_floor: float
    sd_of_seeds: float | None
    minimum_detectable: float | None


def success_rate(
    outcomes: Outcomes, *, seed: int = 0, n_draws: int = N_DRAWS, confidence: float = 0.95
) -> Estimate:
    """Success rate of a condition, for other training seeds and other starts of the same kind.

    Args:
        outcomes: outcome of each rollout that was done.
        seed: seed of the bootstrap.
        n_draws: number of draws of the bootstrap.
        confidence: nominal coverage.

    Raises:
        ConfigError: if there is no outcome, or a number is out of range.
    """
    table, mask = _table({k: float(v) for k, v in outcomes.items()}, "success rate")
    return _estimate(table, mask, (0.0, 1.0), seed, n_draws, confidence)


def contrast(
    a: Outcomes,
    b: Outcomes,
    *,
    seed: int = 0,
    n_draws: int = N_DRAWS,
    confidence: float = 0.95,
    power: float = 0.8,
) -> Contrast:
    """Success of condition a minus that of condition b, on the seeds and starts of both.

    The interval is a hierarchical bootstrap. Training seeds and start states are drawn with
    replacement, crossed: every drawn seed on every drawn start. A difference belongs to its seed
    and start. The percentiles are widened for small numbers of seeds. The p does not come from
    the bootstrap: with ten seeds its tail is not accurate as far out as Holm's method looks.

    Args:
        a: outcomes by (seed, start).
        b: the same for the other condition.
        seed: seed of the bootstrap.
        n_draws: number of draws of the bootstrap.
        confidence: nominal coverage.
        power: power of the minimum detectable difference.

    Raises:
        ConfigError: if they have no seed and start in common, or a number is out of range.

    Source: Davison, Hinkley, Bootstrap Methods, 1997, section 3.8 (two-way resampling);
    Hesterberg, Am. Stat. 69:371-386, 2015, section 5.3 (expanded percentile interval).
    """
    both = a.keys() & b.keys()
    differences = {key: float(a[key]) - float(b[key]) for key in both}
    table, mask = _table(differences, "contrast: pairs of the same seed and start")
    estimate = _estimate(table, mask, (-1.0, 1.0), seed, n_draws, confidence)
    estimate = replace(estimate, n_unpaired=len(a) + len(b) - 2 * len(both))
    means = table.sum(axis=1) / mask.sum(axis=1)
    sd, detectable = None, None
    if len(means) > 1:
        sd = float(means.std(ddof=1))
        detectable = minimum_detectable_difference(
            sd, len(means), alpha=1 - confidence, power=power
        )
    return Contrast(estimate, sign_flip_p(means), 2.0 ** (1 - len(means)), sd, detectable)


def gap_closed(success: float, baseline: float, oracle: float) -> float | None:
    """Share of the way from the baseline's success to the oracle's; it can leave 0 to 1.

    Args:
        success: success rate of the condition.
        baseline: success rate after training on everything.
        oracle: success rate after training on the demonstrations known to be good.

    Returns:
        None if the oracle is not above the baseline, as there is no gap to close.
    """
    gap = oracle - baseline
    return None if gap <= ROUNDING else (success - baseline) / gap


# --- the bootstrap ------------------------------------------------------------------------------


def _table(values: Mapping[tuple[int, str], float], what: str) -> tuple[Floats, Mask]:
    """(seeds, starts) values, 0 where one is missing, and a mask of those present."""
    if not values:
        raise ConfigError(f"{what}: there are none")
    seeds = {s: k for k, s in enumerate(sorted({seed for seed, _ in values}))}
    starts = {s: k for k, s in enumerate(sorted({start for _, start in values}))}
    table, mask = np.zeros((len(seeds), len(starts))), np.zeros((len(seeds), len(starts)), bool)
    for (seed, start), value in values.items():
        table[seeds[seed], starts[start]], mask[seeds[seed], starts[start]] = value, True
    return table, mask


def _estimate(
    table: Floats, mask: Mask, limits: Interval, seed: int, n_draws: int, confidence: float
) -> Estimate:
    """Mean over seeds with its interval; `limits` are the least and largest possible value."""
    if n_draws < 1 or not 0 < confidence < 1:
        raise ConfigError(
            f"bootstrap: {n_draws} draws at {confidence}: expected at least 1 draw and a "
            "confidence between 0 and 1"
        )
    n_seeds, n_starts = table.shape
    value = float((table.sum(axis=1) / mask.sum(axis=1)).mean())
    known = table[mask]
    is_degenerate = bool(np.ptp(known) == 0)
    interval = None
    if n_seeds > 1 and is_degenerate:
        interval = _bound(float(known[0]), limits, min(n_seeds, n_starts), confidence)
    elif n_seeds > 1:
        interval = _bootstrap(table, mask, seed, n_draws, confidence)
        interval = min(interval[0], value), max(interval[1], value)
    return Estimate(
        value, interval, n_seeds, n_starts, int(mask.sum()), is_degenerate=is_degenerate
    )


def _bootstrap(table: Floats, mask: Mask, seed: int, n_draws: int, confidence: float) -> Interval:
    """Expanded percentile interval of the mean over seeds; seeds and starts are drawn crossed."""
    from scipy.special import stdtrit

    n_seeds, n_starts = table.shape
    rng = np.random.default_rng(seed)
    seed_draws = rng.multinomial(n_seeds, np.full(n_seeds, 1 / n_seeds), size=n_draws)
    start_draws = rng.multinomial(n_starts, np.full(n_starts, 1 / n_starts), size=n_draws)
    # For each draw and seed, the mean over the drawn starts. A seed with no outcome on any of
    # them is left out.
    times = start_draws @ mask.T.astype(np.float64)
    means = np.divide(start_draws @ table.T, times, out=np.zeros_like(times), where=times > 0)
    weights = seed_draws * (times > 0)
    total = weights.sum(axis=1)
    drawn = (weights * means).sum(axis=1)[total > 0] / total[total > 0]
    # The bootstrap underestimates the spread of few seeds. Percentiles further out correct that.
    t = float(stdtrit(n_seeds - 1, 0.5 + confidence / 2))
    tail = 100 * NormalDist().cdf(-math.sqrt(n_seeds / (n_seeds - 1)) * t)
    low, high = np.percentile(drawn, [tail, 100 - tail])
    return float(low), float(high)


def _bound(value: float, limits: Interval, n: int, confidence: float) -> Interval:
    """Bound for outcomes that are all alike: exact for one rollout per seed, each on one start.

    Such outcomes do not show how much seeds differ, so more rollouts of the same seeds add
    nothing here. A bootstrap would have zero width.
    """
    lowest, highest = limits
    # How far off the mean can be if n outcomes rarely hide another one.
    room = clopper_pearson(0, n, confidence)[1]
    return (
        max(lowest, value - room * (value - lowest > 0)),
        min(highest, value + room * (highest - value > 0)),
    )
