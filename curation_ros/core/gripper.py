"""What the gripper was told and what its fingers did: the one place that knows the sign.

Every function takes its meaning from the topic map's `GripperSpec`, never from a robot's names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import EpisodeError
from curation_ros.core.findings import Finding
from curation_ros.core.stream import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode import Episode
    from curation_ros.core.stream import Floats
    from curation_ros.core.topic_map import GripperSpec

Mask = npt.NDArray[np.bool_]

#: Fingers must have begun to follow a switch of the command after this long (10 steps at 20 Hz).
SETTLE_S = 0.5
#: Movement of less than this share of the largest width is no evidence of anything.
STILL_SHARE = 0.1
#: Hysteresis on the width, as shares of its range in the episode: below, above.
CLOSED_SHARE, OPEN_SHARE = 0.25, 0.75


def _spec(episode: Episode) -> GripperSpec:
    spec = episode.topic_map.gripper
    if spec is None:
        raise EpisodeError(f"episode {episode.id}: the topic map declares no gripper")
    return spec


def gripper_command(episode: Episode) -> Floats:
    """(T,) command of the gripper in its own unit.

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
    """Replace every 0 by the last value before it that is not 0; leading zeros stay."""
    index = np.maximum.accumulate(np.where(sign != 0, np.arange(len(sign)), 0))
    return sign[index]


def _commanded(episode: Episode) -> npt.NDArray[np.int8]:
    """(T,) +1 open, -1 closed, 0 nothing commanded yet."""
    spec = _spec(episode)
    command = gripper_command(episode)
    if spec.kind == "binary":
        towards_open = command * spec.opens
    else:
        towards_open = np.abs(command - spec.closed_value) - np.abs(command - spec.open_value)
    # NaN compares false both ways, so it holds, as 0 does.
    sign = (towards_open > 0).astype(np.int8) - (towards_open < 0).astype(np.int8)
    return _held(sign)


def is_open_command(episode: Episode) -> Mask:
    """(T,) whether the gripper is under the command to open.

    Binary: the sign decides and 0 holds the previous command. Continuous: the nearer end decides,
    the exact middle holds. Before the first command it is neither open nor closed.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    mask: Mask = _commanded(episode) > 0
    return mask


def is_closed_command(episode: Episode) -> Mask:
    """(T,) whether the gripper is under the command to close; see `is_open_command`."""
    mask: Mask = _commanded(episode) < 0
    return mask


def _first_opening(state: npt.NDArray[np.int8]) -> int | None:
    if not len(state):
        return None
    hits = np.flatnonzero((state > 0) & np.logical_or.accumulate(state < 0))
    return int(hits[0]) if len(hits) else None


def first_opening(episode: Episode) -> int | None:
    """First step commanded open after having been commanded closed; None if there is none.

    The opening of the approach does not count: nothing had been closed before it.

    Raises:
        EpisodeError: if the topic map declares no gripper or the episode lacks its field.
    """
    return _first_opening(_commanded(episode))


def finger_width(episode: Episode) -> Floats | None:
    """(T,) distance between the fingers in the field's unit, larger when open.

    The spread of the field's columns. A single column is taken as the width itself; columns that
    are equal at every step (mimic joints, as of a Franka hand) are taken as half a width each.

    Returns:
        None where the topic map declares no gripper or no fingers.
    """
    spec = episode.topic_map.gripper
    if spec is None or not spec.fingers:
        return None
    values = episode.field(spec.fingers)
    spread: Floats = values.max(axis=1) - values.min(axis=1)
    if values.shape[1] == 1 or not np.any(spread):
        spread = values.sum(axis=1)
    return spread


def _width_state(width: Floats) -> npt.NDArray[np.int8]:
    """(T,) +1 open, -1 closed, 0 not known yet, by hysteresis on the width."""
    low, high = (float(width.min()), float(width.max())) if len(width) else (0.0, 0.0)
    if not high - low > STILL_SHARE * abs(high):  # they never moved
        return np.zeros(len(width), dtype=np.int8)
    share = (width - low) / (high - low)
    sign = (share >= OPEN_SHARE).astype(np.int8) - (share <= CLOSED_SHARE).astype(np.int8)
    return _held(sign)


def fingers_closed(episode: Episode) -> Mask | None:
    """(T,) whether the fingers are together, as measured; None without fingers in the map."""
    width = finger_width(episode)
    if width is None:
        return None
    mask: Mask = _width_state(width) < 0
    return mask


def first_finger_opening(episode: Episode) -> int | None:
    """First step with the fingers apart after they had been together, as measured."""
    width = finger_width(episode)
    return None if width is None else _first_opening(_width_state(width))


def contradiction(episode: Episode) -> str | None:
    """Whether the fingers contradict the declared meaning of the command, in one sentence.

    After each switch of the command the width is compared with that SETTLE_S later (or at the
    next switch): it must shrink after a switch to closed and grow after one to open. Fingers that
    do not move are no contradiction: they may be blocked, slow or not measured.

    Returns:
        The contradiction, or None where there is none or nothing to judge by.

    Raises:
        EpisodeError: if a field that the topic map declares is missing.
    """
    spec = episode.topic_map.gripper
    width = finger_width(episode)
    if spec is None or width is None or len(episode) < 2:
        return None
    state = _commanded(episode)
    before, after = state[:-1], state[1:]
    switches = np.flatnonzero((before != 0) & (before != after)) + 1
    if not len(switches):
        return None
    stamps = episode.stamps_ns
    deadline = (
        np.searchsorted(stamps, stamps[switches] + int(SETTLE_S * NS_PER_S), side="right") - 1
    )
    ends = np.minimum(deadline, np.append(switches[1:], len(stamps) - 1))
    moved = width[ends] - width[switches]
    wanted = state[switches]  # +1: must grow
    agreement = np.where(np.isfinite(moved), moved * wanted, 0.0)
    worst = int(np.argmin(agreement))
    finite = width[np.isfinite(width)]
    scale = float(np.abs(finite).max()) if len(finite) else 0.0
    if agreement.sum() >= 0 or -agreement[worst] <= STILL_SHARE * scale:
        return None
    unit = episode.topic_map.fields[spec.fingers].unit
    amount = abs(float(moved[worst]))
    distance = f"{amount * 1000:.0f} mm" if unit == "m" else f"{amount:.3g} {unit}".strip()
    act = "an opening" if wanted[worst] > 0 else "a closing"
    way = "together" if wanted[worst] > 0 else "apart"
    return (
        f"after {act} command the fingers moved {way} by {distance}: "
        f"the sign declared in the topic map (opens: {spec.opens:+d}) looks inverted"
    )


def gripper_findings(episode: Episode) -> tuple[Finding, ...]:
    """The finding `gripper-meaning` where the fingers contradict the topic map, else nothing."""
    try:
        text = contradiction(episode)
    except EpisodeError:  # a missing field is the builder's finding, not ours
        return ()
    if text is None:
        return ()
    return (Finding("gripper-meaning", text, (0, max(0, episode.end_ns - episode.start_ns))),)
