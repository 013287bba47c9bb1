"""Synthetic demonstrations: a point goes to the bowl and on to the plate; no simulator."""

from __future__ import annotations

import uuid
from pathlib import Path

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap, read_topic_map
from policy_node.observation import ObservationSpec, observation_spec
from policy_node.variants import read_training_config

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 50_000_000
_CONFIG = Path(__file__).parents[2] / "config"
TOPIC_MAP = read_topic_map(_CONFIG / "topics.yaml")
#: The variants that the package ships, by name.
VARIANTS = read_training_config(_CONFIG / "training.yaml").variants
RELATIVE = VARIANTS["relative"]
N_STEPS = 60


def demonstration(
    seed: int, n_steps: int = N_STEPS, topic_map: TopicMap = TOPIC_MAP, speed: float = 0.15
) -> Episode:
    """An episode whose action follows from its observation; bowl and plate move from half on."""
    rng = np.random.default_rng(seed)
    bowl, plate = rng.uniform(-0.1, 0.1, 3), rng.uniform(0.2, 0.3, 3)
    bowl[2], plate[2] = 0.9, 0.9
    eef = rng.uniform(-0.3, -0.2, 3)
    phase = np.repeat(np.arange(6), -(-n_steps // 6))[:n_steps]
    rows: dict[str, list[np.ndarray]] = {name: [] for name in topic_map.fields}
    for k in range(n_steps):
        goal = bowl if phase[k] < 3 else plate
        twist = np.clip(3.0 * (goal - eef), -speed, speed)
        moved = 0.01 * max(0, k - n_steps // 2)
        step = {
            "eef_position": eef,
            "finger_position": np.array([0.04, -0.04]),
            "bowl_position": bowl + moved,
            "plate_position": plate + moved,
            "phase": phase[k : k + 1].astype(float),
            "twist": twist,
            "gripper": np.array([1.0 if 2 <= phase[k] < 5 else -1.0]),
        }
        for name, spec in topic_map.fields.items():
            rows[name].append(step.get(name, np.zeros(len(spec.values))))
        eef = eef + 0.05 * twist
    stamps = START_NS + PERIOD_NS * np.arange(1, n_steps + 1, dtype=np.int64)
    return Episode(
        id=str(uuid.UUID(int=seed + 1)),
        name=f"demo-{seed}",
        start_ns=START_NS,
        end_ns=int(stamps[-1]),
        stamps_ns=stamps,
        fields={name: np.array(values) for name, values in rows.items()},
        topic_map=topic_map,
    )


def libero_observation(variant: str = "relative") -> ObservationSpec:
    """Columns of a variant that the package ships."""
    return observation_spec(VARIANTS[variant].observation, TOPIC_MAP, variant)


def step_values(episode: Episode, k: int) -> dict[str, np.ndarray]:
    """Observation of step k, by field."""
    return {name: values[k] for name, values in episode.fields.items()}
