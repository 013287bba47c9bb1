"""Follows one grasped object step by step: carried, lost, put down, or no longer observable."""

from __future__ import annotations

from dataclasses import replace
from math import dist, hypot

import numpy as np

from curation_ros.core.evidence.grasp import Grasp
from curation_ros.core.evidence.holds import CARRY_PHASES, Hold, State
from curation_ros.core.evidence.poses import Point, Poses

#: The reference distance follows the present one within this time, as long as they differ by no
#: more than this: it follows an object that settles in the fingers, not one that leaves them.
_FOLLOW_S, _FOLLOW_M, _FOLLOW_NOISES = 0.5, 0.002, 1.0
#: Growth of the distance up to the allowance does not count. Growth beyond it adds up. No step
#: adds more than a share of the threshold, so that one outlier is never enough.
_ALLOWED_M, _ALLOWED_NOISES = 0.015, 0.5
_THRESHOLD_M, _THRESHOLD_NOISES = 0.012, 4.0
_STEP_SHARE = 0.6
#: After a command to open, an object is expected to leave. Unless it may have been put down, this
#: share of the threshold is enough then. It is more than one step can add: the gripper may have
#: opened for a moment only.
_OPENED_SHARE = 0.65
#: An object that slid through the fingers by more than this is not held as it was grasped.
_SLIP_M = 0.04
#: An object was carried at all if it went this far along the effector's way ...
_CARRIED_M = 0.02
#: ... and a hold counts only if the effector moved farther than this.
_MOVED_M = 0.03
#: A pose without news for this time is stale if the effector moved this far meanwhile.
_STALE_POSE_S, _STALE_POSE_MOVED_M = 0.5, 0.03
#: With less noise than this, a pose at rest may repeat itself exactly.
_STILL_NOISE_M = 0.002
#: Between two samples an object moves no farther than this beyond the effector's own motion and,
#: downwards, a free fall. After so many samples in a row that do, the pose has jumped.
_JUMP_M, _JUMP_NOISES, _JUMP_SAMPLES = 0.05, 4.0, 3
_GRAVITY_M_S2 = 9.81
#: Stamps of a tracker are this inexact: two samples may be that much farther apart in time.
_STAMP_ERROR_S = 0.05
#: The pose jumped to another object if it is as near as this to where that object was.
_PLACE_M = 0.03
#: An object that is released in the last carry phase and falls no farther than this was put down.
_PUT_DOWN_M = 0.02


class Departure:
    """Sequential test (CUSUM): is the object farther away than when it was held?

    Attributes:
        away_m: growth of the distance at the last sample.
    """

    def __init__(self, distance_m: float, noise_m: float) -> None:
        self._grasp_m = self._held_m = distance_m
        self._allowed_m = _ALLOWED_M + _ALLOWED_NOISES * noise_m
        self._threshold_m = _THRESHOLD_M + _THRESHOLD_NOISES * noise_m
        self._follow_m = _FOLLOW_M + _FOLLOW_NOISES * noise_m
        self._sum_m = 0.0
        self.away_m = 0.0

    @property
    def is_possible(self) -> bool:
        """Whether it may have begun to leave."""
        return self._sum_m > 0.0

    @property
    def is_likely(self) -> bool:
        """Whether it has left, given that other evidence agrees."""
        return self._sum_m > _OPENED_SHARE * self._threshold_m

    def is_near(self, distance_m: float) -> bool:
        """Whether an object at that distance may be held as it was."""
        return distance_m - self._held_m <= self._allowed_m

    def add(self, distance_m: float, after_s: float) -> bool:
        """Take a sample and return whether the departure is certain now.

        Args:
            distance_m: from effector to object.
            after_s: time since the sample before.
        """
        self.away_m = away_m = distance_m - self._held_m
        most_m = _STEP_SHARE * self._threshold_m
        self._sum_m = max(0.0, self._sum_m + min(away_m - self._allowed_m, most_m))
        towards_m = min(max(away_m, -self._follow_m), self._follow_m)
        self._held_m += towards_m * min(1.0, after_s / _FOLLOW_S)
        slip_m = self._held_m - self._grasp_m
        return self._sum_m > self._threshold_m or slip_m > _SLIP_M


