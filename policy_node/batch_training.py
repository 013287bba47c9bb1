"""Many policies trained in one computation: the policies of `train`, in less time."""

from __future__ import annotations

import itertools
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch.optim.adam import adam

from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import CurationError, PolicyError
from curation_ros.core.types import Span
from policy_node.action import N_OUTPUTS
from policy_node.train import (
    CURVE_EVERY,
    Settings,
    TrainedPolicy,
    TrainingSet,
    check_loss,
    check_seed,
    draws,
    linear_layers,
    new_network,
    one_thread,
    trained_policy,
)

GROUP = 2
"""Policies in one computation. More share the work of the optimizer, but parameters and moments
of each are 1.2 MB, which crowd the cache of a core; benchmarks/training_speed.py has both."""

JobProgress = Callable[[str, int, float], None]

_LINE = 16
"""float32 values in a cache line."""


@dataclass(frozen=True)
class TrainingJob:
    """A policy to train.

    Attributes:
        key: chosen by the caller, unique.
        episodes: with their spans, as `train` takes them. Jobs of a group that are given the
            same episodes, as objects, and spans share one copy of their rows.
        seed: of the initial weights, the batches and the noise.
        variant: of the observations.
        selection: name and hash of the manifest, for the card.
    """

    key: str
    episodes: Sequence[tuple[Episode, Span | None]]
    seed: int
    variant: str = "relative"
    selection: tuple[str, str] = ("", "")


@dataclass(frozen=True)
class FailedTraining:
    """A job that gave no policy.

    Attributes:
        key: of the job.
        reason: what was found and what was expected.
    """

    key: str
    reason: str


def train_many(
    jobs: Sequence[TrainingJob],
    *,
    steps: int = 4000,
    batch_size: int = 256,
    lr: float = 1e-3,
    weight_decay: float = 1e-4,
    hidden: tuple[int, ...] = (256, 256),
    std_floor: float = 2e-3,
    start_jitter_m: float = 0.0,
    action_scale: float = 0.2,
    group: int = GROUP,
    progress: JobProgress | None = None,
) -> Iterator[TrainedPolicy | FailedTraining]:
    """Train the policies that `train` would, a group of them in one computation.

    Initial weights, batches and noise are those of `train`; sums are taken in another order, so
    that weights differ by rounding. Equal input gives equal bits on one machine, whatever jobs
    share the group.

    Args:
        jobs: to train.
        steps: see `train`, as all up to `action_scale`.
        batch_size: rows a step and policy.
        lr: learning rate.
        weight_decay: L2 penalty.
        hidden: widths of the hidden layers.
        std_floor: least standard deviation to divide by, m.
        start_jitter_m: standard deviation of the noise on where the objects were, m.
        action_scale: command that is an output of 1.
        group: largest number of policies in one computation; all of one variant.
        progress: called for each job with key, step and mean loss as `train` does.

    Returns:
        An iterator in the order of the jobs; each step of it that needs a group trains it. A job
        with a seed out of range, unusable episodes or a loss that is not finite is a
        FailedTraining; the others go on. `seconds` of a policy are its share of its group's.

    Raises:
        PolicyError: at once, if a setting is out of range or a key is given twice.
    """
    settings = Settings(
        steps, batch_size, lr, weight_decay, hidden, std_floor, start_jitter_m, action_scale
    )
    if group < 1:
        raise PolicyError(f"training: group is {group}, expected at least 1")
    for key, n in Counter(job.key for job in jobs).items():
        if n > 1:
            raise PolicyError(f"training: key {key!r} is given to {n} jobs, expected one")
    return _in_order(list(jobs), settings, group, progress)


def _in_order(
    jobs: Sequence[TrainingJob], settings: Settings, group: int, progress: JobProgress | None
) -> Iterator[TrainedPolicy | FailedTraining]:
    waiting = {job.key: job for job in jobs}
    done: dict[str, TrainedPolicy | FailedTraining] = {}
    for job in jobs:
        if job.key in waiting:
            alike = (other for other in waiting.values() if other.variant == job.variant)
            together = list(itertools.islice(alike, group))
            for taken in together:
                del waiting[taken.key]
            done.update(_train_group(together, settings, progress))
        yield done.pop(job.key)


