"""Confidence intervals for a proportion."""

from __future__ import annotations

import math
import operator
from statistics import NormalDist

from scipy.special import betaincinv

from curation_ros.core.errors import ConfigError


def _check(successes: int, n: int, confidence: float) -> tuple[int, int]:
    try:
        successes, n = operator.index(successes), operator.index(n)
    except TypeError:
        raise ConfigError(f"{successes!r} of {n!r}: expected whole numbers") from None
    if not (n > 0 and 0 <= successes <= n):
        raise ConfigError(f"{successes} of {n}: expected 0 <= successes <= n and n > 0")
    if not 0 < confidence < 1:
        raise ConfigError(f"confidence {confidence!r}: expected a number between 0 and 1")
    return successes, n


def wilson(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Wilson's score interval: its coverage is right on average, so this is the one to show.

    Args:
        successes: number of successes.
        n: number of trials, positive.
        confidence: nominal coverage, between 0 and 1.

    Returns:
        Lower and upper bound. The lower is exactly 0 without a success. The upper is exactly 1
        without a failure.

    Raises:
        ConfigError: if a number is out of range.

    Source: Wilson, JASA 22:209-212, 1927.
    """
    successes, n = _check(successes, n, confidence)
    z = NormalDist().inv_cdf(0.5 + confidence / 2)
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == n else min(1.0, centre + half)
    return low, high


def clopper_pearson(successes: int, n: int, confidence: float = 0.95) -> tuple[float, float]:
    """Clopper and Pearson's exact interval: its coverage is never below the nominal one.

    Args:
        successes: number of successes.
        n: number of trials, positive.
        confidence: guaranteed coverage, between 0 and 1.

    Returns:
        Lower and upper bound.

    Raises:
        ConfigError: if a number is out of range.

    Source: Clopper, Pearson, Biometrika 26:404-413, 1934.
    """
    successes, n = _check(successes, n, confidence)
    tail = (1 - confidence) / 2
    low = 0.0 if successes == 0 else float(betaincinv(successes, n - successes + 1, tail))
    high = 1.0 if successes == n else float(betaincinv(successes + 1, n - successes, 1 - tail))
    return low, high
