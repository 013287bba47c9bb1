"""Checks of an episode's arrays: what is wrong with the recording, the motion, or the task.

The builder sees samples and finds what single topics lack; here the joined arrays are judged,
where there is a reference by what trusted episodes look like. Nothing here reads a label.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.alerts import LOST, alerts_of
from curation_ros.core.evidence.gripper import first_opening, is_closed_command, is_open_command
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.stream import Stamps
    from curation_ros.core.types import Floats, Mask


#: Fewer steps are no motion: a speed profile, a phase and a grasp do not fit into them.
MIN_STEPS = 5
#: Nobody does in a quarter of the time what the quickest of the trusted ones took.
MIN_DURATION_SHARE = 0.25
#: A step counts as irregular if its period is off the median by more than half: a lost message
#: doubles it, jitter of a fifth of a period at both ends stays below.
IRREGULAR_PERIOD_SHARE = 0.5
#: Single lost messages are counted elsewhere; a clock of which a fifth is irregular has no rate.
IRREGULAR_STEPS_SHARE = 0.2
#: A rate differs if it is off the trusted ones by more than this: 30 from 25 Hz, not 30 from 29.
RATE_TOLERANCE = 0.15
#: An arm's values repeat for a few steps where encoders are coarse or topics slower than the
#: clock; a topic is frozen after twice the silence that the map allows, and at least after this.
FROZEN_S = 0.5
#: What else was measured must have moved by this share of its range meanwhile ...
FROZEN_MOVED_SHARE = 0.05
#: ... or the commands by this one: more than a hand's tremor around a command of zero.
FROZEN_COMMANDED_SHARE = 0.25
#: Rows that equal the last one in every value. Coarse encoders of a robot at rest repeat rows,
#: too: then the tail must be this many times as long as any such rest before it.
PADDED_STEPS, PADDED_FACTOR = 10, 3
#: A start in mid-motion: faster in the first step than any trusted one by this factor, at a good
#: part of the episode's own speed, and no longer getting faster: who starts from rest at full
#: speed is, in the first step, at half of what it has after four.
CLIPPED_SPEED_FACTOR, CLIPPED_SPEED_SHARE = 1.3, 0.5
CLIPPED_RISE_SHARE, _RISE_STEPS = 0.7, 4
#: The speed of a step that nothing physical explains, in units of the fast steps (95 %) of the
#: episode; those of clean simulated demonstrations reach 2.
JUMP_FACTOR = 8.0
#: At rest: slower than this share of the fast steps, with no change of the gripper's command.
IDLE_SPEED_SHARE = 0.1
#: A pause of a person who thinks. With a reference: twice its longest pause, if that is longer.
IDLE_S, IDLE_FACTOR = 3.0, 2.0
#: Without phases: shorter than the shortest trusted hold by this factor.
HELD_SHARE = 0.8
#: Roles of what was measured of the arm.
_MEASURED = ("clock", "effector", "observation")
#: With fewer trusted episodes nothing is said about their spread.
MIN_REFERENCES = 3


class Baseline:
    """What trusted episodes look like, as plain numbers; learned in any order.

    Attributes:
        n_: number of episodes.
        rate_hz_: lowest and highest rate.
        duration_s_: shortest.
        start_speed_: highest speed of the effector in the first step, in its unit a second.
        idle_s_: longest rest with motion before and after it.
        still_s_: topic -> longest time for which its values repeat.
        first_phase_, last_phase_, open_phase_: lowest index at the start, of the highest that was
            reached, and at the first opening; -1 where there is none.
        held_s_: shortest time from the first closing to the first opening after it; 0 where an
            episode has none.
        starts_open_, closes_, opens_: 1 if all of them start with an open gripper, close it, and
            open it again; else 0.
        usual_: ids of what most of them show that would be an alert: here it is none.
    """

    def fit(self, episodes: Iterable[Episode]) -> Self:
        """Learn from trusted episodes; none at all is fine, and judges nothing.

        Raises:
            EpisodeError: if one has fewer than MIN_STEPS steps.
        """
        facts = []
        for episode in episodes:
            if len(episode) < MIN_STEPS:
                raise EpisodeError(
                    f"episode {episode.id}: {len(episode)} steps, a baseline needs {MIN_STEPS}"
                )
            facts.append(_Facts.of(episode))
        self.n_ = len(facts)
        rates = [f.rate_hz for f in facts]
        self.rate_hz_ = (min(rates, default=0.0), max(rates, default=0.0))
        self.duration_s_ = min((f.duration_s for f in facts), default=0.0)
        self.start_speed_ = max((f.start_speed for f in facts), default=0.0)
        self.idle_s_ = max((f.idle[0] for f in facts), default=0.0)
        self.still_s_: dict[str, float] = {}
        for fact in facts:
            for topic, (seconds, _, _) in fact.still.items():
                self.still_s_[topic] = max(self.still_s_.get(topic, 0.0), seconds)
        self.first_phase_ = min((f.first_phase for f in facts), default=-1)
        self.last_phase_ = min((f.last_phase for f in facts), default=-1)
        self.open_phase_ = min((f.open_phase for f in facts), default=-1)
        self.held_s_ = min((f.held_s for f in facts), default=0.0)
        self.starts_open_ = int(bool(facts) and all(not f.starts_closed for f in facts))
        self.closes_ = int(bool(facts) and all(f.closes for f in facts))
        self.opens_ = int(bool(facts) and all(f.opening is not None for f in facts))
        shown = Counter(id_ for f in facts for id_ in {finding.id for finding in f.alarming})
        self.usual_ = tuple(sorted(k for k, n in shown.items() if 2 * n > len(facts)))
        return self

    def fitted(self) -> dict[str, Any]:
        """Learned values by name."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}


