"""Behaviour cloning: a small network learns to answer observations as demonstrations did."""

from __future__ import annotations

import itertools
import math
import platform
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
import torch

import curation_ros
from curation_ros.core.episode import Episode
from curation_ros.core.errors import PolicyError
from curation_ros.core.identity import new_episode_id
from curation_ros.core.phases import PHASES
from curation_ros.core.stream import Floats
from policy_node.action import N_OUTPUTS, ActionSpec
from policy_node.observation import ObservationSpec, Span
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
        seconds: that the training took.
    """

    policy: Policy
    network: torch.nn.Sequential
    loss: float
    curve: tuple[tuple[int, float], ...]
    seconds: float


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
    _check_settings(seed, steps, batch_size, lr, weight_decay, hidden, std_floor, start_jitter_m)
    chosen = _sorted(episodes)
    # Without phases the check says what is missing, and where.
    spec = ObservationSpec(variant, chosen[0][0].phase_labels or PHASES)
    action = ActionSpec(action_scale)
    parts = [spec.from_episode(episode, span) for episode, span in chosen]
    obs = np.concatenate(parts)
    targets = np.concatenate([action.targets(episode, span) for episode, span in chosen])
    n_clipped = sum(
        action.clipped_fraction(episode, span) * len(part)
        for (episode, span), part in zip(chosen, parts, strict=True)
    )
    mean, std = normalisation(obs, spec, std_floor)

    with _one_thread():
        network = _network((spec.width, *hidden, N_OUTPUTS), seed)
        curve = _fit(
            network,
            torch.from_numpy(standardise(obs, mean, std)),
            torch.from_numpy(targets.astype(np.float32)),
            # Of standardised columns, by noise of standard deviation 1.
            torch.from_numpy((start_jitter_m * spec.start_effect / std).astype(np.float32)),
            seed=seed,
            steps=steps,
            batch_size=batch_size,
            lr=lr,
            weight_decay=weight_decay,
            progress=progress,
        )
    seconds = time.perf_counter() - started_s
    card = Card(
        id=new_episode_id(),
        created_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        variant=spec.variant,
        columns=spec.columns,
        phase_labels=spec.phase_labels,
        action_scale=action.scale,
        widths=(spec.width, *hidden, N_OUTPUTS),
        topic_map_hash=chosen[0][0].topic_map.hash,
        selection_name=selection[0],
        selection_hash=selection[1],
        episodes=tuple(
            {"id": episode.id, "span": span and list(span), "n_steps": len(part)}
            for (episode, span), part in zip(chosen, parts, strict=True)
        ),
        seed=seed,
        steps=steps,
        batch_size=batch_size,
        lr=lr,
        weight_decay=weight_decay,
        std_floor=std_floor,
        start_jitter_m=start_jitter_m,
        clipped_fraction=n_clipped / len(obs),
        curve=curve,
        seconds=seconds,
        versions={
            "python": platform.python_version(),
            "numpy": np.__version__,
            "torch": torch.__version__,
            "curation_ros": curation_ros.__version__,
        },
    )
    layers = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    weights = [(_array(layer.weight), _array(layer.bias)) for layer in layers]
    return TrainedPolicy(
        Policy(card, weights, mean, std, f"policy {card.id}"),
        network,
        curve[-1][1],
        curve,
        seconds,
    )


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


def _check_settings(
    seed: int,
    steps: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    hidden: tuple[int, ...],
    std_floor: float,
    start_jitter_m: float,
) -> None:
    for name, value in (
        ("steps", steps),
        ("batch_size", batch_size),
        ("hidden", min(hidden, default=0)),
    ):
        if value < 1:
            raise PolicyError(f"training: {name} is {value}, expected at least 1")
    for name, number in (("lr", lr), ("std_floor", std_floor)):
        if not number > 0.0:
            raise PolicyError(f"training: {name} is {number}, expected more than 0")
    at_least_zero = {"seed": seed, "weight_decay": weight_decay, "start_jitter_m": start_jitter_m}
    for name, number in at_least_zero.items():
        if not number >= 0:
            raise PolicyError(f"training: {name} is {number}, expected 0 or more")


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
def _one_thread() -> Iterator[None]:
    """The order of sums, and so the bits, depends on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _network(widths: tuple[int, ...], seed: int) -> torch.nn.Sequential:
    # torch's layers draw from the global generator, which is the caller's: it is put back.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        modules: list[torch.nn.Module] = []
        for n_in, n_out in itertools.pairwise(widths):
            modules += [torch.nn.Linear(n_in, n_out), torch.nn.ReLU()]
    modules[-1] = torch.nn.Tanh()
    return torch.nn.Sequential(*modules)


def _fit(
    network: torch.nn.Sequential,
    obs: torch.Tensor,
    targets: torch.Tensor,
    jitter: torch.Tensor,
    *,
    seed: int,
    steps: int,
    batch_size: int,
    lr: float,
    weight_decay: float,
    progress: Progress | None,
) -> tuple[tuple[int, float], ...]:
    """Train in place.

    Args:
        network: to train.
        obs: (N, D) float32, standardised.
        targets: (N, 4) float32.
        jitter: (S, D) float32, what noise of S values with standard deviation 1 adds to obs.
        seed: of the batches and the noise.
        steps: gradient steps.
        batch_size: rows a step.
        lr: learning rate.
        weight_decay: L2 penalty.
        progress: as in `train`.

    Returns:
        The training curve.
    """
    draw = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.Adam(network.parameters(), lr=lr, weight_decay=weight_decay)
    curve: list[tuple[int, float]] = []
    for first in range(0, steps, CURVE_EVERY):
        n = min(CURVE_EVERY, steps - first)
        picks = torch.randint(len(obs), (n, batch_size), generator=draw)
        noise = torch.randn(n, batch_size, len(jitter), generator=draw)
        total = 0.0
        for k in range(n):
            pick = picks[k]
            seen = torch.addmm(obs[pick], noise[k], jitter)
            loss = torch.nn.functional.mse_loss(network(seen), targets[pick])
            value = loss.item()
            if not math.isfinite(value):
                raise PolicyError(
                    f"training: the loss is {value} in step {first + k}, expected a finite number"
                )
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            total += value
        curve.append((first + n, total / n))
        if progress is not None:
            progress(*curve[-1])
    return tuple(curve)


def _array(parameter: torch.Tensor) -> Weights:
    array: Weights = parameter.detach().numpy().copy()
    return array
