"""Command and width of the gripper: the one module that knows the sign of the command.

Every function takes the meaning from the topic map's `GripperSpec`, never from a robot's names.
"""

from __future__ import annotations

from functools import reduce
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.once import once_per_episode
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.episode.topic_map import GripperSpec
    from curation_ros.core.types import Floats, Mask


#: Fingers have begun to follow a switch of the command after this time (10 steps at 20 Hz).
FINGER_DELAY_S = 0.5
#: A movement of less than this share of the largest width proves nothing.
STILL_SHARE = 0.1
#: Hysteresis on the width, as shares of its range in the episode: closed below, open above.
CLOSED_SHARE, OPEN_SHARE = 0.25, 0.75
#: A continuous command is stray if it lies beyond the declared ends by more than this share of
#: their distance. Fewer stray commands than the other share are a glitch, not another meaning.
MARGIN_SHARE, STRAY_SHARE = 0.1, 0.05


def _spec(episode: Episode) -> GripperSpec:
    spec = episode.topic_map.gripper
    if spec is None:
        raise EpisodeError(f"episode {episode.id}: the topic map declares no gripper")
    return spec


def gripper_command(episode: Episode) -> Floats:
    """(T,) command of the gripper, in its own unit.

    Raises:
        EpisodeError: if there is no gripper, no such field, or it has several columns.
    """
    spec = _spec(episode)
    values = episode.field(spec.field)
    if values.shape[1] != 1:
        raise EpisodeError(
            f"episode {episode.id}: gripper field {spec.field!r} has {values.shape[1]} columns, "
            "expected 1"
        )
    return values[:, 0]


def _held(sign: npt.NDArray[np.int8]) -> npt.NDArray[np.int8]:
    """Replace each 0 by the last value before it that is not 0. Leading zeros stay."""
    index = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign)), 0))
    held: npt.NDArray[np.int8] = sign[index]
    return held


@once_per_episode
def commanded(episode: Episode) -> npt.NDArray[np.int8]:
    """(T,) commanded state of the gripper: +1 open, -1 closed, 0 before the first command.

    Binary: the sign decides, and 0 holds the previous command. Continuous: the nearer end
    decides, and the exact middle holds.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    spec = _spec(episode)
    command = gripper_command(episode)
    if spec.kind == "binary":
        towards_open = command * spec.opens
    else:
        towards_open = np.abs(command - spec.closed_value) - np.abs(command - spec.open_value)
    # NaN compares false both ways, so it holds the previous command, as 0 does.
    sign = (towards_open > 0).astype(np.int8) - (towards_open < 0).astype(np.int8)
    return _held(sign)


def is_open_command(episode: Episode) -> Mask:
    """(T,) whether the gripper is commanded to open; see `commanded`.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    mask: Mask = commanded(episode) > 0
    return mask


def is_closed_command(episode: Episode) -> Mask:
    """(T,) whether the gripper is commanded to close; see `commanded`.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    mask: Mask = commanded(episode) < 0
    return mask


def opening_of(state: npt.NDArray[np.int8]) -> int | None:
    """First step that is open (+1) after a closed one (-1); None if there is none."""
    if not len(state):
        return None
    hits = np.flatnonzero((state > 0) & np.logical_or.accumulate(state < 0))
    return int(hits[0]) if len(hits) else None


def first_opening(episode: Episode) -> int | None:
    """First step that is commanded open after a closed one; None if there is none.

    An open gripper in the approach does not count, as it was not closed before.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    return opening_of(commanded(episode))


@once_per_episode
def finger_width(episode: Episode) -> Floats | None:
    """(T,) distance between the fingers in the field's unit, larger when open.

    This is the spread of the field's columns. A single column is the width itself. Columns that
    are equal at every step (mimic joints, as of a Franka hand) are half a width each.

    Returns:
        None if the topic map declares no gripper or no fingers.

    Raises:
        EpisodeError: if the episode lacks the declared field.
    """
    spec = episode.topic_map.gripper
    if spec is None or not spec.fingers:
        return None
    values = episode.field(spec.fingers)
    # Column by column, as max and min over so short an axis are several times slower.
    with np.errstate(invalid="ignore", over="ignore"):  # a broken sensor may send anything
        spread: Floats = reduce(np.maximum, values.T) - reduce(np.minimum, values.T)
        if values.shape[1] == 1 or not np.any(spread):
            spread = values.sum(axis=1)
    return spread


def width_state(width: Floats) -> npt.NDArray[np.int8]:
    """(T,) +1 open, -1 closed, 0 not known yet, by hysteresis on the width."""
    low, high = (float(width.min()), float(width.max())) if len(width) else (0.0, 0.0)
    if not high - low > STILL_SHARE * abs(high):  # the fingers never moved
        return np.zeros(len(width), dtype=np.int8)
    share = (width - low) / (high - low)
    sign = (share >= OPEN_SHARE).astype(np.int8) - (share <= CLOSED_SHARE).astype(np.int8)
    return _held(sign)


