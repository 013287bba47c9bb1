"""A pool of made-up episodes: two that succeed, and three that drop the object."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scenes import LIFT_AT, RATE_HZ, scene

from curation_ros.core.decision.salvage import DEFAULT_MARGIN_S
from curation_ros.core.episode.episode import Episode
from curation_ros.dataset.dataset import Dataset
from curation_ros.study.curated import curate, timeline_of
from curation_ros.study.pools import Pool

DROPS = (LIFT_AT + 20, LIFT_AT + 40, LIFT_AT + 60)
MARGIN = round(DEFAULT_MARGIN_S * RATE_HZ)
MARGINS = (0, 5, MARGIN)


def named(episode: Episode, k: int) -> Episode:
    """With a name, and with noise, as a recording without noise counts as frozen."""
    rng = np.random.default_rng(k)
    fields = dict(episode.fields)
    for field in ("eef_position", "bowl_position", "plate_position", "joint_position"):
        fields[field] = fields[field] + 1e-5 * rng.standard_normal(fields[field].shape)
    return replace(episode, id=f"a-{k}", name=f"bowl-{k:04}", fields=fields)


def scenes_of() -> list[Episode]:
    """Two that succeed, and one for each of DROPS."""
    broken = [scene(dropped_at=at, opened_at=at) for at in DROPS]
    return [named(episode, k) for k, episode in enumerate([scene(), scene(), *broken])]


def pool_of(folder: Path, episodes: Sequence[Episode], margins: Sequence[int] = MARGINS) -> Pool:
    """A pool of these episodes, of which the first two have succeeded."""
    return Pool(
        name="made",
        dataset=Dataset(folder / "pool", create=True),
        episodes=tuple(e.id for e in episodes),
        names={e.id: e.name for e in episodes},
        good={e.id: k < 2 for k, e in enumerate(episodes)},
        scores={},
        needs={},
        timelines={e.id: timeline_of(e) for e in episodes},
        curated=curate(episodes, margins),
    )
