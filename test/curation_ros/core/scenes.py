"""Carries of an object, made step by step, with all that can go wrong; by hand, without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from episodes import START_NS, topic_map

from curation_ros.core.episode.episode import Episode
from curation_ros.core.types import Floats

RATE_HZ = 20
APPROACH, GRASP, LIFT, TRANSPORT, RELEASE = 40, 15, 50, 60, 20
LIFT_AT = APPROACH + GRASP
TRANSPORT_AT = LIFT_AT + LIFT
RELEASE_AT = TRANSPORT_AT + TRANSPORT
N_STEPS = RELEASE_AT + RELEASE
STEP_M = 0.003
BELOW_M = 0.05
G_M_S2 = 9.81
OPEN_M, HELD_M = 0.08, 0.005


def scene(
    *,
    dropped_at: int | None = None,
    is_taken: bool = True,
    opened_at: int = RELEASE_AT,
    tilt_rad: float = 0.0,
    hover: int = 0,
    tremor_m: float = 0.0,
    tail: int | None = None,
) -> Episode:
    """An object that is lifted by 15 cm and carried by 18 cm; in the hand it hangs 5 cm below.

    Args:
        dropped_at: step at which it is no longer in the hand; by default when it is opened.
        is_taken: whether it comes along at all.
        opened_at: step of the opening command.
        tilt_rad: angle by which it turns about the effector in the first ten steps of LIFT.
        hover: steps after the end.
        tremor_m: the object at rest moves by that from step to step, so that it never repeats.
        tail: steps that are kept.
    """
    n = N_STEPS + hover
    step = np.arange(n)
    eef = np.tile([0.0, 0.0, 1.0], (n, 1))
    eef[:, 2] += STEP_M * np.clip(step - LIFT_AT, 0, LIFT)
    eef[:, 1] += STEP_M * np.clip(step - TRANSPORT_AT, 0, TRANSPORT)
    angle = tilt_rad * np.clip((step - LIFT_AT) / 10, 0, 1)
    hanging = BELOW_M * np.column_stack([0 * step, np.sin(angle), -np.cos(angle)])
    bowl = eef + hanging
    let_go = min(opened_at if dropped_at is None else dropped_at, n)
    if not is_taken:
        let_go = LIFT_AT
    since_s = (step[let_go:] - let_go + 1) / RATE_HZ
    held = bowl[let_go - 1]
    bowl[let_go:] = held
    bowl[let_go:, 2] = np.maximum(held[2] - 0.5 * G_M_S2 * since_s**2, 1.0 - BELOW_M)
    bowl[:, 0] += tremor_m * (step % 3)

    is_open = (step < APPROACH) | (step >= opened_at)
    lagged = is_open[np.maximum(step - 2, 0)]
    width = np.where(lagged, OPEN_M, HELD_M)
    phase = np.searchsorted(
        [0, APPROACH // 2, APPROACH, LIFT_AT, TRANSPORT_AT, RELEASE_AT], step, side="right"
    )
    fields = {
        "eef_position": eef,
        "eef_quat_xyzw": np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        "joint_position": np.tile(0.001 * step[:, None], (1, 7)),
        "finger_position": np.column_stack([width / 2, -width / 2]),
        "bowl_position": bowl,
        "plate_position": np.tile([0.0, 0.15, 0.95], (n, 1)),
        "phase": phase[:, None] - 1.0,
        "twist": np.gradient(eef, axis=0) * RATE_HZ,
        "gripper": np.where(is_open, -1.0, 1.0)[:, None],
    }
    made = Episode(
        id="00000000-0000-4000-8000-000000000001",
        name="scene",
        start_ns=START_NS,
        end_ns=START_NS + (n - 1) * 50_000_000,
        stamps_ns=START_NS + 50_000_000 * np.arange(n, dtype=np.int64),
        fields=fields,
        topic_map=topic_map(),
    )
    return made if tail is None else made.steps(tail)


def without(episode: Episode, *roles: str) -> Episode:
    """The same episode of a graph that lacks fields of some roles."""
    kept = {k: v for k, v in episode.topic_map.fields.items() if v.role not in roles}
    gripper = None if "gripper" in roles else episode.topic_map.gripper
    return replace(
        episode,
        topic_map=replace(episode.topic_map, fields=kept, gripper=gripper, state=(), action=()),
        fields={k: v for k, v in episode.fields.items() if k in kept},
    )


def one_after_the_other(first: Episode, second: Episode) -> Episode:
    """Two scenes in one episode: the second takes the plate, 30 cm beside."""
    n = len(first)
    fields = {k: np.concatenate([v, second.fields[k]]) for k, v in first.fields.items()}
    bowl, plate = fields["bowl_position"], fields["plate_position"]
    bowl[n:] = bowl[n - 1]
    plate[:n] = second.fields["bowl_position"][0] + [0.3, 0.0, 0.0]
    plate[n:] = second.fields["bowl_position"] + [0.3, 0.0, 0.0]
    fields["eef_position"][n:] += [0.3, 0.0, 0.0]
    stamps_ns = START_NS + 50_000_000 * np.arange(len(bowl), dtype=np.int64)
    return replace(first, stamps_ns=stamps_ns, end_ns=int(stamps_ns[-1]), fields=fields)


def tracked(
    places: Floats, rng: np.random.Generator, noise_m: float, late: int, dropout: float
) -> Floats:
    """Places as a tracker gives them: noisy, some steps late, and some of them not at all."""
    steps = np.arange(len(places))
    seen = places[np.maximum(steps - late, 0)]
    seen = seen + noise_m * rng.standard_normal(seen.shape)
    there = rng.random(len(steps)) >= dropout
    there[:1] = True
    return seen[np.maximum.accumulate(np.where(there, steps, 0))]
