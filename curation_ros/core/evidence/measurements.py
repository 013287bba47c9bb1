"""Measurements of a complete episode: what the baseline learns, and what the checks compare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.alerts import alerts_of
from curation_ros.core.evidence.gripper import first_opening, is_closed_command, is_open_command
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats, Mask

#: Fewer steps are no motion: a speed profile, a phase and a grasp do not fit into them.
MIN_STEPS = 5
#: At rest: slower than this share of the fast steps, without a change of the gripper's command.
IDLE_SPEED_SHARE = 0.1
#: Roles of what is measured of the arm.
MEASURED = ("clock", "effector", "observation")

#: Seconds, first and last row of a run.
Run = tuple[float, int, int]


@dataclass(frozen=True)
class Measurements:
    """Measurements of an episode of at least MIN_STEPS steps.

    Attributes:
        rate_hz: median rate of the clock.
        duration_s: from the first to the last step.
        speed: (T - 1,) speed of the effector in its unit per second; 0 where it is unknown.
        fast: speed that 95 % of the steps do not exceed.
        start_speed: speed in the first step.
        idle: longest rest with motion before and after it.
        still: topic -> longest time for which its values repeat.
        same_rows: (T - 1,) whether a row equals the one before in every field.
        phase: (T,) index of the phase, -1 where it is unknown; None without phases.
        first_phase: index at the first step of known phase; -1 if there is none.
        last_phase: highest index that was reached; -1 if there is none.
        open_phase: index at the first opening; -1 if there is none.
        has_gripper: whether the gripper was commanded at all.
        closed: (T,) whether the gripper is commanded to close.
        opening: step of the first opening after a closing; None if there is none.
        held_s: time from the first closing to that opening; 0 if there is none.
        alerts: see `alerts_of`.
    """

    rate_hz: float
    duration_s: float
    speed: Floats
    fast: float
    start_speed: float
    idle: Run
    still: dict[str, Run]
    same_rows: Mask
    phase: Floats | None
    first_phase: int
    last_phase: int
    open_phase: int
    has_gripper: bool
    closed: Mask
    opening: int | None
    held_s: float
    alerts: list[Finding]

    @classmethod
    def of(cls, episode: Episode) -> Measurements:
        """Measure an episode of at least MIN_STEPS steps."""
        times_s = (episode.stamps_ns - episode.stamps_ns[0]) / NS_PER_S
        periods_s = np.diff(times_s)
        speed = _speed(episode, periods_s)
        fast = _quantile(speed, 0.95)
        still, same_rows = _still(episode, times_s)
        has_gripper, closed, opening = _gripper(episode)
        at_rest = speed < IDLE_SPEED_SHARE * fast
        at_rest &= closed[1:] == closed[:-1]
        phase = _phase(episode)
        known = phase[phase >= 0] if phase is not None else np.empty(0)
        return cls(
            rate_hz=1.0 / _quantile(periods_s, 0.5),
            duration_s=float(times_s[-1]),
            speed=speed,
            fast=fast,
            start_speed=float(speed[0]),
            idle=longest_run(_inner(at_rest), times_s),
            still=still,
            same_rows=same_rows,
            phase=phase,
            first_phase=int(known[0]) if len(known) else -1,
            last_phase=int(known.max()) if len(known) else -1,
            open_phase=-1 if phase is None or opening is None else int(phase[opening]),
            has_gripper=has_gripper,
            closed=closed,
            opening=opening,
            held_s=(
                0.0 if opening is None else float(times_s[opening] - times_s[int(closed.argmax())])
            ),
            alerts=alerts_of(episode),
        )

    @property
    def starts_closed(self) -> bool:
        """Whether the gripper is commanded to close in the first step."""
        return bool(self.closed[0])

    @property
    def closes(self) -> bool:
        """Whether the gripper is ever commanded to close."""
        return bool(self.closed.any())


def longest_run(mask: Mask, times_s: Floats) -> Run:
    """Longest run of a (T - 1,) mask of steps; 0.0, 0, 0 if it has none."""
    if not mask.any():
        return 0.0, 0, 0
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    first, last = edges[::2], edges[1::2]
    seconds = times_s[last] - times_s[first]
    best = int(np.argmax(seconds))
    return float(seconds[best]), int(first[best]), int(last[best])


def effector_unit(episode: Episode) -> str:
    """Unit of the field whose speed is measured."""
    return episode.topic_map.fields[_effector_name(episode)].unit or "units"


def _effector_name(episode: Episode) -> str:
    specs = episode.topic_map.with_role("effector")
    return specs[0].name if specs else episode.topic_map.clock


def _quantile(values: Floats, share: float) -> float:
    """The value that a share of the values does not exceed; far quicker than NumPy's."""
    place = int(share * (len(values) - 1))
    return float(np.partition(values, place)[place])