@dataclass(frozen=True)
class _Facts:
    """Measurements that both a baseline and the checks are made of; spans are step indices."""

    rate_hz: float
    duration_s: float
    speed: Floats
    fast: float
    start_speed: float
    idle: tuple[float, int, int]
    still: dict[str, tuple[float, int, int]]
    same_rows: Mask
    phase: Floats | None
    first_phase: int
    last_phase: int
    open_phase: int
    has_gripper: bool
    closed: Mask
    opening: int | None
    held_s: float
    alarming: list[Finding]

    @classmethod
    def of(cls, episode: Episode) -> _Facts:
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
            idle=_longest(_inner(at_rest), times_s),
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
            alarming=alerts_of(episode),
        )

    @property
    def starts_closed(self) -> bool:
        return bool(self.closed[0])

    @property
    def closes(self) -> bool:
        return bool(self.closed.any())


def check_episode(episode: Episode, baseline: Baseline | None = None) -> tuple[Finding, ...]:
    """Everything that the arrays of an episode show, beside `episode.findings`.

    Args:
        episode: any episode, whole.
        baseline: fitted on trusted episodes of the same map; None or one of no episodes: what
            needs a comparison is not judged. Its spread counts from MIN_REFERENCES episodes on.

    Returns:
        Findings in the order of `findings.FINDINGS`: of the recording, the motion and the task.
        An episode that is too short has that one alone.
    """
    baseline = baseline if baseline is not None and baseline.n_ else None
    spread = baseline if baseline is not None and baseline.n_ >= MIN_REFERENCES else None
    whole = (0, max(0, episode.end_ns - episode.start_ns))
    n = len(episode)
    if n < MIN_STEPS:
        text = f"{n} steps with all that a step needs; expected at least {MIN_STEPS}"
        return (Finding("too-short", text, whole),)
    facts = _Facts.of(episode)
    if spread is not None and facts.duration_s < MIN_DURATION_SHARE * spread.duration_s_:
        text = f"{facts.duration_s:.2f} s; the shortest reference took {spread.duration_s_:.2f} s"
        return (Finding("too-short", text, whole),)
    padded = _padded(episode, facts)
    stop = n if padded is None else padded[0]
    frozen = _frozen(episode, facts, spread, stop)
    # Where values come back after that or after silence, or end in zeros, nothing jumped.
    recorded = [last for _, last in frozen] + ([] if padded is None else [stop - 1])
    recorded += [int(np.searchsorted(_offsets(episode), end)) - 1 for _, end in _gaps(episode)]
    found = [
        _clipped_start(episode, facts, baseline, spread),
        *(finding for finding, _ in frozen),
        None if padded is None else Finding("padded-tail", padded[1], episode.span(stop, n - 1)),
        _rate(episode, facts, spread),
        _idle(episode, facts, spread),
        _jump(episode, facts, recorded),
        *_task(episode, facts, baseline, spread),
    ]
    known = [f for f in found if f is not None]
    if any(f.kind == "recording" or f.id == "jump" for f in (*episode.findings, *known)):
        # Where a pose cannot be trusted, neither can what it shows of another.
        known = [f for f in known if f.id not in LOST]
    return tuple(known)


