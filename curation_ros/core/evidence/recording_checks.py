"""Checks of the recording: clipped start, frozen topics, padded tail, wrong rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.evidence.measurements import (
    MEASURED,
    MIN_STEPS,
    Measurements,
    effector_unit,
    longest_run,
)
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.evidence.baseline import Baseline
    from curation_ros.core.types import Span

#: A start in mid-motion: the first step is faster than that of any trusted episode by this
#: factor, at this share of the episode's own fast steps ...
CLIPPED_SPEED_FACTOR, CLIPPED_SPEED_SHARE = 1.3, 0.5
#: ... and no longer accelerating. A start from rest at full speed has, in its first step, half
#: the speed that it has after four.
CLIPPED_RISE_SHARE, _RISE_STEPS = 0.7, 4
#: An arm's values repeat for a few steps if encoders are coarse or topics slower than the clock.
#: A topic is frozen after twice the silence that the map allows, and not before this time.
FROZEN_TOPIC_S = 0.5
#: Another measured topic must have moved by this share of its range meanwhile ...
FROZEN_MOVED_SHARE = 0.05
#: ... or a command by this share: more than the tremor of a hand around a command of zero.
FROZEN_COMMANDED_SHARE = 0.25
#: This many equal rows at the end are padding. Coarse encoders of a robot at rest repeat rows as
#: well, so the tail must also be this many times as long as any such rest before it.
PADDED_STEPS, PADDED_FACTOR = 10, 3
#: A step is irregular if its period differs from the median by more than half. A lost message
#: doubles a period; jitter of a fifth of a period at both ends stays below.
IRREGULAR_PERIOD_SHARE = 0.5
#: Single lost messages are counted elsewhere. A clock with more irregular steps than this share
#: has no rate.
IRREGULAR_STEPS_SHARE = 0.2
#: A rate differs if it is off the trusted rates by more than this: 30 from 25 Hz, not from 29 Hz.
RATE_TOLERANCE = 0.15


class Frozen(NamedTuple):
    """A frozen topic: its finding, and the last row that repeats."""

    finding: Finding
    last: int


class Padding(NamedTuple):
    """A padded tail: its first row, and what was found."""

    first: int
    text: str


def clipped_start(
    episode: Episode, facts: Measurements, baseline: Baseline | None, spread: Baseline | None
) -> Finding | None:
    """The finding that an episode begins in mid-motion."""
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
            f"the effector moves at {facts.start_speed:.3g} {effector_unit(episode)}/s in the "
            f"first step, in the references at {spread.start_speed_:.3g} at most"
        )
    else:
        return None
    return Finding("clipped-start", text, episode.span(0, 0))


def _only_opens(facts: Measurements) -> bool:
    """Whether something held from the first step on is released, and nothing grasped after it."""
    return facts.opening is not None and not facts.closed[facts.opening :].any()


def frozen_topics(
    episode: Episode, facts: Measurements, spread: Baseline | None, stop: int
) -> list[Frozen]:
    """Topics of the arm that repeat their values for long before row `stop`, while it moves."""
    found = []
    least_s = max(FROZEN_TOPIC_S, 2.0 * episode.topic_map.max_gap_s)
    for topic, (seconds, first, last) in facts.still.items():
        known_s = None if spread is None else spread.still_s_.get(topic)
        if seconds < max(least_s, 2.0 * (known_s or 0.0)) or last >= stop:
            continue
        begin, end = episode.span(first, last)
        if any(begin <= gap[1] and gap[0] <= end for gap in gaps(episode, topic)):
            continue  # no message came: the last value is held, and the gap is a finding itself
        # If no trusted episode ever repeats a value, the topic always shows noise. If no field
        # changed at all, nothing was measured. In both cases the robot need not have moved.
        nothing = facts.same_rows.all()
        if known_s != 0.0 and not nothing and not _moved_meanwhile(episode, topic, first, last):
            continue
        never = first == 0 and last == len(episode) - 1
        text = f"topic {topic!r}: " + (
            "its values never change" if never else f"its values repeat for {seconds:.2f} s"
        )
        found.append(Frozen(Finding("frozen", text, episode.span(first, last)), last))
    return found


def gaps(episode: Episode, topic: str | None = None) -> list[Span]:
    """Spans in which a topic, or any topic, was silent, as the builder found them."""
    return [
        f.span
        for f in episode.findings
        if f.id == "gap" and (topic is None or f.message.startswith(f"topic {topic!r}:"))
    ]


def _moved_meanwhile(episode: Episode, topic: str, first: int, last: int) -> bool:
    """Whether another topic of the arm, or the command, shows motion in steps first to last."""
    for spec in episode.topic_map.fields.values():
        values = episode.fields.get(spec.name)
        if values is None or spec.topic == topic or spec.role not in (*MEASURED, "action"):
            continue
        part = values[first : last + 1]
        share = FROZEN_COMMANDED_SHARE if spec.role == "action" else FROZEN_MOVED_SHARE
        with np.errstate(invalid="ignore", over="ignore"):
            moved = part.max(axis=0) - part.min(axis=0)
            if (moved > share * (values.max(axis=0) - values.min(axis=0))).any():
                return True
    return False


def padded_tail(episode: Episode, facts: Measurements) -> Padding | None:
    """The padding at the end of an episode, if there is any."""
    n = len(episode)
    changed = np.flatnonzero(~facts.same_rows)
    first = int(changed[-1]) + 1 if len(changed) else 0
    n_equal = n - first
    if n_equal < 2 or not first:
        return None
    is_zero = not any(
        values[-1].any()
        for name, values in episode.fields.items()
        if not episode.topic_map.fields[name].labels
    )
    if n_equal >= MIN_STEPS and is_zero:
        return Padding(first, f"the last {n_equal} rows are zeros in every field")
    rest = longest_run(facts.same_rows[:first], np.arange(n, dtype=np.float64))[0]
    if n_equal >= max(PADDED_STEPS, PADDED_FACTOR * (rest + 1)):
        text = f"the last {n_equal} rows are equal in every field, commands included"
        return Padding(first, text)
    return None


def wrong_rate(episode: Episode, facts: Measurements, spread: Baseline | None) -> Finding | None:
    """The finding that the clock is irregular, or at another rate than the references."""
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
