"""Tests of a difference between conditions, and the smallest difference they would find."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.permutations import ROUNDING
from curation_ros.core.types import Floats

#: Up to this many seeds all sign changes are enumerated. Above, this many are drawn.
_EXHAUSTIVE_SEEDS, _N_FLIPS = 16, 65_536


def sign_flip_p(differences: Sequence[float] | Floats, *, seed: int = 0) -> float:
    """Two-sided p of a mean difference: how often other signs give one as far from 0.

    The test is exact if, under the null hypothesis, each seed's difference is as likely to be x
    as -x. The start states stay as they are.

    Args:
        differences: (n,) paired difference of each training seed.
        seed: seed of the draws. Up to 16 differences nothing is drawn.

    Raises:
        ConfigError: if there is no difference.

    Source: Fisher, The Design of Experiments, 1935, section 21.
    """
    d = np.asarray(differences, dtype=np.float64)
    if not len(d):
        raise ConfigError("sign changes: no difference")
    limit = abs(float(d.sum())) - ROUNDING
    if len(d) <= _EXHAUSTIVE_SEEDS:
        bits = np.arange(2 ** len(d))[:, None] >> np.arange(len(d)) & 1
        return float((np.abs((1 - 2 * bits) @ d) >= limit).mean())
    signs = np.random.default_rng(seed).choice((-1, 1), size=(_N_FLIPS, len(d)))
    n_extreme = int((np.abs(signs @ d) >= limit).sum())
    return (1 + n_extreme) / (1 + _N_FLIPS)


def holm(p_values: Mapping[str, float | None], n_planned: int | None = None) -> dict[str, float]:
    """Adjust p-values for the number of planned contrasts, by Holm's method.

    Args:
        p_values: contrast -> p. A contrast without data has None, and still counts.
        n_planned: number of planned contrasts; the default is the length of `p_values`.

    Returns:
        Contrast -> adjusted p, for the contrasts that have a p.

    Raises:
        ConfigError: if fewer contrasts were planned than are given, or a p is no probability.

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


def minimum_detectable_difference(
    sd_of_seeds: float, n_seeds: int, *, alpha: float = 0.05, power: float = 0.8
) -> float:
    """The true difference that a paired t-test over seeds would find with the given power.

    Args:
        sd_of_seeds: sample standard deviation of the seeds' paired differences.
        n_seeds: number of seeds, at least 2.
        alpha: two-sided level.
        power: probability of finding the difference.

    Returns:
        The difference, in the unit of `sd_of_seeds`. It is 0 for a deviation of 0, which only
        means that these seeds do not differ.

    Raises:
        ConfigError: if a number is out of range.

    Source: Cohen, Statistical Power Analysis, 1988, section 2.3, with the noncentral t.
    """
    if not (sd_of_seeds >= 0 and n_seeds >= 2 and 0 < alpha < power < 1):
        raise ConfigError(
            f"minimum detectable difference: deviation {sd_of_seeds!r}, {n_seeds!r} seeds, level "
            f"{alpha!r}, power {power!r}: expected at least 0, at least 2, 0 < level < power < 1"
        )
    from scipy.optimize import brentq  # takes a second to import; only studies need it
    from scipy.stats import nct, t

    df = n_seeds - 1
    critical = float(t.ppf(1 - alpha / 2, df))

    def lacking(noncentrality: float) -> float:
        # The other tail is below alpha / 2 and falls, so it is left out.
        return float(nct.sf(critical, df, noncentrality)) - power

    noncentrality = float(brentq(lacking, 0.0, 20 * critical))
    return sd_of_seeds * noncentrality / math.sqrt(n_seeds)
