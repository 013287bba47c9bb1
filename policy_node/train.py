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
from curation_ros.core.episode.phases import PHASES
from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats, Span
from curation_ros.version import __version__
from policy_node.action import N_OUTPUTS, ActionSpec
from policy_node.observation import ObservationSpec
from policy_node.policy import Card, Policy, Weights, standardise

CURVE_EVERY = 100
"""Steps between two entries of the training curve."""

Progress = Callable[[int, float], None]


@dataclass(frozen=True)
class TrainedPolicy:
    """A policy and how it came to be.

    Attributes:
        policy: acts without torch; `policy.save` keeps it.
        network: the same in torch, on standardised observations.
        loss: mean loss of the last batches of the curve.
        curve: (step, mean loss of the batches since the entry before).
        losses: of every batch, one a step.
        seconds: that the training took.
    """

    policy: Policy
    network: torch.nn.Sequential
    loss: float
    curve: tuple[tuple[int, float], ...]
    losses: tuple[float, ...]
    seconds: float


@dataclass(frozen=True)
class Settings:
    """How to train, whatever the demonstrations and the seed; `train` says what each means.

    Raises:
        PolicyError: if one is out of range.
    """

    steps: int
    batch_size: int
    lr: float
    weight_decay: float
    hidden: tuple[int, ...]
    std_floor: float
    start_jitter_m: float
    action_scale: float

    def __post_init__(self) -> None:
        for name, value in (
            ("steps", self.steps),
            ("batch_size", self.batch_size),
            ("hidden", min(self.hidden, default=0)),
        ):
            if value < 1:
                raise PolicyError(f"training: {name} is {value}, expected at least 1")
        for name, number in (("lr", self.lr), ("std_floor", self.std_floor)):
            if not number > 0.0:
                raise PolicyError(f"training: {name} is {number}, expected more than 0")
        at_least_zero = {"weight_decay": self.weight_decay, "start_jitter_m": self.start_jitter_m}
        for name, number in at_least_zero.items():
            if not number >= 0:
                raise PolicyError(f"training: {name} is {number}, expected 0 or more")
        ActionSpec(self.action_scale)


class TrainingSet:
    """What a network learns from: the rows of all spans, standardised.

    Args:
        episodes: as `train` takes them.
        variant: of the observations.
        settings: of the training.

    Attributes:
        episodes: with their spans, by id and span.
        n_steps: rows of each.
        spec: of the observations, D columns.
        mean, std: (D,) that the observations were standardised by.
        obs: (N, D) float32, standardised.
        targets: (N, 4) float32.
        jitter: (S, D) float32, what noise of S values with standard deviation 1 adds to obs.
        clipped_fraction: of the values of the twist.

    Raises:
        PolicyError: if there is no episode, one is given twice or cannot be used, or their topic
            maps differ.
    """

    def __init__(
        self, episodes: Iterable[tuple[Episode, Span | None]], variant: str, settings: Settings
    ) -> None:
        self.episodes = _sorted(episodes)
        # Without phases the check says what is missing, and where.
        self.spec = ObservationSpec(variant, self.episodes[0][0].phase_labels or PHASES)
        action = ActionSpec(settings.action_scale)
        parts = [self.spec.from_episode(episode, span) for episode, span in self.episodes]
        self.n_steps = [len(part) for part in parts]
        obs = np.concatenate(parts)
        targets = np.concatenate([action.targets(*pair) for pair in self.episodes])
        n_clipped = sum(
            action.clipped_fraction(*pair) * n
            for pair, n in zip(self.episodes, self.n_steps, strict=True)
        )
        self.clipped_fraction = n_clipped / len(obs)
        self.mean, self.std = normalisation(obs, self.spec, settings.std_floor)
        self.obs = torch.from_numpy(standardise(obs, self.mean, self.std))
        self.targets = torch.from_numpy(targets.astype(np.float32))
        # Of standardised columns, by noise of standard deviation 1.
        jitter = settings.start_jitter_m * self.spec.start_effect / self.std
        self.jitter = torch.from_numpy(jitter.astype(np.float32))

    def __len__(self) -> int:
        return len(self.obs)

    def widths(self, hidden: tuple[int, ...]) -> tuple[int, ...]:
        """Of the layers of a network, from the observation to the output."""
        return (self.spec.width, *hidden, N_OUTPUTS)


