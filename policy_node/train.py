"""Behaviour cloning: a small network learns to answer observations as demonstrations did."""

from __future__ import annotations

import itertools
import math
import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
import torch

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Span
from curation_ros.version import __version__
from policy_node.mlp import MlpPolicy, Weights
from policy_node.mlp_card import MlpCard
from policy_node.settings import DEFAULTS, TrainingSettings
from policy_node.training_data import CURVE_EVERY, TrainingData
from policy_node.variants import Variant

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy and how it came to be.

    Attributes:
        policy: acts without torch; `policy.save` keeps it.
        network: the same in torch, on standardised observations.
        loss: mean loss of the last batches of the curve.
        curve: (step, mean loss of the batches since the entry before).
        losses: of every batch, one per step.
        seconds: duration of the training.
    """

    policy: MlpPolicy
    network: torch.nn.Sequential
    loss: float
    curve: tuple[tuple[int, float], ...]
    losses: tuple[float, ...]
    seconds: float


def train(
    episodes: Iterable[tuple[Episode, Span | None]],
    variant: Variant,
    *,
    seed: int,
    settings: TrainingSettings = DEFAULTS,
    selection: tuple[str, str] = ("", ""),
    progress: Progress | None = None,
) -> TrainedPolicy:
    """Train a policy by behaviour cloning; equal input gives equal bits on one machine.

    Which rows a batch has depends on the seed and on the episodes' ids, spans and lengths, never
    on the order in which the episodes are given.

    Args:
        episodes: whole episodes, each with the span to learn from (nanoseconds from the start
            stamp, inclusive) or None for all of it. The values at the start are always those of
            the whole episode.
        variant: what to observe and to command.
        seed: of the initial weights, the batches and the noise.
        settings: numbers of the training.
        selection: name and hash of the manifest, for the card.
        progress: called with step and mean loss every CURVE_EVERY steps and after the last.

    Raises:
        PolicyError: if there is no episode, one is given twice or does not have what the variant
            names, their topic maps differ, the seed is out of range, or the loss is not finite
            (naming the step).
    """
    started_s = time.perf_counter()
    check_seed(seed)
    data = TrainingData(episodes, variant, settings)
    with one_thread():
        network = new_network(data.widths(settings.hidden), seed)
        losses = _fit(network, data, settings, seed, progress)
    return trained_policy(
        network, losses, data, settings, seed, selection, time.perf_counter() - started_s
    )


def trained_policy(
    network: torch.nn.Sequential,
    losses: Sequence[float],
    data: TrainingData,
    settings: TrainingSettings,
    seed: int,
    selection: tuple[str, str],
    seconds: float,
) -> TrainedPolicy:
    """Write the card of a trained network.

    Args:
        network: trained.
        losses: of every batch.
        data: that it was trained on.
        settings: that it was trained with.
        seed: of the initial weights, the batches and the noise.
        selection: name and hash of the manifest.
        seconds: duration of the training.

    Raises:
        PolicyError: if a weight is not finite.
    """
    curve = tuple(
        (first + len(block), sum(block) / len(block))
        for first in range(0, len(losses), CURVE_EVERY)
        for block in [losses[first : first + CURVE_EVERY]]
    )
    card = MlpCard(
        kind="mlp",
        id=new_episode_id(),
        created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        topic_map_hash=data.episodes[0][0].topic_map.hash,
        selection_name=selection[0],
        selection_hash=selection[1],
        episodes=tuple(
            {"id": episode.id, "span": span and list(span), "n_steps": n}
            for (episode, span), n in zip(data.episodes, data.n_steps, strict=True)
        ),
        seed=seed,
        versions={
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": torch.__version__,
            "curation_ros": __version__,
        },
        variant=data.variant,
        observation=data.observation,
        action=data.action,
        settings=settings,
        clipped=data.clipped,
        curve=curve,
        seconds=seconds,
    )
    weights = [(_array(layer.weight), _array(layer.bias)) for layer in linear_layers(network)]
    policy = MlpPolicy(card, weights, data.mean, data.std, f"policy {card.id}")
    return TrainedPolicy(policy, network, curve[-1][1], curve, tuple(losses), seconds)


def check_seed(seed: int) -> None:
    """Refuse a seed that torch's generators do not take.

    Raises:
        PolicyError: if it is negative or has more than 63 bits.
    """
    if not 0 <= seed < 2**63:
        raise PolicyError(f"training: seed is {seed}, expected 0 or more and less than 2**63")


def check_loss(loss: float, step: int) -> None:
    """Refuse a loss from which no training recovers.

    Raises:
        PolicyError: if it is not finite.
    """
    if not math.isfinite(loss):
        raise PolicyError(f"training: the loss is {loss} in step {step}, expected a finite number")


@contextmanager
def one_thread() -> Iterator[None]:
    """One thread of torch: the order of sums, and so the bits, depends on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def new_network(widths: tuple[int, ...], seed: int) -> torch.nn.Sequential:
    """A network with initial weights.

    Args:
        widths: of the layers, from the observation to the output.
        seed: of the weights.
    """
    # torch's layers draw from the global generator, which is the caller's: it is put back.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        modules: list[torch.nn.Module] = []
        for n_in, n_out in itertools.pairwise(widths):
            modules += [torch.nn.Linear(n_in, n_out), torch.nn.ReLU()]
    modules[-1] = torch.nn.Tanh()
    return torch.nn.Sequential(*modules)


def linear_layers(network: torch.nn.Sequential) -> list[torch.nn.Linear]:
    """The layers with weights, from the observation to the output."""
    return [layer for layer in network if isinstance(layer, torch.nn.Linear)]


def _fit(
    network: torch.nn.Sequential,
    data: TrainingData,
    settings: TrainingSettings,
    seed: int,
    progress: Progress | None,
) -> list[float]:
    """Train in place; returns the loss of every batch."""
    optimizer = torch.optim.Adam(
        network.parameters(), lr=settings.lr, weight_decay=settings.weight_decay
    )
    losses: list[float] = []
    for picks, noise in data.draws(settings, seed):
        first = len(losses)
        for pick, shift in zip(picks, noise, strict=True):
            obs = torch.addmm(data.obs[pick], shift, data.jitter)
            loss = torch.nn.functional.mse_loss(network(obs), data.targets[pick])
            value = loss.item()
            check_loss(value, len(losses))
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            losses.append(value)
        if progress is not None:
            progress(len(losses), sum(losses[first:]) / (len(losses) - first))
    return losses


def _array(parameter: torch.Tensor) -> Weights:
    array: Weights = parameter.detach().numpy().copy()
    return array