def _train_group(
    jobs: Sequence[TrainingJob], settings: Settings, progress: JobProgress | None
) -> dict[str, TrainedPolicy | FailedTraining]:
    started_s = time.perf_counter()
    done: dict[str, TrainedPolicy | FailedTraining] = {}
    sets: dict[object, TrainingSet] = {}
    learners: list[_Learner] = []
    for job in jobs:
        same = tuple(sorted((id(episode), span or ()) for episode, span in job.episodes))
        try:
            check_seed(job.seed)
            if same not in sets:
                sets[same] = TrainingSet(job.episodes, job.variant, settings)
        except CurationError as err:
            done[job.key] = FailedTraining(job.key, str(err))
        else:
            learners.append(_Learner(job, sets[same], settings))
    # Robots may name other phases, and observations of these have other columns.
    for width in dict.fromkeys(learner.data.spec.width for learner in learners):
        alike = [learner for learner in learners if learner.data.spec.width == width]
        with one_thread(), torch.no_grad():
            _fit(alike, settings, progress)
    seconds = (time.perf_counter() - started_s) / len(jobs)
    for learner in learners:
        job = learner.job
        try:
            check_loss(learner.losses[-1], len(learner.losses) - 1)
            done[job.key] = trained_policy(
                learner.network,
                learner.losses,
                learner.data,
                settings,
                job.seed,
                job.selection,
                seconds,
            )
        except PolicyError as err:
            done[job.key] = FailedTraining(job.key, str(err))
    return done


class _Learner:
    """A policy in the making.

    Attributes:
        job: that asks for it.
        data: that it learns from.
        network: with the initial weights, and at the end the trained ones.
        losses: of every batch so far, up to the first that is not finite.
    """

    def __init__(self, job: TrainingJob, data: TrainingSet, settings: Settings) -> None:
        self.job, self.data = job, data
        self.network = new_network(data.widths(settings.hidden), job.seed)
        self.losses: list[float] = []

    @property
    def has_failed(self) -> bool:
        return bool(self.losses) and not math.isfinite(self.losses[-1])

    def add(self, losses: Sequence[float]) -> None:
        """Note the losses of more batches."""
        for loss in losses:
            self.losses.append(loss)
            if self.has_failed:
                break


class _Layer(NamedTuple):
    """Views of one policy's part of the stacked parameters and of their gradients."""

    weight: torch.Tensor
    weight_t: torch.Tensor
    bias: torch.Tensor
    weight_gradient: torch.Tensor
    bias_gradient: torch.Tensor


def _fit(learners: Sequence[_Learner], settings: Settings, progress: JobProgress | None) -> None:
    """Train the networks of all learners, whose widths are the same.

    A step takes one policy after the other through the network and back: its activations stay in
    the cache of the core, which those of all policies, layer by layer as `torch.bmm` has it, do
    not; and a product of 256 x 256 matrices keeps a core busy without more of them. What is left,
    from autograd to an optimizer of many small operations, is done without, or once for all.
    """
    widths = learners[0].data.widths(settings.hidden)
    n = len(learners)
    parameters, gradients, first_moments, second_moments = (
        torch.zeros(n, _stack_size(widths)) for _ in range(4)
    )
    layers = [_layers(*pair, widths) for pair in zip(parameters, gradients, strict=True)]
    for learner, own in zip(learners, layers, strict=True):
        for linear, layer in zip(linear_layers(learner.network), own, strict=True):
            layer.weight.copy_(linear.weight)
            layer.bias.copy_(linear.bias)
    buffers = _Buffers(widths, settings)
    rows = {id(learner.data): _rows(learner.data) for learner in learners}
    errors = torch.zeros(CURVE_EVERY, n, N_OUTPUTS, settings.batch_size).transpose(2, 3)
    step_count = torch.zeros(())
    draw = [draws(learner.data, settings, learner.job.seed) for learner in learners]
    for blocks in zip(*draw, strict=True):
        learning = [k for k, learner in enumerate(learners) if not learner.has_failed]
        if not learning:
            break
        n_steps = len(blocks[0][0])
        batches = [list(zip(picks, noise, strict=True)) for picks, noise in blocks]
        for step in range(n_steps):
            for k in learning:
                data = learners[k].data
                buffers.gather(rows[id(data)], *batches[k][step], data.jitter)
                buffers.backpropagate(layers[k], errors[step, k])
            # The function, not the class: that loads torch._dynamo, which takes seconds.
            adam(
                [parameters],
                [gradients],
                [first_moments],
                [second_moments],
                [],
                [step_count],
                fused=True,
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=settings.lr,
                weight_decay=settings.weight_decay,
                eps=1e-8,
                maximize=False,
            )
        losses = errors[:n_steps].square().mean((2, 3)).T.tolist()
        for k in learning:
            learner = learners[k]
            learner.add(losses[k])
            if progress is not None and not learner.has_failed:
                progress(learner.job.key, len(learner.losses), sum(losses[k]) / n_steps)
    for learner, own in zip(learners, layers, strict=True):
        for linear, layer in zip(linear_layers(learner.network), own, strict=True):
            linear.weight.copy_(layer.weight)
            linear.bias.copy_(layer.bias)


