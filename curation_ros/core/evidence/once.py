"""Measurements that several scorers and checks share, computed once per episode."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, TypeVar

import numpy as np

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

_T = TypeVar("_T")


def once_per_episode(measure: Callable[[Episode], _T]) -> Callable[[Episode], _T]:
    """Keep what a function of an episode returns with that episode.

    An episode is immutable, so the answer never changes. It lives as long as the episode object.
    Copies, parts and pickles of the episode start without it. An error is not kept: the next
    call raises it anew. Two threads that ask at the same time may both compute the answer; both
    get the same object.

    Args:
        measure: a function of the episode alone. What it returns is shared by all callers, so it
            must be immutable; arrays, also in a tuple, become read-only here.

    Returns:
        The function, with its answers kept.
    """

    @wraps(measure)
    def kept(episode: Episode) -> _T:
        answers = episode.derived
        if measure not in answers:
            answer = measure(episode)
            for part in answer if isinstance(answer, tuple) else (answer,):
                if isinstance(part, np.ndarray):
                    part.setflags(write=False)
            answers.setdefault(measure, answer)
        found: _T = answers[measure]
        return found

    return kept