# --- recording ------------------------------------------------------------------------------


def _clipped_start(
    episode: Episode, facts: _Facts, baseline: Baseline | None, spread: Baseline | None
) -> Finding | None:
    labels = episode.phase_labels
    lowest = 0 if baseline is None else max(baseline.first_phase_, 0)
    if facts.phase is not None and facts.phase[0] > lowest:
        text = f"it begins in phase {labels[int(facts.phase[0])]}, expected {labels[lowest]}"
    elif facts.starts_closed and (
        baseline.starts_open_ if baseline is not None else _only_opens(facts)
    ):
        text = "it begins with the gripper commanded to close"
    elif (
        spread is not None
        and facts.start_speed > CLIPPED_SPEED_FACTOR * spread.start_speed_
        and facts.start_speed > CLIPPED_SPEED_SHARE * facts.fast
        and facts.start_speed > CLIPPED_RISE_SHARE * float(facts.speed[:_RISE_STEPS].max())
    ):
        text = (
            f"the effector moves at {facts.start_speed:.3g} {_unit(episode)}/s in the first step, "
            f"in the references at {spread.start_speed_:.3g} at most"
        )
    else:
        return None
    return Finding("clipped-start", text, episode.span(0, 0))


def _only_opens(facts: _Facts) -> bool:
    """Whether something held from the first step on is let go, and nothing taken after that."""
    return facts.opening is not None and not facts.closed[facts.opening :].any()


def _frozen(
    episode: Episode, facts: _Facts, spread: Baseline | None, stop: int
) -> list[tuple[Finding, int]]:
    """Topics of the arm that repeat their values for long, although it moves; before `stop`.

    Returns:
        Findings, each with the last row that repeats.
    """
    found = []
    least_s = max(FROZEN_S, 2.0 * episode.topic_map.max_gap_s)
    for topic, (seconds, first, last) in facts.still.items():
        known_s = None if spread is None else spread.still_s_.get(topic)
        if seconds < max(least_s, 2.0 * (known_s or 0.0)) or last >= stop:
            continue
        begin, end = episode.span(first, last)
        if any(begin <= gap[1] and gap[0] <= end for gap in _gaps(episode, topic)):
            continue  # nothing came: what was seen last is held, and the gap is a finding
        # Where no trusted episode ever repeats a value, noise is always seen, and where nothing
        # at all was seen to change, nothing was seen: then do not ask whether the robot moved.
        nothing = facts.same_rows.all()
        if known_s != 0.0 and not nothing and not _moved_meanwhile(episode, topic, first, last):
            continue
        never = first == 0 and last == len(episode) - 1
        text = f"topic {topic!r}: " + (
            "its values never change" if never else f"its values repeat for {seconds:.2f} s"
        )
        found.append((Finding("frozen", text, episode.span(first, last)), last))
    return found


def _gaps(episode: Episode, topic: str | None = None) -> list[tuple[int, int]]:
    """Spans in which a topic, or any, was silent, as the builder found them."""
    return [
        f.span
        for f in episode.findings
        if f.id == "gap" and (topic is None or f.message.startswith(f"topic {topic!r}:"))
    ]


def _moved_meanwhile(episode: Episode, topic: str, first: int, last: int) -> bool:
    """Whether another topic of the arm, or the command, shows motion in steps first to last."""
    for spec in episode.topic_map.fields.values():
        values = episode.fields.get(spec.name)
        if values is None or spec.topic == topic or spec.role not in (*_MEASURED, "action"):
            continue
        part = values[first : last + 1]
        share = FROZEN_COMMANDED_SHARE if spec.role == "action" else FROZEN_MOVED_SHARE
        with np.errstate(invalid="ignore", over="ignore"):
            moved = part.max(axis=0) - part.min(axis=0)
            if (moved > share * (values.max(axis=0) - values.min(axis=0))).any():
                return True
    return False


