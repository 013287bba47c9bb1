"""Whether a grasped object stays with the effector until it is let go: the invariant of a carry.

An object that is held by its rim turns about the point where it is held as it leaves the table:
its offset from the effector changes by 2 to 3 cm, and it is not dropped. Its *distance* from the
point where it is held does not change. So the distance from effector to object is what is
watched, by a sequential test that a noisy, late or patchy pose does not set off. The effector's
frame is to lie between the fingers (the tool centre point); in a frame at the flange the distance
of a turning object changes, too.

Everything here is causal: what is said of a step depends on steps before it alone, so that an
episode that is still running and the whole one give the same answers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist, hypot
from typing import TYPE_CHECKING, Literal

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.evidence.once import once_per_episode
from curation_ros.core.types import NS_PER_S, Mask

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import TopicMap
    from curation_ros.core.types import Floats

State = Literal["carried", "broken", "never", "unknown"]
Point = Sequence[float]

#: Phases in which what was grasped is to move with the effector, in their order. Where the map
#: has none of them, every time that the gripper is closed for long counts.
CARRY_PHASES = ("LIFT", "TRANSPORT")
#: Without phases: a grip counts from this long after the command to close.
SETTLE_S = 0.5
#: An object that is farther from the effector than this is not what was grasped.
REACH_M = 0.2
#: Two objects that are as near as that to each other's distance cannot be told apart.
_SAME_DISTANCE_M = 0.005
#: The distance at the grasp is the median over this time before.
GRASP_S = 0.6
#: Changes of the pose in the approach that tell how noisy it is; with fewer, what is assumed;
#: unless it never changes in so many steps.
_MIN_NOISE_STEPS, _MIN_STILL_STEPS, _ASSUMED_NOISE_M = 8, 20, 0.01
#: The reference goes to the present distance within this time, if that is no farther than so much:
#: it follows an object that settles in the fingers, and never one that leaves them.
_FOLLOW_S, _FOLLOW_M, _FOLLOW_NOISES = 0.5, 0.002, 1.0
#: The test: growth of the distance below the allowance is none; beyond it, it adds up, no step
#: by more than a share of the threshold, so that one wild sample is never enough.
_ALLOWED_M, _ALLOWED_NOISES = 0.015, 0.5
_THRESHOLD_M, _THRESHOLD_NOISES = 0.012, 4.0
_STEP_SHARE = 0.6
#: After a command to open an object is expected to leave: unless it may have been put down, this
#: share of the threshold is enough then; more than one step's, for it may have been let go for a
#: moment only.
_OPENED_SHARE = 0.65
#: An object that slid by more than this through the fingers is no longer held as it was grasped.
_SLIP_M = 0.04
#: It was carried at all if it went this far along the effector's way; the effector must have gone
#: further for a grip to count.
CARRIED_M, _MOVED_M = 0.02, 0.03
#: A pose that says nothing new for so long, while the effector went so far, is frozen.
FROZEN_S, _FROZEN_MOVED_M = 0.5, 0.03
#: With less noise than this a pose at rest may repeat itself exactly.
_STILL_NOISE_M = 0.002
#: From one sample to the next an object goes no further than this beyond the effector's way and,
#: downwards, a fall. So many samples in a row that do: it jumped.
_JUMP_M, _JUMP_NOISES, _JUMP_SAMPLES = 0.05, 4.0, 3
_GRAVITY_M_S2 = 9.81
#: It jumped to another object if it is as near as that to where the other was.
_PLACE_M = 0.03
#: Opened in the last of the phases, an object that falls by no more than this was put down.
_PUT_DOWN_M = 0.02


@dataclass(frozen=True)
class Hold:
    """One time that something was, or should have been, carried; steps are rows of the episode.

    Attributes:
        object: field of the object that was nearest at the grasp; empty: none could be told.
        first, last: steps in which it was to be carried, the last one so far.
        state: `carried` until it was let go; `broken`: it left the effector; `never` carried;
            `unknown`, for a reason.
        reason: of `unknown`, in words.
        departed: first step at which it had begun to leave; None where it did not.
        noticed: step at which that was sure.
        phase: in which it left, or the episode ended; empty without phases.
        n_carried: steps before it left, all of them where it did not.
        gap_m: how much farther from the effector than before it was when that was noticed.
        opened: whether the gripper had been commanded to open when it left.
        slip_m: how much farther from the effector it was at the end (or before it left) than at
            the grasp.
        rise_ratio: rise of the object over that of the effector, where that was highest; None
            where it did not rise.
    """

    object: str
    first: int
    last: int
    state: State = "unknown"
    reason: str = ""
    departed: int | None = None
    noticed: int | None = None
    phase: str = ""
    n_carried: int = 0
    gap_m: float = 0.0
    opened: bool = False
    slip_m: float = 0.0
    rise_ratio: float | None = None

    @property
    def n_steps(self) -> int:
        """Steps in which the object was to be carried."""
        return self.last - self.first + 1


@dataclass(frozen=True)
class Carrying:
    """What became of everything that was grasped in an episode.

    Attributes:
        holds: in their order; those in which the effector hardly moved are left out.
        reason: why there is none.
    """

    holds: tuple[Hold, ...] = ()
    reason: str = ""

    @property
    def worst(self) -> Hold | None:
        """The hold that decides: the first that broke, else unknown, never carried, carried."""
        for state in ("broken", "unknown", "never", "carried"):
            for hold in self.holds:
                if hold.state == state:
                    return hold
        return None

    @property
    def state(self) -> State:
        """That of the worst hold; unknown where nothing was held."""
        return self.worst.state if self.worst is not None else "unknown"

    @property
    def coupling(self) -> float:
        """Share of the steps of all holds in which their objects were carried; NaN without any."""
        steps = sum(h.n_steps for h in self.holds)
        return sum(h.n_carried for h in self.holds) / steps if steps else float("nan")


@dataclass(frozen=True)
class Watched:
    """What a watch says of a whole episode.

    Attributes:
        carrying: what became of everything that was grasped.
        losses: see `CarryWatch.losses`.
        blind_from: see `CarryWatch`.
    """

    carrying: Carrying
    losses: tuple[Hold, ...]
    blind_from: int | None


@once_per_episode
def watched(episode: Episode) -> Watched:
    """Watch a whole episode."""
    watch = CarryWatch(episode.topic_map).take(episode)
    losses = tuple(watch.losses)  # before the watch ends what is still held
    return Watched(watch.finish(), losses, watch.blind_from)


def carrying_of(episode: Episode) -> Carrying:
    """What became of everything that was grasped in a whole episode."""
    return watched(episode).carrying


def carry_labels(topic_map: TopicMap) -> dict[int, str]:
    """Index -> name of the phases of a map in which something is carried; may be empty."""
    specs = topic_map.with_role("phase")
    labels = specs[0].labels if specs else ()
    return {k: label for k, label in enumerate(labels) if label in CARRY_PHASES}


@once_per_episode
def carry_steps(episode: Episode) -> tuple[Mask, Mask]:
    """In which steps something is to be carried, and in which that is not known.

    Returns:
        (T,) and (T,): with phases, those of CARRY_PHASES, and those of unknown phase; without,
        those closed by command for SETTLE_S, and none.

    Raises:
        EpisodeError: if there are neither phases nor a command of the gripper.
    """
    labels = carry_labels(episode.topic_map)
    phase = episode.phase if labels else None
    if phase is not None:
        return np.isin(phase, list(labels)), ~(phase >= 0)
    closed: Mask = commanded(episode) < 0
    begins = closed.copy()
    begins[1:] &= ~closed[:-1]
    began = np.maximum.accumulate(np.where(begins, np.arange(len(closed)), 0))
    for_ns = episode.stamps_ns - episode.stamps_ns[began]
    return closed & (for_ns >= int(SETTLE_S * NS_PER_S)), np.zeros_like(closed)


class CarryWatch:
    """Watches an episode that grows; what it has said of a step never changes.

    Args:
        topic_map: of the episode.

    Attributes:
        n_steps: steps seen.
        blind_from: first step at which it was known that the poses cannot tell; None so far.
    """

    def __init__(self, topic_map: TopicMap) -> None:
        self._labels = carry_labels(topic_map)
        self._effector = next((s.name for s in topic_map.with_role("effector")), "")
        self._objects = [s.name for s in topic_map.with_role("object") if len(s.values) >= 3]
        self._done: list[Hold] = []
        self._grip: _Grip | None = None
        self._reason = ""
        self.n_steps = 0
        self.blind_from: int | None = None

    def take(self, episode: Episode) -> Self:
        """Look at the steps that are new; those before must be as they were.

        Args:
            episode: the episode so far, from its first step on.
        """
        first, self.n_steps = self.n_steps, len(episode)
        self._reason = self._reason or self._cannot(episode)
        if self._reason:
            self.blind_from = 0
        if self._reason or first >= self.n_steps:
            return self
        held, blind = carry_steps(episode)
        with np.errstate(over="ignore", invalid="ignore"):  # whatever a broken sensor says
            rows = _Rows(episode, self._effector, self._objects, self._labels)
            for step in _to_look_at(held, blind, first):
                if held[step]:
                    if self._grip is None:
                        self._grip = _Grip(_grasp(rows, step), step)
                    self._grip.take(rows, step)
                    self._note(step, self._grip.so_far())
                elif not blind[step]:
                    self._note(step, self._end())
        return self

    @property
    def losses(self) -> list[Hold]:
        """The holds of which it is known by now that their objects are not carried any more."""
        holds = [*self._done, *([] if self._grip is None else [self._grip.so_far()])]
        # Without phases nobody says that every closing was to carry something.
        states = ("broken", "never") if self._labels else ("broken",)
        return [h for h in holds if h.state in states]

    def finish(self) -> Carrying:
        """What is known after the last step; what is still held then is unknown."""
        holds = list(self._done)
        if self._grip is not None and (hold := self._grip.unfinished()) is not None:
            holds.append(hold)
        reason = self._reason
        if not holds and not reason:
            names = " or ".join(self._labels.values())
            reason = f"it never came to {names}" if names else "nothing was held for long"
        if not self._labels and any(h.state != "never" for h in holds):
            holds = [h for h in holds if h.state != "never"]
        return Carrying(tuple(holds), reason)

    def _cannot(self, episode: Episode) -> str:
        """Why these data show no carry, or nothing."""
        if not self._objects:
            return "the topic map declares no object with a position"
        if not self._effector:
            return "the topic map declares no effector"
        for name in (self._effector, *self._objects):
            if name not in episode.fields:
                return f"the episode lacks the field {name!r}"
        if episode.fields[self._effector].shape[1] < 3:
            return f"the effector {self._effector!r} has no position of three columns"
        try:
            carry_steps(episode)
        except EpisodeError as err:
            return str(err).partition(": ")[2]
        return ""

    def _note(self, step: int, hold: Hold | None) -> None:
        if self.blind_from is None and hold is not None and hold.state == "unknown":
            self.blind_from = step

    def _end(self) -> Hold | None:
        hold = self._grip.ended() if self._grip is not None else None
        self._grip = None
        if hold is not None:
            self._done.append(hold)
        return hold


def _to_look_at(held: Mask, blind: Mask, first: int) -> list[int]:
    """Steps from `first` on in which something is held, or was in the one before."""
    after = np.zeros_like(held)
    after[1:] = held[:-1] | blind[:-1]
    steps: list[int] = (np.flatnonzero((held | after)[first:]) + first).tolist()
    return steps


class _Rows:
    """What is read of an episode, row by row."""

    def __init__(
        self, episode: Episode, effector: str, objects: Sequence[str], labels: dict[int, str]
    ) -> None:
        self.times_s = (episode.stamps_ns - episode.start_ns) / NS_PER_S
        self.effector = episode.fields[effector][:, :3]
        self.objects = {name: episode.fields[name][:, :3] for name in objects}
        # Row by row, lists of numbers are several times quicker than arrays.
        self.hands: list[list[float]] = self.effector.tolist()
        self.places: dict[str, list[list[float]]] = {
            k: v.tolist() for k, v in self.objects.items()
        }
        self.has_hand = _finite(self.effector).tolist()
        self.has_place = {k: _finite(v).tolist() for k, v in self.objects.items()}
        self.seconds: list[float] = self.times_s.tolist()
        phase = episode.phase if labels else None
        #: Name of the phase of each step, empty without phases.
        self.labels = (
            [""] * len(episode)
            if phase is None
            else [labels.get(int(k), "") for k in np.nan_to_num(phase, nan=-1.0)]
        )
        try:
            self.is_open: list[bool] = (commanded(episode) > 0).tolist()
        except EpisodeError:  # no gripper: then nobody says that something was let go
            self.is_open = [False] * len(episode)


@dataclass(frozen=True)
class _Grasp:
    """What was grasped, and how everything stood then.

    Attributes:
        object: its field; empty where it cannot be told.
        reason: why not.
        unseen: an object of the map that has no pose; empty where there is none.
        distance_m: from effector to object.
        noise_m: standard deviation of the pose.
        hand, at: positions of effector and object.
    """

    object: str = ""
    reason: str = ""
    unseen: str = ""
    distance_m: float = 0.0
    noise_m: float = 0.0
    hand: Point = (0.0, 0.0, 0.0)
    at: Point = (0.0, 0.0, 0.0)


def _grasp(rows: _Rows, step: int) -> _Grasp:
    """The grasp of the object that is nearest when it is to be carried from a step on."""
    first = int(np.searchsorted(rows.times_s, rows.times_s[step] - GRASP_S))
    hand = rows.effector[first : step + 1]
    near: list[tuple[float, float, str]] = []
    unseen = ""
    for name, places in rows.objects.items():
        distance_m = np.linalg.norm(places[first : step + 1] - hand, axis=1)
        fresh = _is_fresh(places[first : step + 1])
        distance_m = distance_m[fresh & np.isfinite(distance_m)]
        if len(distance_m):
            near.append((float(np.median(distance_m)), _noise_m(places[:step]), name))
        else:
            unseen = unseen or name
    if not near:
        return _Grasp(reason=f"no pose of {' or '.join(rows.objects)} at the grasp")
    (nearest_m, noise_m, name), *others = sorted(near)
    if nearest_m > REACH_M:
        text = f"no object is within {REACH_M:g} m of the effector at the grasp"
        return _Grasp(reason=text + (f", and {unseen} has no pose" if unseen else ""))
    if others and others[0][0] - nearest_m < _SAME_DISTANCE_M + 2.0 * noise_m:
        return _Grasp(reason=f"which was grasped cannot be told: {name} or {others[0][2]}")
    at = rows.objects[name][first : step + 1]
    both = _is_fresh(at) & _finite(at) & _finite(hand)
    return _Grasp(
        object=name,
        unseen=unseen,
        distance_m=nearest_m,
        noise_m=noise_m,
        hand=np.median(hand[both], axis=0).tolist(),
        at=np.median(at[both], axis=0).tolist(),
    )


def _finite(places: Floats) -> Mask:
    """(n,) whether all of a row is finite."""
    return np.asarray(np.isfinite(places).all(axis=1))


def _is_fresh(places: Floats) -> Mask:
    """(n,) whether a pose differs from the one before; the first is, as nobody knows better."""
    fresh = np.ones(len(places), dtype=bool)
    fresh[1:] = (places[1:] != places[:-1]).any(axis=1)
    return fresh


def _noise_m(places: Floats) -> float:
    """Standard deviation of a pose at rest, from its changes; robust against some motion.

    Args:
        places: (n, 3) before the grasp.
    """
    steps = np.diff(places[_finite(places)], axis=0)
    changed = steps.any(axis=1)
    if len(steps) >= _MIN_STILL_STEPS and not changed.any():
        return 0.0
    steps = steps[changed]  # what repeats is no sample
    if len(steps) < _MIN_NOISE_STEPS:
        return _ASSUMED_NOISE_M
    # 1.4826: from the median to the deviation of a normal distribution; sqrt 2: of a difference.
    return float(1.4826 * np.median(np.abs(steps)) / np.sqrt(2.0))


class _Leaving:
    """The sequential test (CUSUM): is the object farther away than when it was held?

    Attributes:
        away_m: growth of the distance at the last sample.
        is_possible: whether it may have begun to leave.
    """

    def __init__(self, distance_m: float, noise_m: float) -> None:
        self._grasp_m = self._held_m = distance_m
        self._allowed_m = _ALLOWED_M + _ALLOWED_NOISES * noise_m
        self._threshold_m = _THRESHOLD_M + _THRESHOLD_NOISES * noise_m
        self._follow_m = _FOLLOW_M + _FOLLOW_NOISES * noise_m
        self._sum_m = 0.0
        self.away_m = 0.0

    @property
    def slip_m(self) -> float:
        """How much farther it is held now than at the grasp."""
        return self._held_m - self._grasp_m

    @property
    def is_possible(self) -> bool:
        return self._sum_m > 0.0

    def is_near(self, distance_m: float) -> bool:
        """Whether an object at that distance may be held as it was."""
        return distance_m - self._held_m <= self._allowed_m

    @property
    def is_likely(self) -> bool:
        """Whether it has left, if something else speaks for that, too."""
        return self._sum_m > _OPENED_SHARE * self._threshold_m

    def add(self, distance_m: float, after_s: float) -> bool:
        """Take a sample, so long after the last one; whether it is sure now."""
        self.away_m = away_m = distance_m - self._held_m
        most_m = _STEP_SHARE * self._threshold_m
        self._sum_m = max(0.0, self._sum_m + min(away_m - self._allowed_m, most_m))
        towards_m = min(max(away_m, -self._follow_m), self._follow_m)
        self._held_m += towards_m * min(1.0, after_s / _FOLLOW_S)
        return self._sum_m > self._threshold_m or self.slip_m > _SLIP_M


class _Grip:
    """Follows one object from the grasp on.

    Args:
        grasp: of it.
        first: step at which it is to be carried from.
    """

    def __init__(self, grasp: _Grasp, first: int) -> None:
        self._grasp = grasp
        self._first = self._last = first
        self._state: State = "unknown" if grasp.reason else "carried"
        self._reason = grasp.reason
        self._is_over = bool(grasp.reason)
        self._leaving = _Leaving(grasp.distance_m, grasp.noise_m)
        self._phase = ""
        self._slip_m = 0.0
        self._departed: int | None = None
        self._noticed: int | None = None
        self._left_open = self._is_put_down = False
        self._opened_z: float | None = None
        #: The last sample that counted, and the last ones before it may have begun to leave.
        self._seen, self._seen_s, self._seen_step = grasp.at, float("nan"), first
        self._hand = self._good_hand = grasp.hand
        self._good = [grasp.at]
        self._fall_m_s = 0.0
        self._n_jumps = 0
        self._frozen = ""
        self._moved_m = 0.0
        self._top = (-float("inf"), 0.0)

    def take(self, rows: _Rows, step: int) -> None:
        """Look at one more step in which the object is to be carried."""
        self._last = step
        if not self._is_over and self._departed is None:
            self._phase = rows.labels[step]
        name = self._grasp.object
        if not name:
            return
        now_s = rows.seconds[step]
        if step == self._first:
            self._seen_s = now_s
        if not rows.has_hand[step]:
            return
        hand, seen = rows.hands[step], rows.places[name][step]
        self._moved_m = max(self._moved_m, dist(hand, self._grasp.hand))
        if self._opened_z is None and rows.is_open[step]:
            self._opened_z = float(np.median([z for _, _, z in self._good]))
        if not rows.has_place[name][step] or (seen == self._seen and not self._may_rest()):
            self._wait(now_s, hand)
            return
        if hand[2] >= self._top[0]:
            self._top = (hand[2], seen[2])
        if self._is_over:
            return
        if self._has_jumped(now_s, hand, seen):
            self._n_jumps += 1
            if self._n_jumps >= _JUMP_SAMPLES:
                self._give_up(self._jump_text(rows, seen))
            return
        self._n_jumps = 0
        self._judge(now_s, step, hand, seen)

    def _may_rest(self) -> bool:
        """Whether an object that repeats its place lies there, rather than not being seen.

        Of a pose without noise, and only when it has begun to leave: then it fell to that place.
        """
        return self._leaving.is_possible and self._grasp.noise_m < _STILL_NOISE_M

    def _wait(self, now_s: float, hand: Point) -> None:
        """Nothing new of the object."""
        if now_s - self._seen_s >= FROZEN_S and dist(hand, self._hand) >= _FROZEN_MOVED_M:
            self._frozen = (
                f"no new pose of {self._grasp.object} for {FROZEN_S:g} s from "
                f"{self._seen_s:.2f} s on, while the effector moved"
            )

    def _judge(self, now_s: float, step: int, hand: Point, seen: Point) -> None:
        distance_m = dist(hand, seen)
        if self._frozen:
            if not self._leaving.is_near(distance_m):  # it was lost, and nobody knows when
                self._give_up(self._frozen)
                return
            self._frozen = ""
        after_s = now_s - self._seen_s
        if after_s > 0.0:
            self._fall_m_s = max(0.0, (self._seen[2] - seen[2]) / after_s)
        self._seen, self._seen_s, self._seen_step, self._hand = seen, now_s, step, hand
        is_sure = self._leaving.add(distance_m, after_s)
        if not self._leaving.is_possible:
            self._departed, self._good_hand = None, hand
            self._slip_m = self._leaving.slip_m
            self._good = [*self._good[-2:], seen]
        elif self._departed is None:
            self._departed, self._left_open = step, self._opened_z is not None
        if is_sure or (self._leaving.is_likely and self._is_let_go(seen)):
            self._lose(step, seen)

    def _lose(self, step: int, seen: Point) -> None:
        """It is away: dropped, put down, or never taken along."""
        self._is_over = True
        if self._left_open and self._may_be_put_down(seen):
            self._departed, self._is_put_down = None, True
            return
        self._noticed = step
        self._departed = step if self._departed is None else self._departed
        self._state = "broken" if self._went_along_m() >= CARRIED_M else "never"
        if self._state == "never" and self._grasp.unseen:
            name, unseen = self._grasp.object, self._grasp.unseen
            self._give_up(f"{name} was not carried, and {unseen} has no pose")

    def _is_let_go(self, seen: Point) -> bool:
        """Whether the gripper was told to open, where nothing is put down."""
        return self._opened_z is not None and not self._may_be_put_down(seen)

    def _may_be_put_down(self, seen: Point) -> bool:
        """Whether it is in the last of the phases, and not lower than when it was to be let go."""
        if self._opened_z is None or self._phase != CARRY_PHASES[-1]:
            return False
        return self._opened_z - seen[2] < _PUT_DOWN_M + 2.0 * self._grasp.noise_m

    def _went_along_m(self) -> float:
        """How far the object went along the effector's way, before it began to leave."""
        way = np.subtract(self._good_hand, self._grasp.hand)
        went = np.median(self._good, axis=0) - self._grasp.at
        length_m = float(np.linalg.norm(way))
        return float(np.dot(went, way)) / length_m if length_m > 0.0 else 0.0

    def _has_jumped(self, now_s: float, hand: Point, seen: Point) -> bool:
        free_m = _JUMP_M + _JUMP_NOISES * self._grasp.noise_m
        if dist(seen, self._seen) <= free_m:
            return False
        free_m += dist(hand, self._hand)
        dx, dy, dz = (a - b for a, b in zip(seen, self._seen, strict=True))
        after_s = now_s - self._seen_s
        # Two steps of a tracker may lie farther apart than their stamps say.
        fall_m = self._fall_m_s * after_s + 0.5 * _GRAVITY_M_S2 * (after_s + 0.05) ** 2
        return hypot(dx, dy, max(dz, 0.0)) > free_m or -dz > free_m + fall_m

    def _jump_text(self, rows: _Rows, seen: Point) -> str:
        name = self._grasp.object
        for other, places in rows.places.items():
            near_m = dist(places[self._seen_step], seen)
            if other != name and near_m < _PLACE_M + 2.0 * self._grasp.noise_m:
                return f"the pose of {name} jumped to where {other} was"
        return f"the pose of {name} jumped by {dist(seen, self._seen):.2f} m"

    def _give_up(self, reason: str) -> None:
        self._is_over, self._state, self._reason = True, "unknown", reason
        self._departed = self._noticed = None

    def so_far(self) -> Hold:
        """What is known by now."""
        is_lost = self._state in ("broken", "never")
        stop = self._last + 1 if self._departed is None or not is_lost else self._departed
        rose_m = self._top[0] - self._grasp.hand[2]
        return Hold(
            object=self._grasp.object,
            first=self._first,
            last=self._last,
            state=self._state,
            reason=self._reason,
            departed=self._departed if is_lost else None,
            noticed=self._noticed,
            phase=self._phase,
            n_carried=stop - self._first if self._state in ("carried", "broken") else 0,
            gap_m=self._leaving.away_m if is_lost else 0.0,
            opened=is_lost and self._left_open,
            slip_m=self._slip_m,
            rise_ratio=(self._top[1] - self._grasp.at[2]) / rose_m if rose_m > _MOVED_M else None,
        )

    def ended(self) -> Hold | None:
        """The hold, now that nothing is to be carried any more; None: it was none."""
        if self._frozen and not self._is_over:
            self._give_up(self._frozen)
        hold = self.so_far()
        return None if hold.state == "carried" and self._moved_m < _MOVED_M else hold

    def unfinished(self) -> Hold | None:
        """The hold, where the episode ends before it does."""
        hold = self.ended()
        if hold is None or hold.state != "carried" or self._is_put_down:
            return hold
        where = f"in {hold.phase}" if hold.phase else "with the gripper closed"
        text = f"it ends {where}, {hold.object} still held"
        return replace(hold, state="unknown", reason=text, n_carried=0)
