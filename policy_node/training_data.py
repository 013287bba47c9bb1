"""What a network learns from: the steps of all demonstrations as standardised rows."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator

import numpy as np
import torch

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats, Span
from policy_node.action import action_spec
from policy_node.mlp import standardise
from policy_node.observation import ObservationSpec, observation_spec
from policy_node.settings import TrainingSettings
from policy_node.variants import Variant

CURVE_EVERY = 100
"""Steps between two entries of the training curve, and steps whose batches are drawn at once."""


class TrainingData:
    """Observations and targets of the steps of all spans.

    Args:
        episodes: whole episodes, each with the span to learn from or None for all of it.
        variant: what to observe and to command.
        settings: of the training.

    Attributes:
        episodes: with their spans, by id and span.
        n_steps: rows of each.
        variant: name of the variant.
        observation: columns D.
        action: outputs A.
        mean, std: (D,) that the observations were standardised by.
        obs: (N, D) float32, standardised.
        targets: (N, A) float32.
        jitter: (S, D) float32, what noise of S values with standard deviation 1 adds to obs.
        clipped: command field -> share of its values that are beyond the scale.

    Raises:
        PolicyError: if there is no episode, one is given twice or cannot be used, or their topic
            maps differ.
    """

    def __init__(
        self,
        episodes: Iterable[tuple[Episode, Span | None]],
        variant: Variant,
        settings: TrainingSettings,
    ) -> None:
        self.episodes = _sorted(episodes)
        topic_map = self.episodes[0][0].topic_map
        where = f"variant {variant.name}"
        self.variant = variant.name
        self.observation = observation_spec(variant.observation, topic_map, where)
        parts = [self.observation.from_episode(episode, span) for episode, span in self.episodes]
        self.n_steps = [len(part) for part in parts]
        obs = np.concatenate(parts)
        self.action = action_spec(variant.action, topic_map, self.episodes, where)
        scaled = np.concatenate([self.action.scaled(*pair) for pair in self.episodes])
        self.clipped = self.action.clipped_shares(scaled)
        self.mean, self.std = normalisation(obs, self.observation, settings.std_floor)
        self.obs = torch.from_numpy(standardise(obs, self.mean, self.std))
        self.targets = torch.from_numpy(np.clip(scaled, -1.0, 1.0).astype(np.float32))
        # Of standardised columns, by noise of standard deviation 1.
        jitter = settings.start_jitter_m * self.observation.start_effect / self.std
        self.jitter = torch.from_numpy(jitter.astype(np.float32))

    def __len__(self) -> int:
        """Number of rows N."""
        return len(self.obs)

    def widths(self, hidden: tuple[int, ...]) -> tuple[int, ...]:
        """Widths of the layers of a network, from the observation to the output."""
        return (self.observation.width, *hidden, self.action.width)

    def draws(
        self, settings: TrainingSettings, seed: int
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """What each step learns from, CURVE_EVERY steps at a time.

        Args:
            settings: with steps and batch size B.
            seed: of the draws.

        Yields:
            For n steps, (n, B) row indices and (n, B, S) float32 noise of standard deviation 1.
        """
        draw = torch.Generator().manual_seed(seed)
        for first in range(0, settings.steps, CURVE_EVERY):
            shape = (min(CURVE_EVERY, settings.steps - first), settings.batch_size)
            picks = torch.randint(len(self), shape, generator=draw)
            yield picks, torch.randn(*shape, len(self.jitter), generator=draw)


def normalisation(obs: Floats, spec: ObservationSpec, std_floor: float) -> tuple[Floats, Floats]:
    """Mean and standard deviation to standardise by.

    Args:
        obs: (N, D).
        spec: of the observations.
        std_floor: least standard deviation, m or rad.

    Returns:
        (D,) mean and (D,) standard deviation; 0 and 1 in a one-hot.
    """
    mean = np.where(spec.is_one_hot, 0.0, obs.mean(axis=0))
    floor = std_floor * spec.per_si
    std = np.where(spec.is_one_hot, 1.0, np.maximum(obs.std(axis=0), floor))
    return mean, std


def _sorted(episodes: Iterable[tuple[Episode, Span | None]]) -> list[tuple[Episode, Span | None]]:
    """By id, then span: whatever the order of files, the rows have one order."""
    chosen = sorted(episodes, key=lambda pair: (pair[0].id, pair[1] or (-1, -1)))
    if not chosen:
        raise PolicyError("training: no episodes were given")
    for (a, span_a), (b, span_b) in itertools.pairwise(chosen):
        if (a.id, span_a) == (b.id, span_b):
            raise PolicyError(f"training: episode {a.id} is given twice with span {span_a}")
    first = chosen[0][0]
    for episode, _ in chosen:
        if episode.topic_map.hash != first.topic_map.hash:
            raise PolicyError(
                f"training: episode {episode.id} has topic map {episode.topic_map.hash}, "
                f"expected {first.topic_map.hash} as episode {first.id} has"
            )
    return chosen
