"""MLPs with random weights: they move, and every wrong number shows."""

from __future__ import annotations

from typing import Any

import numpy as np
from demonstrations import TOPIC_MAP, VARIANTS, libero_observation

from policy_node.action import action_spec
from policy_node.mlp import MlpPolicy
from policy_node.mlp_card import MlpCard
from policy_node.settings import TrainingSettings

HIDDEN = 8


def card(variant: str = "relative", **changes: Any) -> MlpCard:
    values = {
        "kind": "mlp",
        "id": "01990000-0000-7000-8000-000000000000",
        "created_at": "2026-01-01T00:00:00+00:00",
        "topic_map_hash": TOPIC_MAP.hash,
        "selection_name": "all",
        "selection_hash": "abc",
        "episodes": (
            {"id": "a", "span": [0, 5], "n_steps": 3},
            {"id": "b", "span": None, "n_steps": 2},
        ),
        "seed": 7,
        "versions": {"python": "3.11"},
        "variant": variant,
        "observation": libero_observation(variant),
        "action": action_spec(VARIANTS[variant].action, TOPIC_MAP, (), variant),
        "settings": TrainingSettings(steps=100, hidden=(HIDDEN,), start_jitter_m=4e-3),
        "clipped": {"twist": 0.0},
        "curve": ((100, 0.5),),
        "seconds": 1.5,
    }
    return MlpCard(**{**values, **changes})


def mlp(variant: str = "relative", **changes: Any) -> MlpPolicy:
    """A policy of LIBERO; equal each time.

    Args:
        variant: that the package ships.
        changes: of its card.
    """
    made = card(variant, **changes)
    rng = np.random.default_rng(0)
    width = made.observation.width
    weights = [
        (rng.normal(size=(n_out, n_in)).astype(np.float32), np.ones(n_out, np.float32))
        for n_in, n_out in ((width, HIDDEN), (HIDDEN, 4))
    ]
    return MlpPolicy(made, weights, rng.normal(size=width), rng.uniform(0.1, 1.0, width))