class _Buffers:
    """Where one policy after the other computes: the same memory, so that it stays in the cache.

    Args:
        widths: of the layers.
        settings: of the training.
    """

    def __init__(self, widths: tuple[int, ...], settings: Settings) -> None:
        self._row = torch.empty(settings.batch_size, widths[0] + N_OUTPUTS)
        self._obs, self._targets = self._row[:, : widths[0]], self._row[:, widths[0] :]
        # Of each layer what goes in, from the observations to the answer, and its gradient.
        self._values = [_buffer(settings.batch_size, width) for width in widths]
        self._gradients = [_buffer(settings.batch_size, width) for width in widths]
        for k in range(1, len(widths) - 2):
            if widths[k] == widths[k + 1]:
                # When the one is written the other has been used: less memory to keep near.
                self._gradients[k] = self._values[k + 1]
        self._gradients_t = [gradient.t() for gradient in self._gradients]
        self._is_shifted = settings.start_jitter_m > 0.0
        if not self._is_shifted:
            self._values[0] = self._obs
        # Of the mean of all squared errors; multiplying by a tensor is quicker than by a number.
        self._scale = torch.tensor(2.0 / (settings.batch_size * N_OUTPUTS))

    def gather(
        self, rows: torch.Tensor, pick: torch.Tensor, noise: torch.Tensor, jitter: torch.Tensor
    ) -> None:
        """Take the rows of a batch and shift the starts."""
        torch.index_select(rows, 0, pick, out=self._row)
        if self._is_shifted:
            torch.addmm(self._obs, noise, jitter, out=self._values[0])

    def backpropagate(self, layers: Sequence[_Layer], error: torch.Tensor) -> None:
        """Fill the gradients of the mean squared error, and the (B, 4) errors themselves."""
        values, gradients = self._values, self._gradients
        last = len(layers) - 1
        for k, layer in enumerate(layers):
            torch.addmm(layer.bias, values[k], layer.weight_t, out=values[k + 1])
            values[k + 1].tanh_() if k == last else values[k + 1].relu_()
        answer, gradient = values[-1], gradients[-1]
        torch.sub(answer, self._targets, out=error)
        torch.mul(error, answer, out=gradient)
        torch.addcmul(error, gradient, answer, value=-1.0, out=gradient)
        gradient.mul_(self._scale)
        for k in range(last, -1, -1):
            layer, gradient = layers[k], gradients[k + 1]
            torch.mm(self._gradients_t[k + 1], values[k], out=layer.weight_gradient)
            torch.sum(gradient, 0, out=layer.bias_gradient)
            if k:
                torch.mm(gradient, layer.weight, out=gradients[k])
                # After a ReLU: 1 where it let through, 0 where it did not.
                gradients[k].mul_(values[k].sign_())


def _buffer(n_rows: int, width: int) -> torch.Tensor:
    """(n_rows, width), with the longer side contiguous: see `_layers`."""
    if width < n_rows:
        return torch.empty(width, n_rows).t()
    return torch.empty(n_rows, width)


def _rows(data: TrainingSet) -> torch.Tensor:
    """(N, D + 4) observations and targets side by side: one gather takes both."""
    return torch.cat([data.obs, data.targets], dim=1)


def _layers(
    parameters: torch.Tensor, gradients: torch.Tensor, widths: tuple[int, ...]
) -> list[_Layer]:
    layers = []
    first = 0
    for n_in, n_out in itertools.pairwise(widths):
        middle = first + _padded(n_in * n_out)
        weight, weight_gradient = (
            # The longer side is contiguous: products with a short one take half as long.
            flat[first : first + n_in * n_out].view(n_in, n_out).t()
            if n_in < n_out
            else flat[first : first + n_in * n_out].view(n_out, n_in)
            for flat in (parameters, gradients)
        )
        bias, bias_gradient = (flat[middle : middle + n_out] for flat in (parameters, gradients))
        layers.append(_Layer(weight, weight.t(), bias, weight_gradient, bias_gradient))
        first = middle + _padded(n_out)
    return layers


def _stack_size(widths: tuple[int, ...]) -> int:
    return sum(
        _padded(n_in * n_out) + _padded(n_out) for n_in, n_out in itertools.pairwise(widths)
    )


def _padded(n: int) -> int:
    """To whole cache lines: where a row of the stack begins must not change a bit."""
    return -(-n // _LINE) * _LINE