class HoldTracker:
    """Follows one object from its grasp on.

    Args:
        grasp: of the object.
        first: step from which on it is to be carried.

    Attributes:
        state: as far as it is known by now.
    """

    def __init__(self, grasp: Grasp, first: int) -> None:
        self._grasp = grasp
        self._first = self._last = first
        self.state: State = "unknown" if grasp.reason else "carried"
        self._reason = grasp.reason
        self._is_over = bool(grasp.reason)
        self._departure = Departure(grasp.distance_m, grasp.noise_m)
        self._phase = ""
        self._departed: int | None = None
        self._noticed: int | None = None
        self._left_open = self._is_put_down = False
        self._opened_z: float | None = None
        #: The last sample that counted, and the last ones before the object may have begun to
        #: leave.
        self._place, self._place_s, self._place_step = grasp.at, float("nan"), first
        self._hand = self._held_hand = grasp.hand
        self._held_places = [grasp.at]
        self._fall_m_s = 0.0
        self._n_jumps = 0
        self._stale = ""
        self._moved_m = 0.0

    def take(self, poses: Poses, step: int) -> None:
        """Take one more step in which the object is to be carried."""
        self._last = step
        if not self._is_over and self._departed is None:
            self._phase = poses.labels[step]
        name = self._grasp.object
        if not name:
            return
        now_s = poses.seconds[step]
        if step == self._first:
            self._place_s = now_s
        if not poses.has_hand[step]:
            return
        hand, place = poses.hands[step], poses.places[name][step]
        self._moved_m = max(self._moved_m, dist(hand, self._grasp.hand))
        if self._opened_z is None and poses.is_open[step]:
            self._opened_z = float(np.median([z for _, _, z in self._held_places]))
        if not poses.has_place[name][step] or (place == self._place and not self._may_rest()):
            self._miss(now_s, hand)
            return
        if self._is_over:
            return
        if self._has_jumped(now_s, hand, place):
            self._n_jumps += 1
            if self._n_jumps >= _JUMP_SAMPLES:
                self._give_up(self._jump_text(poses, place))
            return
        self._n_jumps = 0
        self._update(now_s, step, hand, place)

    def _may_rest(self) -> bool:
        """Whether an object that repeats its position lies there, rather than being unobserved.

        Only if its pose has no noise and it has begun to leave: then it fell to that place.
        """
        return self._departure.is_possible and self._grasp.noise_m < _STILL_NOISE_M

    def _miss(self, now_s: float, hand: Point) -> None:
        """Take a step without a new pose of the object."""
        silent_s = now_s - self._place_s
        if silent_s >= _STALE_POSE_S and dist(hand, self._hand) >= _STALE_POSE_MOVED_M:
            self._stale = (
                f"no new pose of {self._grasp.object} for {_STALE_POSE_S:g} s from "
                f"{self._place_s:.2f} s on, while the effector moved"
            )

    def _update(self, now_s: float, step: int, hand: Point, place: Point) -> None:
        """Take a new pose of the object."""
        distance_m = dist(hand, place)
        if self._stale:
            if not self._departure.is_near(distance_m):  # it left while it was unobserved
                self._give_up(self._stale)
                return
            self._stale = ""
        after_s = now_s - self._place_s
        if after_s > 0.0:
            self._fall_m_s = max(0.0, (self._place[2] - place[2]) / after_s)
        self._place, self._place_s, self._place_step, self._hand = place, now_s, step, hand
        is_certain = self._departure.add(distance_m, after_s)
        if not self._departure.is_possible:
            self._departed, self._held_hand = None, hand
            self._held_places = [*self._held_places[-2:], place]
        elif self._departed is None:
            self._departed, self._left_open = step, self._opened_z is not None
        if is_certain or (self._departure.is_likely and self._is_released(place)):
            self._lose(step, place)

    def _lose(self, step: int, place: Point) -> None:
        """The object has left: dropped, put down, or never carried."""
        self._is_over = True
        if self._left_open and self._may_be_put_down(place):
            self._departed, self._is_put_down = None, True
            return
        self._noticed = step
        self._departed = step if self._departed is None else self._departed
        self.state = "broken" if self._carried_m() >= _CARRIED_M else "never"
        if self.state == "never" and self._grasp.unseen:
            name, unseen = self._grasp.object, self._grasp.unseen
            self._give_up(f"{name} was not carried, and {unseen} has no pose")

    def _is_released(self, place: Point) -> bool:
        """Whether the gripper was commanded to open where the object cannot be put down."""
        return self._opened_z is not None and not self._may_be_put_down(place)

    def _may_be_put_down(self, place: Point) -> bool:
        """Whether this is the last carry phase, and the object not lower than at the opening."""
        if self._opened_z is None or self._phase != CARRY_PHASES[-1]:
            return False
        return self._opened_z - place[2] < _PUT_DOWN_M + 2.0 * self._grasp.noise_m

    def _carried_m(self) -> float:
        """How far the object went along the effector's way before it began to leave."""
        way = np.subtract(self._held_hand, self._grasp.hand)
        went = np.median(self._held_places, axis=0) - self._grasp.at
        length_m = float(np.linalg.norm(way))
        return float(np.dot(went, way)) / length_m if length_m > 0.0 else 0.0

    def _has_jumped(self, now_s: float, hand: Point, place: Point) -> bool:
        free_m = _JUMP_M + _JUMP_NOISES * self._grasp.noise_m
        if dist(place, self._place) <= free_m:
            return False
        free_m += dist(hand, self._hand)
        dx, dy, dz = (a - b for a, b in zip(place, self._place, strict=True))
        after_s = now_s - self._place_s
        fall_m = self._fall_m_s * after_s + 0.5 * _GRAVITY_M_S2 * (after_s + _STAMP_ERROR_S) ** 2
        return hypot(dx, dy, max(dz, 0.0)) > free_m or -dz > free_m + fall_m

    def _jump_text(self, poses: Poses, place: Point) -> str:
        name = self._grasp.object
        for other, places in poses.places.items():
            near_m = dist(places[self._place_step], place)
            if other != name and near_m < _PLACE_M + 2.0 * self._grasp.noise_m:
                return f"the pose of {name} jumped to where {other} was"
        return f"the pose of {name} jumped by {dist(place, self._place):.2f} m"

    def _give_up(self, reason: str) -> None:
        self._is_over, self.state, self._reason = True, "unknown", reason
        self._departed = self._noticed = None

    def so_far(self) -> Hold:
        """What is known by now."""
        is_lost = self.state in ("broken", "never")
        stop = self._last + 1 if self._departed is None or not is_lost else self._departed
        return Hold(
            object=self._grasp.object,
            first=self._first,
            last=self._last,
            state=self.state,
            reason=self._reason,
            departed=self._departed if is_lost else None,
            noticed=self._noticed,
            phase=self._phase,
            n_carried=stop - self._first if self.state in ("carried", "broken") else 0,
            gap_m=self._departure.away_m if is_lost else 0.0,
            opened=is_lost and self._left_open,
        )

    def end(self) -> Hold | None:
        """End the hold, as nothing is to be carried any more.

        Returns:
            The hold; None if the effector hardly moved, so that it does not count.
        """
        if self._stale and not self._is_over:
            self._give_up(self._stale)
        hold = self.so_far()
        return None if hold.state == "carried" and self._moved_m < _MOVED_M else hold

    def end_of_episode(self) -> Hold | None:
        """End the hold where the episode ends before it; see `end`."""
        hold = self.end()
        if hold is None or hold.state != "carried" or self._is_put_down:
            return hold
        where = f"in {hold.phase}" if hold.phase else "with the gripper closed"
        text = f"it ends {where}, {hold.object} still held"
        return replace(hold, state="unknown", reason=text, n_carried=0)
