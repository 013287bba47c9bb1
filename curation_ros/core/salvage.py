"""What can be saved of an episode: for now, of a recording that is bad at its beginning or end."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.findings import Finding

if TYPE_CHECKING:
    from curation_ros.core.episode import Episode

#: Faults that say exactly which steps they spoil: the rest is as good as if they were not there.
#: Of all others (a hole, lost messages) only a person can say what they have cost.
CONFINED = ("padded-tail", "not-finite")
#: A part shorter than this share of the episode is no demonstration any more.
_LEAST_SHARE = 0.5


def sound_part(episode: Episode, faults: Iterable[Finding]) -> tuple[int, int] | None:
    """First and last step of what is left when spoilt ends are cut off.

    Args:
        episode: the episode, whole.
        faults: its findings that need a person.

    Returns:
        None where nothing is spoilt, a fault spoils more than an end, or too little is left.
    """
    found = list(faults)
    if not found or any(f.id not in CONFINED for f in found):
        return None
    good = np.ones(len(episode), dtype=bool)
    offsets = episode.stamps_ns - episode.start_ns
    for fault in found:
        if fault.id == "padded-tail":
            good &= ~((offsets >= fault.span[0]) & (offsets <= fault.span[1]))
    for values in episode.fields.values():
        good &= np.isfinite(values).all(axis=1)
    steps = np.flatnonzero(good)
    if len(steps) in (0, len(episode)):
        return None
    first, last = int(steps[0]), int(steps[-1])
    whole = last - first + 1 == len(steps)  # a spoilt step inside is no spoilt end
    if not whole or len(steps) < max(2.0, _LEAST_SHARE * len(episode)):
        return None
    return first, last
