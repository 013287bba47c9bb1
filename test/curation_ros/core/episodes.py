"""The factory of pick-and-place episodes, as tests import it."""

from __future__ import annotations

from curation_ros.testing.episodes import (
    CLOSE_AT,
    GRASP_STEPS,
    LIFT_STEPS,
    OPEN_WIDTH_M,
    START_NS,
    TAIL_STEPS,
    TASK_STEPS,
    copied,
    make_episode,
    make_pool,
    make_reference,
    moved,
    shifted,
    topic_map,
    with_fields,
)

__all__ = [
    "CLOSE_AT",
    "GRASP_STEPS",
    "LIFT_STEPS",
    "OPEN_WIDTH_M",
    "START_NS",
    "TAIL_STEPS",
    "TASK_STEPS",
    "copied",
    "make_episode",
    "make_pool",
    "make_reference",
    "moved",
    "shifted",
    "topic_map",
    "with_fields",
]
