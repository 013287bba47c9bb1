"""Which object was grasped, and where effector and object were then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from curation_ros.core.evidence.holds import GRASP_S
from curation_ros.core.evidence.poses import Point, Poses, is_finite, is_fresh, noise_m

#: An object farther from the effector than this is not the one that was grasped.
_REACH_M = 0.2
#: Two objects whose distances differ by less than this cannot be told apart.
_SAME_DISTANCE_M = 0.005


@dataclass(frozen=True)
class Grasp:
    """What was grasped, and the positions at that time.

    Attributes:
        object: its field; empty if it cannot be identified.
        reason: why it cannot be identified; else empty.
        unseen: an object of the map that has no pose; empty if all have one.
        distance_m: from effector to object.
        noise_m: standard deviation of the object's position at rest.
        hand, at: positions of effector and object, in metres.
    """

    object: str = ""
    reason: str = ""
    unseen: str = ""
    distance_m: float = 0.0
    noise_m: float = 0.0
    hand: Point = (0.0, 0.0, 0.0)
    at: Point = (0.0, 0.0, 0.0)


def grasp_at(poses: Poses, step: int) -> Grasp:
    """The grasp of the nearest object, for a hold that begins at a step."""
    first = int(np.searchsorted(poses.times_s, poses.times_s[step] - GRASP_S))
    hand = poses.effector[first : step + 1]
    near: list[tuple[float, float, str]] = []
    unseen = ""
    for name, positions in poses.objects.items():
        distance_m = np.linalg.norm(positions[first : step + 1] - hand, axis=1)
        fresh = is_fresh(positions[first : step + 1])
        distance_m = distance_m[fresh & np.isfinite(distance_m)]
        if len(distance_m):
            near.append((float(np.median(distance_m)), noise_m(positions[:step]), name))
        else:
            unseen = unseen or name
    if not near:
        return Grasp(reason=f"no pose of {' or '.join(poses.objects)} at the grasp")
    (nearest_m, deviation_m, name), *others = sorted(near)
    if nearest_m > _REACH_M:
        text = f"no object is within {_REACH_M:g} m of the effector at the grasp"
        return Grasp(reason=text + (f", and {unseen} has no pose" if unseen else ""))
    if others and others[0][0] - nearest_m < _SAME_DISTANCE_M + 2.0 * deviation_m:
        return Grasp(reason=f"which was grasped cannot be told: {name} or {others[0][2]}")
    at = poses.objects[name][first : step + 1]
    both = is_fresh(at) & is_finite(at) & is_finite(hand)
    return Grasp(
        object=name,
        unseen=unseen,
        distance_m=nearest_m,
        noise_m=deviation_m,
        hand=np.median(hand[both], axis=0).tolist(),
        at=np.median(at[both], axis=0).tolist(),
    )
