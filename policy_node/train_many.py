"""Trains many policies at once, in groups that share the work of the optimizer.

`train_many` gives the policies of `policy_node.train.train` in about half the time. Initial
weights, batches and noise are equal; sums are taken in another order, so that losses and weights
differ by rounding. Use `train` for one policy, `train_many` for the policies of a study.
"""

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
from policy_node.settings import DEFAULTS, TrainingSettings
from policy_node.train import (
    TrainedPolicy,
    check_loss,
    check_seed,
    linear_layers,
    new_network,
    one_thread,
    trained_policy,
)
from policy_node.training_data import CURVE_EVERY, TrainingData
from policy_node.variants import Variant

GROUP = 2
"""Policies per group. More of them share the work of the optimizer, but parameters and moments of
each take 1.2 MB, which crowds the cache of a core; benchmarks/training_speed.py measures both."""

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
        variant: what to observe and to command.
        seed: of the initial weights, the batches and the noise.
        selection: name and hash of the manifest, for the card.
    """

    key: str
    episodes: Sequence[tuple[Episode, Span | None]]
    variant: Variant
    seed: int
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
    settings: TrainingSettings = DEFAULTS,
    *,
    group: int = GROUP,
    progress: JobProgress | None = None,
) -> Iterator[TrainedPolicy | FailedTraining]:
    """Train the policies that `train` would, one group after the other.

    Equal input gives equal bits on one machine, whatever jobs share a group.

    Args:
        jobs: to train.
        settings: numbers of the training, for all jobs.
        group: largest number of policies in one computation; all of one variant.
        progress: called for each job with key, step and mean loss as `train` does.

    Returns:
        An iterator in the order of the jobs. A group is trained when the first of its results is
        asked for. A job with a seed out of range, unusable episodes or a loss that is not finite
        is a FailedTraining; the other jobs go on. `seconds` of a policy are its share of the time
        of its group.

    Raises:
        PolicyError: at once, if `group` is out of range or a key is given twice.
    """
    if group < 1:
        raise PolicyError(f"training: group is {group}, expected at least 1")
    for key, n in Counter(job.key for job in jobs).items():
        if n > 1:
            raise PolicyError(f"training: key {key!r} is given to {n} jobs, expected one")
    return _in_order(list(jobs), settings, group, progress)


def _in_order(
    jobs: Sequence[TrainingJob],
    settings: TrainingSettings,
    group: int,
    progress: JobProgress | None,
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
    jobs: Sequence[TrainingJob], settings: TrainingSettings, progress: JobProgress | None
) -> dict[str, TrainedPolicy | FailedTraining]:
    started_s = time.perf_counter()
    done: dict[str, TrainedPolicy | FailedTraining] = {}
    sets: dict[object, TrainingData] = {}
    learners: list[_Learner] = []
    for job in jobs:
        same = tuple(sorted((id(episode), span or ()) for episode, span in job.episodes))
        try:
            check_seed(job.seed)
            if same not in sets:
                sets[same] = TrainingData(job.episodes, job.variant, settings)
        except CurationError as err:
            done[job.key] = FailedTraining(job.key, str(err))
        else:
            learners.append(_Learner(job, sets[same], settings))
    # Robots may have other phases or fields of other widths, and so networks of other shapes.
    for widths in dict.fromkeys(learner.widths for learner in learners):
        alike = [learner for learner in learners if learner.widths == widths]
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
    """A policy in training.

    Attributes:
        job: its job.
        data: that it learns from.
        widths: of the layers of its network.
        network: with the initial weights, and at the end the trained ones.
        losses: of every batch so far, up to the first that is not finite.
    """

    def __init__(self, job: TrainingJob, data: TrainingData, settings: TrainingSettings) -> None:
        self.job, self.data = job, data
        self.widths = data.widths(settings.hidden)
        self.network = new_network(self.widths, job.seed)
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


def _fit(
    learners: Sequence[_Learner], settings: TrainingSettings, progress: JobProgress | None
) -> None:
    """Train the networks of all learners, whose widths are equal.

    In a step, the policies take turns through the network and back. The activations of one policy
    stay in the cache of a core; those of all policies, layer by layer as in `torch.bmm`, do not.
    A product of 256 x 256 matrices keeps a core busy by itself. There is no autograd, and one call
    of the optimizer updates all policies.
    """
    widths = learners[0].widths
    n = len(learners)
    parameters, gradients, *moments = (torch.zeros(n, _stack_size(widths)) for _ in range(4))
    layers = [_layers(*pair, widths) for pair in zip(parameters, gradients, strict=True)]
    for learner, own in zip(learners, layers, strict=True):
        for linear, layer in zip(linear_layers(learner.network), own, strict=True):
            layer.weight.copy_(linear.weight)
            layer.bias.copy_(linear.bias)
    buffers = _Buffers(widths, settings)
    rows = {id(learner.data): _rows(learner.data) for learner in learners}
    errors = torch.zeros(CURVE_EVERY, n, widths[-1], settings.batch_size).transpose(2, 3)
    step_count = torch.zeros(())
    draw = [learner.data.draws(settings, learner.job.seed) for learner in learners]
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
            _update(parameters, gradients, moments, step_count, settings)
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


def _update(
    parameters: torch.Tensor,
    gradients: torch.Tensor,
    moments: Sequence[torch.Tensor],
    step_count: torch.Tensor,
    settings: TrainingSettings,
) -> None:
    """One step of Adam for all policies."""
    first, second = moments
    # The function, not the class: that loads torch._dynamo, which takes seconds.
    adam(
        [parameters],
        [gradients],
        [first],
        [second],
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


class _Buffers:
    """Memory in which the policies take turns, so that it stays in the cache.

    Args:
        widths: of the layers.
        settings: of the training.
    """

    def __init__(self, widths: tuple[int, ...], settings: TrainingSettings) -> None:
        self._row = torch.empty(settings.batch_size, widths[0] + widths[-1])
        self._obs, self._targets = self._row[:, : widths[0]], self._row[:, widths[0] :]
        # Input of each layer, from the observations to the answer, and its gradient.
        self._values = [_buffer(settings.batch_size, width) for width in widths]
        self._gradients = [_buffer(settings.batch_size, width) for width in widths]
        for k in range(1, len(widths) - 2):
            if widths[k] == widths[k + 1]:
                # When one is written the other has been used: less memory in the cache.
                self._gradients[k] = self._values[k + 1]
        self._gradients_t = [gradient.t() for gradient in self._gradients]
        self._is_shifted = settings.start_jitter_m > 0.0
        if not self._is_shifted:
            self._values[0] = self._obs
        # Of the mean of all squared errors. Multiplying by a tensor is faster than by a number.
        self._scale = torch.tensor(2.0 / (settings.batch_size * widths[-1]))

    def gather(
        self, rows: torch.Tensor, pick: torch.Tensor, noise: torch.Tensor, jitter: torch.Tensor
    ) -> None:
        """Take the rows of a batch and shift the starts."""
        torch.index_select(rows, 0, pick, out=self._row)
        if self._is_shifted:
            torch.addmm(self._obs, noise, jitter, out=self._values[0])

    def backpropagate(self, layers: Sequence[_Layer], error: torch.Tensor) -> None:
        """Fill the gradients of the mean squared error, and the (B, A) errors themselves."""
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
                # Derivative of a ReLU: 1 where its output is positive, else 0.
                gradients[k].mul_(values[k].sign_())


def _buffer(n_rows: int, width: int) -> torch.Tensor:
    """(n_rows, width), with the longer side contiguous: see `_layers`."""
    if width < n_rows:
        return torch.empty(width, n_rows).t()
    return torch.empty(n_rows, width)


def _rows(data: TrainingData) -> torch.Tensor:
    """(N, D + A) observations and targets side by side: one gather takes both."""
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
    """To whole cache lines: the place of a row in the stack must not change a bit."""
    return -(-n // _LINE) * _LINE