@once_per_episode
def contradiction(episode: Episode) -> str | None:
    """How the data contradict the declared meaning of the command, in one sentence.

    Three things are contradictions:

    - Continuous commands beyond the declared ends.
    - Binary commands of one sign only, which could never both open and close, if their effect
      shows that both are meant.
    - A sign that the fingers contradict. After each switch of the command the width is compared
      with the width FINGER_DELAY_S later, or at the next switch. It must shrink after a switch to
      closed and grow after one to open.

    Fingers that do not move are no contradiction: they may be blocked, slow or not measured.

    Returns:
        The contradiction; None if there is none, or nothing to compare with.

    Raises:
        EpisodeError: if a field that the topic map declares is missing.
    """
    spec = episode.topic_map.gripper
    if spec is None or len(episode) < 2:
        return None
    command, width = gripper_command(episode), finger_width(episode)
    if spec.kind == "continuous":
        text = _beyond_ends(command, spec)
    else:
        text = _one_sided(episode, command, width, spec)
    if text is not None or width is None:
        return text
    return _inverted(episode, width, spec)


def _beyond_ends(command: Floats, spec: GripperSpec) -> str | None:
    low, high = sorted((spec.open_value, spec.closed_value))
    margin = MARGIN_SHARE * (high - low)
    known = command[np.isfinite(command)]
    stray = (known < low - margin) | (known > high + margin)
    if not len(known) or stray.mean() <= STRAY_SHARE:
        return None
    return (
        f"{stray.mean():.0%} of the commands lie outside open_value {spec.open_value:g} and "
        f"closed_value {spec.closed_value:g}: they run from {known.min():g} to {known.max():g}"
    )


def _one_sided(
    episode: Episode, command: Floats, width: Floats | None, spec: GripperSpec
) -> str | None:
    known = np.where(np.isfinite(command), command, np.nan)  # NaN holds the previous command
    is_positive = bool((known > 0).any())
    if is_positive == bool((known < 0).any()):
        return None
    # By the map, commands of one sign can only open, or only close, and 0 holds. If a switch
    # from large to small commands moves the fingers the other way, both were meant.
    wanted = spec.opens if is_positive else -spec.opens
    share = np.abs(known) / np.nanmax(np.abs(known))
    level = _held((share >= OPEN_SHARE).astype(np.int8) - (share <= CLOSED_SHARE).astype(np.int8))
    switches = np.flatnonzero(level[:-1] * level[1:] < 0) + 1
    if not len(switches):
        return None
    ends = _settled(episode, switches)
    side = "below" if is_positive else "above"
    text = (
        f"the command is never {side} 0, so that with kind binary it can only "
        f"{'open' if wanted > 0 else 'close'}"
    )
    if width is None:
        # Without fingers: the command stays large, then small, each for longer than a person
        # presses a button by accident.
        long_ns = int(FINGER_DELAY_S * NS_PER_S)
        edges = np.concatenate([[0], switches, [len(level) - 1]])
        long = np.diff(episode.stamps_ns[edges]) >= long_ns
        fell = level[switches] < 0
        if not (fell & long[:-1] & long[1:]).any():
            return None
        return f"{text}, yet it goes back to {known[switches[fell][0]]:g}: kind continuous?"
    moved = np.where(np.isfinite(width[ends] - width[switches]), width[ends] - width[switches], 0)
    worst = int(np.argmin(moved * wanted))
    if -moved[worst] * wanted <= STILL_SHARE * _largest(width):
        return None
    return (
        f"{text}, yet the fingers moved {'together' if wanted > 0 else 'apart'} by "
        f"{_distance(episode, moved[worst])} after it went to {known[switches[worst]]:g}: "
        "kind continuous?"
    )


def _inverted(episode: Episode, width: Floats, spec: GripperSpec) -> str | None:
    state = commanded(episode)
    before, after = state[:-1], state[1:]
    switches = np.flatnonzero((before != 0) & (before != after)) + 1
    if not len(switches):
        return None
    moved = width[_settled(episode, switches)] - width[switches]
    wanted = state[switches]  # +1: must grow
    agreement = np.where(np.isfinite(moved), moved * wanted, 0.0)
    worst = int(np.argmin(agreement))
    if agreement.sum() >= 0 or -agreement[worst] <= STILL_SHARE * _largest(width):
        return None
    act = "an opening" if wanted[worst] > 0 else "a closing"
    way = "together" if wanted[worst] > 0 else "apart"
    return (
        f"after {act} command the fingers moved {way} by {_distance(episode, moved[worst])}: "
        f"the sign declared in the topic map (opens: {spec.opens:+d}) looks inverted"
    )


def _settled(episode: Episode, switches: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Step until which the fingers had time to follow each switch of the command."""
    stamps = episode.stamps_ns
    deadline_ns = stamps[switches] + int(FINGER_DELAY_S * NS_PER_S)
    last = np.searchsorted(stamps, deadline_ns, side="right") - 1
    ends: npt.NDArray[np.intp] = np.minimum(last, np.append(switches[1:], len(stamps) - 1))
    return ends


def _largest(width: Floats) -> float:
    finite = width[np.isfinite(width)]
    return float(np.abs(finite).max()) if len(finite) else 0.0


def _distance(episode: Episode, moved: float) -> str:
    spec = _spec(episode)
    unit, amount = episode.topic_map.fields[spec.fingers].unit, abs(float(moved))
    return f"{amount * 1000:.0f} mm" if unit == "m" else f"{amount:.3g} {unit}".strip()


def gripper_findings(episode: Episode) -> tuple[Finding, ...]:
    """The finding `gripper-meaning` if the data contradict the topic map, else nothing."""
    try:
        text = contradiction(episode)
    except EpisodeError:  # the builder has a finding for a missing field
        return ()
    if text is None:
        return ()
    return (Finding("gripper-meaning", text, (0, max(0, episode.end_ns - episode.start_ns))),)
