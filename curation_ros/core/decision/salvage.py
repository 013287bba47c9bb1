"""The part of an episode that can be saved: of a bad recording, and of a failed task."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

#: Faults of known steps: the other steps are as good as without the fault. What another fault (a
#: hole, lost messages) has cost, only a person can tell.
CONFINED = ("padded-tail", "not-finite")
#: A shorter part of the episode than this share is no demonstration any more.
_LEAST_SHARE = 0.5
#: A good beginning ends this long before the break, unless configured otherwise.
DEFAULT_MARGIN_S = 0.75
#: A beginning shorter than this shows nothing of a task.
LEAST_PREFIX_S = 1.0


def sound_part(episode: Episode, faults: Iterable[Finding]) -> tuple[int, int] | None:
    """First and last step of what is left after damaged ends are cut off.

    Args:
        episode: the whole episode.
        faults: its findings that need a person.

    Returns:
        None if nothing is damaged, a fault damages more than the ends, or too little is left.
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
    whole = last - first + 1 == len(steps)  # a damaged step lies between good ones
    if not whole or len(steps) < max(2.0, _LEAST_SHARE * len(episode)):
        return None
    return first, last


def good_prefix(episode: Episode, broke_at: int, margin_s: float) -> tuple[int, int] | None:
    """First and last step of the beginning of an episode, up to a margin before it broke.

    Args:
        episode: the whole episode.
        broke_at: step at which something went wrong.
        margin_s: the beginning ends at least this long before that step, in seconds of its stamps.

    Returns:
        None if less than LEAST_PREFIX_S is left.
    """
    until_ns = int(episode.stamps_ns[broke_at]) - max(1, round(margin_s * NS_PER_S))
    last = int(np.searchsorted(episode.stamps_ns, until_ns, side="right")) - 1
    if last < 1 or episode.stamps_ns[last] - episode.stamps_ns[0] < LEAST_PREFIX_S * NS_PER_S:
        return None
    return 0, last