def _speed(episode: Episode, periods_s: Floats) -> Floats:
    """(T - 1,) speed of the first effector, else of the clock's field; 0 where it is unknown."""
    values = episode.fields.get(_effector_name(episode))
    if values is None:
        return np.zeros(len(periods_s))
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.diff(values, axis=0)
        speed: Floats = np.sqrt(np.einsum("ij,ij->i", moved, moved)) / periods_s
    return np.where(np.isfinite(speed), speed, 0.0)


def _still(episode: Episode, times_s: Floats) -> tuple[dict[str, Run], Mask]:
    """Longest repetition of each topic of the arm, and which rows equal the one before.

    A topic of the arm shows where the arm is: the clock, an effector, joints. Another observation
    counts only if it changes at all, as it may be a constant of this robot. Values are compared
    bit by bit, so that NaN equals NaN: a missing value is not a moving one.
    """
    fields, gripper = episode.topic_map.fields, episode.topic_map.gripper
    fingers = gripper.fingers if gripper is not None else ""
    rows = np.ones(len(times_s) - 1, dtype=bool)
    topics: dict[str, Mask] = {}
    arm: set[str] = set()
    others: set[str] = set()
    for name, values in episode.fields.items():
        bits = np.ascontiguousarray(values).view(np.int64)
        same: Mask = (bits[1:] == bits[:-1]).all(axis=1)
        rows &= same
        spec = fields[name]
        topics[spec.topic] = same & topics[spec.topic] if spec.topic in topics else same
        if spec.role not in MEASURED or name == fingers or np.isnan(values[0]).all():
            continue
        is_arm = spec.role != "observation" or spec.type.endswith("/JointState")
        (arm if is_arm else others).add(spec.topic)
    still = {
        topic: longest_run(same, times_s)
        for topic, same in topics.items()
        if topic in arm or (topic in others and not same.all())
    }
    return still, rows


def _inner(mask: Mask) -> Mask:
    """The mask without the runs at its two ends."""
    moving = np.flatnonzero(~mask)
    inner = np.zeros_like(mask)
    if len(moving):
        inner[moving[0] : moving[-1]] = mask[moving[0] : moving[-1]]
    return inner


def _phase(episode: Episode) -> Floats | None:
    """(T,) index of the phase, -1 where the map has no such phase."""
    specs = episode.topic_map.with_role("phase")
    values = episode.fields.get(specs[0].name) if specs else None
    if values is None:
        return None
    known = (values[:, 0] >= 0) & (values[:, 0] < len(specs[0].labels))
    return np.where(known, values[:, 0], -1.0)


def _gripper(episode: Episode) -> tuple[bool, Mask, int | None]:
    """Whether the gripper was commanded, (T,) commanded to close, and the first opening."""
    try:
        closed = is_closed_command(episode)
        is_used = bool(closed.any()) or bool(is_open_command(episode).any())
        return is_used, closed, first_opening(episode)
    except EpisodeError:  # no gripper in the map, or no such field in the episode
        return False, np.zeros(len(episode), dtype=bool), None
