"""Checks of a complete episode: what is wrong with the recording, the motion, or the task.

The builder sees samples and finds what single topics lack. Here the joined arrays are checked. If
there is a reference, they are compared with what trusted episodes look like. No check reads a
label.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.episode.findings import Finding
from curation_ros.core.evidence.alerts import LOST
from curation_ros.core.evidence.measurements import MIN_STEPS, Measurements, effector_unit
from curation_ros.core.evidence.recording_checks import (
    clipped_start,
    frozen_topics,
    gaps,
    padded_tail,
    wrong_rate,
)
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.evidence.baseline import Baseline

#: An episode shorter than this share of the shortest trusted one is too short: no operator is
#: four times as fast as the fastest.
MIN_DURATION_SHARE = 0.25
#: With fewer trusted episodes their spread says nothing.
MIN_REFERENCES = 3
#: No motion explains a step faster than this, in units of the episode's fast steps (95 %). Clean
#: simulated demonstrations reach 2.
JUMP_FACTOR = 8.0
#: A rest this long is an operator who thinks. With a reference, a rest must also be longer than
#: its longest rest by this factor.
IDLE_S, IDLE_FACTOR = 3.0, 2.0
#: Without phases: a hold shorter than this share of the shortest trusted one.
HELD_SHARE = 0.8


def check_episode(episode: Episode, baseline: Baseline | None = None) -> tuple[Finding, ...]:
    """Everything that the arrays of an episode show, in addition to `episode.findings`.

    Args:
        episode: any complete episode.
        baseline: fitted on trusted episodes of the same map. Without one, or with one of no
            episodes, nothing is compared. Its spread counts from MIN_REFERENCES episodes on.

    Returns:
        Findings in the order of `findings.FINDINGS`: of the recording, the motion and the task.
        An episode that is too short has that finding alone.
    """
    baseline = baseline if baseline is not None and baseline.n_ else None
    spread = baseline if baseline is not None and baseline.n_ >= MIN_REFERENCES else None
    whole = (0, max(0, episode.end_ns - episode.start_ns))
    n = len(episode)
    if n < MIN_STEPS:
        text = f"{n} steps with all that a step needs; expected at least {MIN_STEPS}"
        return (Finding("too-short", text, whole),)
    facts = Measurements.of(episode)
    if spread is not None and facts.duration_s < MIN_DURATION_SHARE * spread.duration_s_:
        text = f"{facts.duration_s:.2f} s; the shortest reference took {spread.duration_s_:.2f} s"
        return (Finding("too-short", text, whole),)
    padding = padded_tail(episode, facts)
    stop = n if padding is None else padding.first
    frozen = frozen_topics(episode, facts, spread, stop)
    # After frozen values, after a gap and into the padding, a fast step is no motion.
    excused = [last for _, last in frozen] + ([] if padding is None else [stop - 1])
    offsets = episode.stamps_ns - episode.start_ns
    excused += [int(np.searchsorted(offsets, end)) - 1 for _, end in gaps(episode)]
    found = [
        clipped_start(episode, facts, baseline, spread),
        *(finding for finding, _ in frozen),
        padding and Finding("padded-tail", padding.text, episode.span(stop, n - 1)),
        wrong_rate(episode, facts, spread),
        _idle(episode, facts, spread),
        _jump(episode, facts, excused),
        *_task(episode, facts, baseline, spread),
    ]
    known = [f for f in found if f is not None]
    if any(f.kind == "recording" or f.id == "jump" for f in (*episode.findings, *known)):
        # If one pose cannot be trusted, neither can what another pose shows relative to it.
        known = [f for f in known if f.id not in LOST]
    return tuple(known)


def _idle(episode: Episode, facts: Measurements, spread: Baseline | None) -> Finding | None:
    seconds, first, last = facts.idle
    if seconds < max(IDLE_S, 0.0 if spread is None else IDLE_FACTOR * spread.idle_s_):
        return None
    return Finding("idle", f"the effector rests for {seconds:.2f} s", episode.span(first, last))


def _jump(episode: Episode, facts: Measurements, excused: list[int]) -> Finding | None:
    """The fastest step, if no motion explains it; steps after excused rows do not count."""
    if not facts.fast > 0.0:
        return None
    speed = facts.speed.copy()
    speed[[row for row in excused if 0 <= row < len(speed)]] = 0.0
    at = int(np.argmax(speed))
    factor = float(speed[at]) / facts.fast
    if factor < JUMP_FACTOR:
        return None
    period_s = float(episode.stamps_ns[at + 1] - episode.stamps_ns[at]) / NS_PER_S
    text = (
        f"the effector moves by {facts.speed[at] * period_s:.3g} {effector_unit(episode)} in one "
        f"step, {factor:.0f} times as fast as in its fast steps"
    )
    return Finding("jump", text, episode.span(at, at + 1))


def _task(
    episode: Episode, facts: Measurements, baseline: Baseline | None, spread: Baseline | None
) -> list[Finding | None]:
    last = len(episode) - 1
    found: list[Finding | None] = []
    if facts.has_gripper and not facts.closes and (baseline is None or baseline.closes_):
        text = "the gripper was never commanded to close"
        found.append(Finding("never-grasped", text, episode.span(0, last)))
    usual = () if baseline is None else baseline.usual_
    found.append(next((f for f in facts.alerts if f.id in LOST and f.id not in usual), None))
    found.append(_opened_early(episode, facts, baseline, spread))
    found.append(_unfinished(episode, facts, baseline))
    return found


def _opened_early(
    episode: Episode, facts: Measurements, baseline: Baseline | None, spread: Baseline | None
) -> Finding | None:
    if facts.opening is None:
        return None
    labels = episode.phase_labels
    limit = len(labels) - 1 if baseline is None else baseline.open_phase_
    if labels and facts.open_phase >= 0:
        if facts.open_phase >= limit:
            return None
        text = f"in phase {labels[facts.open_phase]}, expected {labels[limit]}"
    elif spread is not None and facts.held_s < HELD_SHARE * spread.held_s_:
        text = f"after {facts.held_s:.2f} s, in the references {spread.held_s_:.2f} s at least"
    else:
        return None
    span = episode.span(facts.opening, facts.opening)
    return Finding("opened-early", f"the gripper opened {text}", span)


def _unfinished(
    episode: Episode, facts: Measurements, baseline: Baseline | None
) -> Finding | None:
    labels, last = episode.phase_labels, len(episode) - 1
    reached = facts.last_phase
    wanted = len(labels) - 1 if baseline is None else baseline.last_phase_
    is_known = facts.phase is not None and bool((facts.phase >= 0).all())
    if is_known and reached < wanted:
        text = f"it ends in phase {labels[reached]} at most, expected {labels[wanted]}"
    elif facts.closes and facts.opening is None and baseline is not None and baseline.opens_:
        text = "the gripper closed and never opened again"
    else:
        return None
    return Finding("unfinished", text, episode.span(last, last))
