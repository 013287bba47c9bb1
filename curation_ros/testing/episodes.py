"""A small factory of pick-and-place episodes, without simulator, bag or ROS.

The arm goes over an object, down, closes, lifts, carries and opens. An early release is
`open_at=140`: the arm goes on as if it held the object. Durations follow the LIBERO task at 20 Hz.
The topic map is the one that the package ships.
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.types import Floats, Mask

START_NS = 1_781_000_000_000_000_000
CLOSE_AT, GRASP_STEPS, LIFT_STEPS = 95, 15, 59
#: A good episode of 240 steps opens three steps before its end.
TASK_STEPS, TAIL_STEPS = 240, 3
OPEN_WIDTH_M, HELD_WIDTH_M = 0.08, 0.008
#: Velocity of the effector in each phase, as a share of the largest.
_VELOCITIES = np.array(
    [[0.1, 0.05, -0.08], [0, 0, -0.2], [0, 0, 0], [0, 0, 0.2], [0.05, 0.15, -0.05], [0, 0, 0]]
)


@cache
def topic_map() -> TopicMap:
    """The map that the package ships."""
    return topic_map_or_default("")


def make_episode(
    rng: np.random.Generator | None = None,
    n_steps: int = TASK_STEPS,
    *,
    task_steps: int | None = None,
    close_at: int | None = CLOSE_AT,
    open_at: int | None = -1,
    noise: float = 0.01,
    tremor: float = 0.0,
    rate_hz: float = 20.0,
    start_ns: int = START_NS,
    opens: int = -1,
    finger_lag: int = 2,
    episode_id: str | None = None,
    name: str = "pick-1",
    findings: Sequence[Finding] = (),
    fields: Mapping[str, Floats] | None = None,
) -> Episode:
    """Make an episode.

    Args:
        rng: source of noise and of the id; by default a new one with seed 0.
        n_steps: number of steps; after `task_steps` the arm hovers.
        task_steps: steps of the motion; by default `n_steps`.
        close_at: step of the closing command, None: never.
        open_at: step of the opening command, -1: three steps before the motion ends, None: never.
        noise: standard deviation of the twist.
        tremor: amplitude of an 8 Hz oscillation of the twist.
        rate_hz: rate of the clock.
        start_ns: start stamp; the first step is 10 ms later.
        opens: sign of the command as it is sent. The map says -1, so +1 contradicts it.
        finger_lag: steps that the fingers take to follow.
        episode_id: by default drawn from `rng`.
        name: short name.
        findings: of the recording.
        fields: fields to replace.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    chosen_id = episode_id or str(uuid.UUID(bytes=rng.bytes(16), version=4))
    release_at = (task_steps or n_steps) - TAIL_STEPS
    if open_at == -1:
        open_at = release_at
    grasp_at = CLOSE_AT if close_at is None else close_at
    phase = _phase(n_steps, grasp_at, release_at)
    twist = _VELOCITIES[phase.astype(int)] + noise * rng.standard_normal((n_steps, 3))
    twist[:, 0] += tremor * np.sin(2 * np.pi * 8.0 * np.arange(n_steps) / rate_hz)
    eef = np.array([0.0, 0.0, 1.2]) + np.cumsum(twist * 0.013, axis=0)
    is_open = _open_command(n_steps, close_at, open_at)
    lagged = is_open[np.maximum(np.arange(n_steps) - finger_lag, 0)]
    width = np.where(lagged, OPEN_WIDTH_M, HELD_WIDTH_M)
    made = {
        "eef_position": eef,
        "eef_quat_xyzw": np.tile([1.0, 0.0, 0.0, 0.0], (n_steps, 1)),
        "joint_position": np.cumsum(0.01 * rng.standard_normal((n_steps, 7)), axis=0),
        "finger_position": np.column_stack([width / 2, -width / 2]),
        "bowl_position": _bowl(eef, is_open, grasp_at + GRASP_STEPS, rate_hz),
        "plate_position": np.tile([0.05, 0.2, 0.9], (n_steps, 1)),
        "phase": phase[:, None],
        "twist": twist,
        "gripper": np.where(is_open, opens, -opens).astype(np.float64)[:, None],
        **(fields or {}),
    }
    period_ns = round(1e9 / rate_hz)
    stamps_ns = start_ns + 10_000_000 + period_ns * np.arange(n_steps, dtype=np.int64)
    return Episode(
        id=chosen_id,
        name=name,
        start_ns=start_ns,
        end_ns=int(stamps_ns[-1]) if n_steps else start_ns,
        stamps_ns=stamps_ns,
        fields=made,
        topic_map=topic_map(),
        findings=tuple(findings),
    )


