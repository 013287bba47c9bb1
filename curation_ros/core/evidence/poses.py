"""Poses of effector and objects, as a hold is followed through them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.types import NS_PER_S, Mask

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats

Point = Sequence[float]

#: With fewer changes of the pose in the approach its noise cannot be estimated ...
_MIN_NOISE_STEPS = 8
#: ... and is assumed to be this ...
_ASSUMED_NOISE_M = 0.01
#: ... unless the pose has not changed at all in so many steps: then it has no noise.
_MIN_STILL_STEPS = 20


class Poses:
    """Poses, phases and gripper command of an episode, per step.

    A hold is followed step by step. Lists of numbers are several times quicker for that than
    arrays, so both forms are kept.

    Attributes:
        times_s: (T,) seconds from the start of the episode; `seconds` is the same as a list.
        effector: (T, 3) positions in metres; `hands` is the same as a list.
        objects: field -> (T, 3) positions in metres; `places` is the same as lists.
        has_hand: per step, whether the effector's position is finite.
        has_place: field -> per step, whether the object's position is finite.
        labels: name of the phase per step; empty texts without carry phases.
        is_open: per step, whether the gripper is commanded to open; all False without a gripper.
    """

    def __init__(
        self, episode: Episode, effector: str, objects: Sequence[str], labels: dict[int, str]
    ) -> None:
        self.times_s = (episode.stamps_ns - episode.start_ns) / NS_PER_S
        self.effector = episode.fields[effector][:, :3]
        self.objects = {name: episode.fields[name][:, :3] for name in objects}
        self.hands: list[list[float]] = self.effector.tolist()
        self.places: dict[str, list[list[float]]] = {
            k: v.tolist() for k, v in self.objects.items()
        }
        self.has_hand = is_finite(self.effector).tolist()
        self.has_place = {k: is_finite(v).tolist() for k, v in self.objects.items()}
        self.seconds: list[float] = self.times_s.tolist()
        phase = episode.phase if labels else None
        self.labels = (
            [""] * len(episode)
            if phase is None
            else [labels.get(int(k), "") for k in np.nan_to_num(phase, nan=-1.0)]
        )
        try:
            self.is_open: list[bool] = (commanded(episode) > 0).tolist()
        except EpisodeError:  # without a gripper nothing shows that an object was released
            self.is_open = [False] * len(episode)


def is_finite(positions: Floats) -> Mask:
    """(n,) whether all numbers of a row are finite."""
    return np.asarray(np.isfinite(positions).all(axis=1))


def is_fresh(positions: Floats) -> Mask:
    """(n,) whether a position differs from the one before; the first one counts as fresh."""
    fresh = np.ones(len(positions), dtype=bool)
    fresh[1:] = (positions[1:] != positions[:-1]).any(axis=1)
    return fresh


def noise_m(positions: Floats) -> float:
    """Standard deviation of a position at rest, from its changes; robust against some motion.

    Args:
        positions: (n, 3) before the grasp, in metres.
    """
    steps = np.diff(positions[is_finite(positions)], axis=0)
    changed = steps.any(axis=1)
    if len(steps) >= _MIN_STILL_STEPS and not changed.any():
        return 0.0
    steps = steps[changed]  # a repeated position is no new sample
    if len(steps) < _MIN_NOISE_STEPS:
        return _ASSUMED_NOISE_M
    # 1.4826: from the median to the deviation of a normal distribution; sqrt 2: of a difference.
    return float(1.4826 * np.median(np.abs(steps)) / np.sqrt(2.0))
