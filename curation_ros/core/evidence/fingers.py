"""Whether the measured fingers still hold something, by their gap or by their effort.

This is weaker evidence than `carrying`: it is of the gripper, not of the object. A gap shows
fingers that closed on nothing or moved apart. An object thinner than EMPTY_SHARE of the gripper's
opening looks like no object. Effort is compared with the effort at the grasp.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.gripper import commanded, finger_width
from curation_ros.core.evidence.holds import (
    GRASP_S,
    Carrying,
    Hold,
    carry_labels,
    carry_steps,
    no_evidence,
    without_holds,
)
from curation_ros.core.evidence.once import once_per_episode
from curation_ros.core.types import NS_PER_S, Mask

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats

#: Fingers closer together than this share of their widest opening so far have closed on nothing.
#: The wall of a bowl takes 5 % of a Panda hand's opening; empty fingers meet at 1 %.
EMPTY_SHARE = 0.025
#: Fingers farther apart than at their narrowest since the grasp, by this share, have let go.
APART_SHARE = 0.05
#: Less than this share of the effort at the grasp holds nothing. A bowl that turns in the fingers
#: leaves a third of it.
LOOSE_SHARE = 0.2
#: An effort at the grasp below this share of the largest so far was never a grasp.
WEAK_SHARE = 0.1
#: So many steps in a row make it certain.
_CERTAIN_STEPS = 2


def held_by_fingers(episode: Episode, *, effort: str = "") -> Carrying:
    """What the fingers show about everything that was to be carried.

    Causal: the first n steps of an episode give the same answer alone as in the complete one.

    Args:
        episode: the episode, or as much of it as there is.
        effort: field with the efforts of the fingers, to use these; empty: use the gap.

    Returns:
        Holds whose object is the field that was read. `gap_m` is how much wider the gap was when
        the loss was noticed than at its narrowest, in the unit of the field; 0 for effort.
    """
    return _held_by(episode, effort) if effort else _held_by_gap(episode)


@once_per_episode
def _held_by_gap(episode: Episode) -> Carrying:
    return _held_by(episode, "")


def _held_by(episode: Episode, effort: str) -> Carrying:
    try:
        held, blind = carry_steps(episode)
        is_open = _is_open(episode)
        values, name = _read(episode, effort)
    except EpisodeError as err:
        return Carrying(reason=no_evidence(err))
    labels = carry_labels(episode.topic_map)
    phase = episode.phase
    known = np.flatnonzero(held | ~blind)
    holds = []
    for first, last in _holds(held, blind):
        since_ns = episode.stamps_ns[first] - int(GRASP_S * NS_PER_S)
        before = int(np.searchsorted(episode.stamps_ns, since_ns))
        measure = _by_effort if effort else _by_gap
        hold = measure(values, Hold(name, first, last, "carried"), before)
        at = last if hold.departed is None else hold.departed
        where = "" if phase is None else labels.get(int(np.nan_to_num(phase[at], nan=-1.0)), "")
        opened = hold.departed is not None and bool(is_open[first : hold.departed + 1].any())
        hold = replace(hold, phase=where, opened=opened)
        if hold.state == "carried" and last == known[-1]:
            where = f"in {where}" if where else "with the gripper closed"
            hold = replace(hold, state="unknown", reason=f"it ends {where}", n_carried=0)
        holds.append(hold)
    if not holds:
        return Carrying(reason=without_holds(episode.topic_map, "nothing was held long"))
    return Carrying(tuple(holds))


def _is_open(episode: Episode) -> Mask:
    if episode.topic_map.gripper is None:
        return np.zeros(len(episode), dtype=bool)
    mask: Mask = commanded(episode) > 0
    return mask


def _read(episode: Episode, effort: str) -> tuple[Floats, str]:
    """(T,) width, or (T, D) effort, and the name of its field.

    Raises:
        EpisodeError: if there is no such field.
    """
    if effort:
        return episode.field(effort), effort
    width, gripper = finger_width(episode), episode.topic_map.gripper
    if width is None or gripper is None:
        raise EpisodeError(f"episode {episode.id}: the topic map declares no fingers")
    return width, gripper.fingers


def _holds(held: Mask, blind: Mask) -> list[tuple[int, int]]:
    """First and last step of each hold; steps of unknown phase neither begin nor end one."""
    known = np.flatnonzero(held | ~blind)
    on = held[known].astype(np.int8)
    edges = np.flatnonzero(np.diff(on, prepend=0, append=0))
    return [
        (int(known[a]), int(known[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _by_gap(width: Floats, hold: Hold, before: int) -> Hold:
    """A hold as the gap between the fingers shows it; `before` is a step before the grasp."""
    part = slice(before, hold.last + 1)
    gap, skipped = width[part], hold.first - before
    known = np.isfinite(width[: hold.last + 1])
    if not known[hold.first :].any():
        return replace(hold, state="unknown", reason=f"no value of {hold.object}")
    opening = np.fmax.accumulate(width[: hold.last + 1])[part]
    # The wider of two in a row: one outlier does not set the narrowest gap.
    narrowest = np.fmin.accumulate(np.fmax(gap, np.concatenate([gap[:1], gap[:-1]])))
    with np.errstate(invalid="ignore", over="ignore"):
        lost = (gap < EMPTY_SHARE * opening) | (gap - narrowest > APART_SHARE * opening)
    decided = _decided(hold, lost[skipped:])
    if decided.noticed is None:
        return decided
    at = decided.noticed - before
    return replace(decided, gap_m=max(0.0, float(gap[at] - narrowest[at])))


def _by_effort(effort: Floats, hold: Hold, before: int) -> Hold:
    """A hold as the effort of the fingers shows it; `before` is a step before the grasp."""
    grasp = effort[before : hold.first + 1]
    grasp = grasp[np.isfinite(grasp).all(axis=1)]
    if not len(grasp):
        return replace(hold, state="unknown", reason=f"no value of {hold.object} at the grasp")
    typical = np.median(grasp, axis=0)
    so_far = np.linalg.norm(effort[: hold.first + 1], axis=1)
    strength = float(np.linalg.norm(typical))
    if strength <= WEAK_SHARE * float(np.nanmax(so_far)):
        return _decided(hold, np.ones(hold.n_steps, dtype=bool))
    share = effort[hold.first : hold.last + 1] @ typical / strength**2
    with np.errstate(invalid="ignore"):
        return _decided(hold, share < LOOSE_SHARE)


def _decided(hold: Hold, lost: Mask) -> Hold:
    """The hold with its outcome.

    Args:
        hold: without an outcome.
        lost: (n_steps,) in which of its steps nothing seems to be held.
    """
    run = np.ones(len(lost), dtype=bool)
    for k in range(_CERTAIN_STEPS):
        run[k:] &= lost[: len(lost) - k]
        run[:k] = False
    certain = np.flatnonzero(run)
    if not len(certain):
        return replace(hold, n_carried=hold.n_steps)
    noticed = int(certain[0])
    departed = noticed - _CERTAIN_STEPS + 1
    return replace(
        hold,
        state="broken" if departed else "never",
        departed=hold.first + departed,
        noticed=hold.first + noticed,
        n_carried=departed,
    )
