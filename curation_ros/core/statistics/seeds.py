"""What the policies of single training seeds do, where a mean would hide it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.statistics.permutations import ROUNDING
from curation_ros.core.statistics.success import Outcomes

#: A policy with at most the first rate counts as failing; with at least the second, as working.
FAILING, WORKING = 0.2, 0.8


@dataclass(frozen=True)
class SeedCount:
    """Rollouts of the policy of one training seed."""

    seed: int
    successes: int
    n: int


@dataclass(frozen=True)
class Modes:
    """How many policies fail (at most FAILING), work (at least WORKING), or neither."""

    low: int
    middle: int
    high: int


def seed_counts(outcomes: Outcomes) -> list[SeedCount]:
    """Raw counts of each seed, in the order of the seeds."""
    by_seed: dict[int, list[bool]] = {}
    for (seed, _), success in outcomes.items():
        by_seed.setdefault(seed, []).append(success)
    return [SeedCount(seed, sum(by_seed[seed]), len(by_seed[seed])) for seed in sorted(by_seed)]


def modes(counts: Sequence[SeedCount]) -> Modes:
    """Count the policies that fail, that work, and those in between."""
    rates = [c.successes / c.n for c in counts if c.n]
    low = sum(rate <= FAILING + ROUNDING for rate in rates)
    high = sum(rate >= WORKING - ROUNDING for rate in rates)
    return Modes(low, len(rates) - low - high, high)


def deviations(values: Sequence[float]) -> tuple[float | None, float]:
    """Sample and population standard deviation; the paper reports the latter.

    Args:
        values: one value per seed, at least one.

    Returns:
        The deviation with n - 1 in the denominator (None for one value), and with n.

    Raises:
        ConfigError: if there is no value.
    """
    if not len(values):
        raise ConfigError("standard deviation: no value")
    array = np.asarray(values, dtype=np.float64)
    return (float(array.std(ddof=1)) if len(array) > 1 else None), float(array.std())