def train(
    episodes: Iterable[tuple[Episode, Span | None]],
    *,
    seed: int,
    steps: int = 4000,
    batch_size: int = 256,
    lr: float = 1e-3,
    weight_decay: float = 1e-4,
    hidden: tuple[int, ...] = (256, 256),
    std_floor: float = 2e-3,
    start_jitter_m: float = 0.0,
    variant: str = "relative",
    action_scale: float = 0.2,
    selection: tuple[str, str] = ("", ""),
    progress: Progress | None = None,
) -> TrainedPolicy:
    """Train a policy by behaviour cloning; equal input gives equal bits on one machine.

    Steps are fixed, not epochs: a larger selection is not trained for longer. Batches are drawn
    with replacement from all steps of all spans; what is drawn depends on the seed and on the
    episodes' ids, spans and lengths, never on the order in which they are given.

    Args:
        episodes: whole episodes, each with the span to learn from (nanoseconds from the start
            stamp, inclusive) or None for all of it. The values at the start are always those of
            the whole episode.
        seed: of the initial weights, the batches and the noise.
        steps: gradient steps of Adam.
        batch_size: rows a step.
        lr: learning rate.
        weight_decay: L2 penalty, as `torch.optim.Adam` has it.
        hidden: widths of the hidden layers, ReLU; the output is a tanh.
        std_floor: least standard deviation to divide by, m: a table's height hardly varies, and
            must not be blown up.
        start_jitter_m: standard deviation of the noise, drawn anew for each row of a batch, on
            where the objects were at the start, m; 0: none. The exact start is a fingerprint of
            its episode: without noise the network learns by heart how fast and how slanted each
            episode went, and strays from its path on starts that it has not seen.
        variant: key of `policy_node.observation.VARIANTS`.
        action_scale: command that is an output of 1; see `ActionSpec`.
        selection: name and hash of the manifest, for the card.
        progress: called with step and mean loss every CURVE_EVERY steps and after the last.

    Raises:
        PolicyError: if a setting is out of range, there is no episode, one is given twice or
            cannot be used, their topic maps differ, or the loss is not finite (naming the step).
    """
    started_s = time.perf_counter()
    check_seed(seed)
    settings = Settings(
        steps, batch_size, lr, weight_decay, hidden, std_floor, start_jitter_m, action_scale
    )
    data = TrainingSet(episodes, variant, settings)
    with one_thread():
        network = new_network(data.widths(hidden), seed)
        losses = _fit(network, data, settings, seed, progress)
    return trained_policy(
        network, losses, data, settings, seed, selection, time.perf_counter() - started_s
    )


def trained_policy(
    network: torch.nn.Sequential,
    losses: Sequence[float],
    data: TrainingSet,
    settings: Settings,
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
        seconds: that it took.

    Raises:
        PolicyError: if a weight is not finite.
    """
    curve = tuple(
        (first + len(block), sum(block) / len(block))
        for first in range(0, len(losses), CURVE_EVERY)
        for block in [losses[first : first + CURVE_EVERY]]
    )
    topic_map = data.episodes[0][0].topic_map
    card = Card(
        id=new_episode_id(),
        created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        variant=data.spec.variant,
        columns=data.spec.columns,
        phase_labels=data.spec.phase_labels,
        action_scale=settings.action_scale,
        widths=data.widths(settings.hidden),
        topic_map_hash=topic_map.hash,
        selection_name=selection[0],
        selection_hash=selection[1],
        episodes=tuple(
            {"id": episode.id, "span": span and list(span), "n_steps": n}
            for (episode, span), n in zip(data.episodes, data.n_steps, strict=True)
        ),
        seed=seed,
        steps=settings.steps,
        batch_size=settings.batch_size,
        lr=settings.lr,
        weight_decay=settings.weight_decay,
        std_floor=settings.std_floor,
        start_jitter_m=settings.start_jitter_m,
        clipped_fraction=data.clipped_fraction,
        curve=curve,
        seconds=seconds,
        versions={
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": torch.__version__,
            "curation_ros": __version__,
        },
    )
    weights = [(_array(layer.weight), _array(layer.bias)) for layer in linear_layers(network)]
    policy = Policy(card, weights, data.mean, data.std, f"policy {card.id}")
    return TrainedPolicy(policy, network, curve[-1][1], curve, tuple(losses), seconds)


def normalisation(obs: Floats, spec: ObservationSpec, std_floor: float) -> tuple[Floats, Floats]:
    """Mean and standard deviation to standardise by.

    Args:
        obs: (N, D).
        spec: of the observations.
        std_floor: least standard deviation.

    Returns:
        (D,) mean and (D,) standard deviation; 0 and 1 in the one-hot.
    """
    mean = np.where(spec.is_one_hot, 0.0, obs.mean(axis=0))
    std = np.where(spec.is_one_hot, 1.0, np.maximum(obs.std(axis=0), std_floor))
    return mean, std


def check_seed(seed: int) -> None:
    """Refuse a seed that torch's generators do not take.

    Raises:
        PolicyError: if it is negative or has more than 63 bits.
    """
    if not 0 <= seed < 2**63:
        raise PolicyError(f"training: seed is {seed}, expected 0 or more and less than 2**63")


def check_loss(loss: float, step: int) -> None:
    """Refuse a loss that no training comes back from.

    Raises:
        PolicyError: if it is not finite.
    """
    if not math.isfinite(loss):
        raise PolicyError(f"training: the loss is {loss} in step {step}, expected a finite number")


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


def draws(
    data: TrainingSet, settings: Settings, seed: int
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """What each step learns from, CURVE_EVERY steps at a time.

    Args:
        data: with N rows, and a jitter of S values.
        settings: with steps and batch size B.
        seed: of the draws.

    Yields:
        For n steps, (n, B) row indices and (n, B, S) float32 noise of standard deviation 1.
    """
    draw = torch.Generator().manual_seed(seed)
    for first in range(0, settings.steps, CURVE_EVERY):
        shape = (min(CURVE_EVERY, settings.steps - first), settings.batch_size)
        picks = torch.randint(len(data), shape, generator=draw)
        yield picks, torch.randn(*shape, len(data.jitter), generator=draw)


def _fit(
    network: torch.nn.Sequential,
    data: TrainingSet,
    settings: Settings,
    seed: int,
    progress: Progress | None,
) -> list[float]:
    """Train in place; returns the loss of every batch."""
    optimizer = torch.optim.Adam(
        network.parameters(), lr=settings.lr, weight_decay=settings.weight_decay
    )
    losses: list[float] = []
    for picks, noise in draws(data, settings, seed):
        first = len(losses)
        for pick, shift in zip(picks, noise, strict=True):
            seen = torch.addmm(data.obs[pick], shift, data.jitter)
            loss = torch.nn.functional.mse_loss(network(seen), data.targets[pick])
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