def _padded(episode: Episode, facts: _Facts) -> tuple[int, str] | None:
    """First step of the padding at the end and what it is, or None."""
    n = len(episode)
    changed = np.flatnonzero(~facts.same_rows)
    first = int(changed[-1]) + 1 if len(changed) else 0
    n_equal = n - first
    if n_equal < 2:
        return None
    if (
        n_equal >= MIN_STEPS
        and first
        and not any(
            values[-1].any()
            for name, values in episode.fields.items()
            if not episode.topic_map.fields[name].labels
        )
    ):
        return first, f"the last {n_equal} rows are zeros in every field"
    rest = _longest(facts.same_rows[:first], np.arange(n, dtype=np.float64))[0]
    if n_equal >= max(PADDED_STEPS, PADDED_FACTOR * (rest + 1)) and first:
        return first, f"the last {n_equal} rows are equal in every field, commands included"
    return None


def _rate(episode: Episode, facts: _Facts, spread: Baseline | None) -> Finding | None:
    periods = np.diff(episode.stamps_ns) * (facts.rate_hz / NS_PER_S)
    irregular = np.abs(periods - 1.0) > IRREGULAR_PERIOD_SHARE
    n_irregular = int(np.count_nonzero(irregular))
    whole = episode.span(0, len(episode) - 1)
    if n_irregular > IRREGULAR_STEPS_SHARE * len(periods):
        text = (
            f"{n_irregular} of {len(periods)} periods of the clock differ by more than "
            f"{IRREGULAR_PERIOD_SHARE:.0%} from their median, {1000 / facts.rate_hz:.1f} ms"
        )
        return Finding("rate", text, whole)
    if spread is None:
        return None
    low, high = spread.rate_hz_
    if low * (1.0 - RATE_TOLERANCE) <= facts.rate_hz <= high * (1.0 + RATE_TOLERANCE):
        return None
    text = (
        f"the clock runs at {facts.rate_hz:.2f} Hz, in the references at {low:.2f} to {high:.2f}"
    )
    return Finding("rate", text, whole)


# --- motion ---------------------------------------------------------------------------------


def _idle(episode: Episode, facts: _Facts, spread: Baseline | None) -> Finding | None:
    seconds, first, last = facts.idle
    if seconds < max(IDLE_S, 0.0 if spread is None else IDLE_FACTOR * spread.idle_s_):
        return None
    return Finding("idle", f"the effector rests for {seconds:.2f} s", episode.span(first, last))


def _jump(episode: Episode, facts: _Facts, recorded: list[int]) -> Finding | None:
    """The fastest step, unless it comes of a fault of the recording: after one of these rows."""
    if not facts.fast > 0.0:
        return None
    speed = facts.speed.copy()
    speed[[row for row in recorded if 0 <= row < len(speed)]] = 0.0
    at = int(np.argmax(speed))
    factor = float(speed[at]) / facts.fast
    if factor < JUMP_FACTOR:
        return None
    period_s = float(episode.stamps_ns[at + 1] - episode.stamps_ns[at]) / NS_PER_S
    text = (
        f"the effector moves by {facts.speed[at] * period_s:.3g} {_unit(episode)} in one step, "
        f"{factor:.0f} times as fast as in its fast steps"
    )
    return Finding("jump", text, episode.span(at, at + 1))


# --- task -----------------------------------------------------------------------------------


def _task(
    episode: Episode, facts: _Facts, baseline: Baseline | None, spread: Baseline | None
) -> list[Finding | None]:
    labels, last = episode.phase_labels, len(episode) - 1
    found: list[Finding | None] = []
    if facts.has_gripper and not facts.closes and (baseline is None or baseline.closes_):
        text = "the gripper was never commanded to close"
        found.append(Finding("never-grasped", text, episode.span(0, last)))
    usual = () if baseline is None else baseline.usual_
    lost = (f for f in facts.alarming if f.id in LOST and f.id not in usual)
    found.append(next(lost, None))
    if facts.opening is not None:
        text = ""
        limit = len(labels) - 1 if baseline is None else baseline.open_phase_
        if labels and facts.open_phase >= 0:
            if facts.open_phase < limit:
                text = f"in phase {labels[facts.open_phase]}, expected {labels[limit]}"
        elif spread is not None and facts.held_s < HELD_SHARE * spread.held_s_:
            text = f"after {facts.held_s:.2f} s, in the references {spread.held_s_:.2f} s at least"
        if text:
            span = episode.span(facts.opening, facts.opening)
            found.append(Finding("opened-early", f"the gripper opened {text}", span))
    reached = facts.last_phase
    wanted = len(labels) - 1 if baseline is None else baseline.last_phase_
    is_known = facts.phase is not None and bool((facts.phase >= 0).all())
    if is_known and reached < wanted:
        text = f"it ends in phase {labels[reached]} at most, expected {labels[wanted]}"
        found.append(Finding("unfinished", text, episode.span(last, last)))
    elif facts.closes and facts.opening is None and baseline is not None and baseline.opens_:
        text = "the gripper closed and never opened again"
        found.append(Finding("unfinished", text, episode.span(last, last)))
    return found