def _phase(n_steps: int, grasp_at: int, release_at: int) -> Floats:
    """(n_steps,) index of the phase."""
    lift_at = grasp_at + GRASP_STEPS
    starts = [0, int(0.6 * grasp_at), grasp_at, lift_at, lift_at + LIFT_STEPS, release_at]
    # A release before a phase begins leaves that phase out.
    begun = np.searchsorted(np.minimum(starts, release_at), np.arange(n_steps), side="right")
    return (begun - 1).astype(np.float64)


def _open_command(n_steps: int, close_at: int | None, open_at: int | None) -> Mask:
    """(n_steps,) whether the gripper is commanded to open."""
    is_open = np.ones(n_steps, dtype=bool)
    if close_at is not None:
        is_open[close_at:] = False
        if open_at is not None:
            is_open[max(open_at, 0) :] = True
    return is_open


def _bowl(eef: Floats, is_open: Mask, lift_at: int, rate_hz: float) -> Floats:
    """(T, 3) positions of the bowl: it lies, moves with the effector, and falls when released."""
    n_steps = len(eef)
    bowl = np.tile(eef[min(lift_at, n_steps - 1)] if n_steps else np.zeros(3), (n_steps, 1))
    held = np.flatnonzero(~is_open & (np.arange(n_steps) >= lift_at))
    bowl[held] = eef[held]
    if len(held) and held[-1] < n_steps - 1:
        last = held[-1]
        fallen_m = 0.5 * 9.81 * (np.arange(1, n_steps - last) / rate_hz) ** 2
        table_m = bowl[last + 1 :, 2].copy()
        bowl[last + 1 :] = eef[last]
        bowl[last + 1 :, 2] = np.maximum(eef[last, 2] - fallen_m, table_m)
    return bowl


def make_reference(rng: np.random.Generator, n: int = 6) -> list[Episode]:
    """Good episodes of slightly different lengths."""
    return [
        make_episode(rng, TASK_STEPS - 6 + 3 * k, name=f"good-{k}", close_at=CLOSE_AT - 2 + k)
        for k in range(n)
    ]


def moved(episode: Episode, x_m: float) -> Episode:
    """The same episode with its object moved along x: another start."""
    return with_fields(episode, bowl_position=episode.fields["bowl_position"] + [x_m, 0.0, 0.0])


def make_pool(rng: np.random.Generator, n: int = 8) -> list[Episode]:
    """A dataset without labels, in which each episode has its own start."""
    return [moved(e, 0.02 * k) for k, e in enumerate(make_reference(rng, n))]


def shifted(episode: Episode, by_ns: int) -> Episode:
    """The same episode at another time."""
    return replace(
        episode,
        start_ns=episode.start_ns + by_ns,
        end_ns=episode.end_ns + by_ns,
        stamps_ns=episode.stamps_ns + by_ns,
    )


def copied(episode: Episode, **changes: object) -> Episode:
    """The same episode with its own arrays."""
    return replace(
        episode,
        stamps_ns=episode.stamps_ns.copy(),
        fields={k: v.copy() for k, v in episode.fields.items()},
        **changes,  # type: ignore[arg-type]
    )


def with_fields(episode: Episode, **fields: Floats) -> Episode:
    """The same episode with other fields."""
    return replace(episode, fields={**episode.fields, **fields})
