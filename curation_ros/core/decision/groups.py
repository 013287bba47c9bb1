"""Whether scores fall into two groups, and where to cut between them."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Floats

#: How two groups are told from one: method -> its criterion. The only list.
METHODS: dict[str, str] = {
    "mixture": "two normal groups instead of one, by the Bayesian information criterion",
    "largest-gap": "a gap between neighbouring scores of twice the next largest",
}
#: Fewer scores than this are too few to find groups in.
MIN_SCORES = 8
# Kass and Raftery (1995) call 6 to 10 strong evidence, and more than 10 very strong.
_MIN_BIC_GAIN = 10.0
# Two normal groups make two humps if Ashman's D exceeds 2 (Ashman et al. 1994, equation 11). At 2
# one skewed group passes for two far too often: 47 % of exponential samples of 80. At 4 with the
# least share it is 0 %. Groups that people would cut between are further apart than that.
_MIN_ASHMAN_D = 4.0
_MIN_GROUP = 2
_MIN_SHARE = 0.1
_GAP_RATIO = 2.0
# Least spread of a group as a share of the range, because a group of equal scores has none.
_SPREAD_FLOOR = 1e-3
_CERTAIN = 0.95


@dataclass(frozen=True)
class Split:
    """Two groups of scores, or the reason why there is one.

    Attributes:
        cut: the upper group lies above it; None if there are no two groups.
        doubt: scores between these two, both excluded, may belong to either group.
        n_upper: scores above the cut.
        why: what was found, for people.
    """

    cut: float | None
    doubt: tuple[float, float]
    n_upper: int
    why: str


def split_scores(
    scores: Sequence[float], *, resolution: float = 0.0, method: str = "mixture"
) -> Split:
    """Look for two groups.

    Args:
        scores: finite, in any order.
        resolution: difference that counts as none (`Scorer.resolution`).
        method: one of METHODS.

    Returns:
        The split. With `mixture` the cut lies in the widest gap between the means of the groups.
        Scores that belong to neither group with 95 % are in doubt. With `largest-gap` none is in
        doubt.

    Raises:
        ConfigError: for a method that does not exist, or a score that is not finite.

    Source: Schwarz, Annals of Statistics 6:461-464, 1978 (BIC); Ashman, Bird, Zepf, Astronomical
    Journal 108:2348-2361, 1994 (that the groups make two humps).
    """
    if method not in METHODS:
        raise ConfigError(f"method {method!r} is none of {', '.join(METHODS)}")
    x = np.sort(np.asarray(scores, dtype=np.float64))
    if not np.isfinite(x).all():
        raise ConfigError("two groups: a score is not finite")
    if len(x) < MIN_SCORES:
        return _one(f"{len(x)} scores are too few to see groups in, {MIN_SCORES} are needed")
    if not x[-1] - x[0] > resolution:
        return _one("all scores are equal")
    return _mixture(x, resolution) if method == "mixture" else _largest_gap(x, resolution)


def _one(why: str) -> Split:
    return Split(None, (-math.inf, math.inf), 0, why)


def _largest_gap(x: Floats, resolution: float) -> Split:
    gaps = np.diff(x)
    order = np.argsort(gaps, kind="stable")
    first, second = int(order[-1]), float(gaps[order[-2]])
    widest = float(gaps[first])
    if widest <= resolution or widest < _GAP_RATIO * second:
        return _one(
            f"the widest gap between scores is {widest:.3g}, the next {second:.3g}: "
            f"less than {_GAP_RATIO:g} times"
        )
    cut = float(x[first] + x[first + 1]) / 2
    return Split(
        cut,
        (cut, cut),
        len(x) - first - 1,
        f"a gap of {widest:.3g} at {cut:.3g}, the next is {second:.3g}",
    )


def _mixture(x: Floats, resolution: float) -> Split:
    # Importing scikit-learn takes seconds, which only fitting a mixture needs.
    from sklearn.mixture import GaussianMixture

    scale = float(x[-1] - x[0])
    floor = max(resolution / scale, _SPREAD_FLOOR)
    z = (x - x[0]) / scale
    column = z[:, None]
    bic = []
    with warnings.catch_warnings():
        # It warns if it stops before its tolerance. Such a fit is compared like any other.
        warnings.simplefilter("ignore")
        for n in (1, 2):
            model = GaussianMixture(n, reg_covar=floor**2, n_init=3, random_state=0, max_iter=500)
            bic.append(float(model.fit(column).bic(column)))
    gain = bic[0] - bic[1]
    order = np.argsort(model.means_[:, 0])
    mean = model.means_[order, 0]
    sigma = np.sqrt(model.covariances_[order, 0, 0])
    weight = model.weights_[order]
    distance = float(math.sqrt(2) * (mean[1] - mean[0]) / math.hypot(*sigma))
    found = f"BIC gains {gain:.1f}, the groups are {distance:.1f} apart (Ashman's D)"
    if gain < _MIN_BIC_GAIN or distance < _MIN_ASHMAN_D:
        return _one(f"{found}; {_MIN_BIC_GAIN:g} and {_MIN_ASHMAN_D:g} are needed")
    inside = np.flatnonzero((z[:-1] < mean[1]) & (z[1:] > mean[0]))
    at = int(inside[np.argmax(np.diff(z)[inside])])
    n_upper = len(x) - at - 1
    least = max(_MIN_GROUP, math.ceil(_MIN_SHARE * len(x)))
    smaller = min(n_upper, len(x) - n_upper)
    if smaller < least:
        return _one(f"{found}; but one group has {smaller} of {len(x)}: fewer than {least}")
    grid = np.linspace(mean[0], mean[1], 2001)
    density = weight / sigma * np.exp(-0.5 * ((grid[:, None] - mean) / sigma) ** 2)
    upper = density[:, 1] / density.sum(axis=1)
    low = float(grid[np.flatnonzero(upper <= 1 - _CERTAIN)[-1]]) if upper[0] < 0.05 else mean[0]
    high = float(grid[np.flatnonzero(upper >= _CERTAIN)[0]]) if upper[-1] > 0.95 else mean[1]
    cut = float(z[at] + z[at + 1]) / 2
    # If the widest gap lies outside the band of doubt, the band is extended to it.
    low, high = min(low, cut), max(high, cut)
    return Split(
        float(x[0] + scale * cut),
        (float(x[0] + scale * low), float(x[0] + scale * high)),
        n_upper,
        found,
    )