# --- measurements ---------------------------------------------------------------------------


def _offsets(episode: Episode) -> Stamps:
    """(T,) nanoseconds from the start stamp."""
    offsets: Stamps = episode.stamps_ns - episode.start_ns
    return offsets


def _quantile(values: Floats, share: float) -> float:
    """The one of the values below which a share of them lies; far quicker than NumPy's."""
    place = int(share * (len(values) - 1))
    return float(np.partition(values, place)[place])


def _effector_name(episode: Episode) -> str:
    specs = episode.topic_map.with_role("effector")
    return specs[0].name if specs else episode.topic_map.clock


def _unit(episode: Episode) -> str:
    return episode.topic_map.fields[_effector_name(episode)].unit or "units"


def _speed(episode: Episode, periods_s: Floats) -> Floats:
    """(T - 1,) speed of the first effector, else of the clock's field; 0 where it is unknown."""
    values = episode.fields.get(_effector_name(episode))
    if values is None:
        return np.zeros(len(periods_s))
    with np.errstate(invalid="ignore", over="ignore"):
        moved = np.diff(values, axis=0)
        speed: Floats = np.sqrt(np.einsum("ij,ij->i", moved, moved)) / periods_s
    return np.where(np.isfinite(speed), speed, 0.0)


def _still(episode: Episode, times_s: Floats) -> tuple[dict[str, tuple[float, int, int]], Mask]:
    """Longest repetition of each topic of the arm, and which rows equal the one before.

    A topic of the arm tells where it is: the clock, an effector, joints. Any other observation
    counts unless it never changes: it may be a constant of this robot. Compared bit by bit, so
    that NaN equals NaN: what is not there is missing, not moving.
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
        if spec.role not in _MEASURED or name == fingers or np.isnan(values[0]).all():
            continue
        is_arm = spec.role != "observation" or spec.type.endswith("/JointState")
        (arm if is_arm else others).add(spec.topic)
    still = {
        topic: _longest(same, times_s)
        for topic, same in topics.items()
        if topic in arm or (topic in others and not same.all())
    }
    return still, rows


def _longest(mask: Mask, times_s: Floats) -> tuple[float, int, int]:
    """Longest run of a (T - 1,) mask of steps: its seconds, first and last row."""
    if not mask.any():
        return 0.0, 0, 0
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    first, last = edges[::2], edges[1::2]
    seconds = times_s[last] - times_s[first]
    best = int(np.argmax(seconds))
    return float(seconds[best]), int(first[best]), int(last[best])


def _inner(mask: Mask) -> Mask:
    """The mask without its runs at either end."""
    moving = np.flatnonzero(~mask)
    inner = np.zeros_like(mask)
    if len(moving):
        inner[moving[0] : moving[-1]] = mask[moving[0] : moving[-1]]
    return inner


def _phase(episode: Episode) -> Floats | None:
    """(T,) index of the phase, -1 where it is none of the map's."""
    specs = episode.topic_map.with_role("phase")
    values = episode.fields.get(specs[0].name) if specs else None
    if values is None:
        return None
    known = (values[:, 0] >= 0) & (values[:, 0] < len(specs[0].labels))
    return np.where(known, values[:, 0], -1.0)


def _gripper(episode: Episode) -> tuple[bool, Mask, int | None]:
    """Whether anything was commanded of one, (T,) commanded closed, first opening."""
    try:
        closed = is_closed_command(episode)
        is_used = bool(closed.any()) or bool(is_open_command(episode).any())
        return is_used, closed, first_opening(episode)
    except EpisodeError:  # no gripper in the map, or no such field in the episode
        return False, np.zeros(len(episode), dtype=bool), None
