"""The episode loop: reset, observe, track the phase, get a command, execute it, until the end.

Nodes, collections and rollouts all run this one loop. It asks a pilot for each command. A pilot is
a generator, so it can wait for messages between two steps. Where nothing has to be waited for,
`run_episode` runs the loop to its end at once.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from sim_node.environment import Command, Environment
from sim_node.settings import EpisodeLimits
from sim_node.starts import Start
from sim_node.tasks.task import Controller, Step, Task

Returned = TypeVar("Returned")

Pilot = Callable[[Step], Generator[bool, None, Command | None]]
"""Answers a step with a command; None ends the episode. It yields while it waits, and it yields
True to be resumed at once."""


@dataclass(frozen=True)
class EpisodeResult:
    """How an episode went.

    Attributes:
        start: name of the start state.
        is_success: whether the goal held after any step.
        n_steps: commands executed.
        success_step: index of the command after which the goal held for the first time.
        stage: name of the last phase reached.
        phase_steps: steps in each phase.
        given_up: why the episode was ended before its time; empty if it was not.
    """

    start: str
    is_success: bool
    n_steps: int
    success_step: int | None
    stage: str
    phase_steps: tuple[int, ...]
    given_up: str = ""


class Run:
    """One episode, while it runs and afterwards; its state stays readable if it is cut short.

    Args:
        env: reset by this constructor, and stepped by `play`.
        task: what is to be done.
        start: where to start.
        limits: when to end.

    Attributes:
        n_steps: commands executed so far.
        success_step: index of the command after which the goal held for the first time.
        stage: name of the phase reached; empty before the first step.
        phase_steps: steps in each phase so far.

    Raises:
        SimError: if the start state is invalid or the simulation diverges while it settles.
    """

    def __init__(self, env: Environment, task: Task, start: Start, limits: EpisodeLimits) -> None:
        self._env = env
        self._phases = task.phases
        self._limits = limits
        self._first = env.reset(start.state)
        self._tracker = task.tracker(self._first)
        self.start = start
        self.n_steps = 0
        self.success_step: int | None = None
        self.stage = ""
        self.phase_steps = [0] * len(task.phases)

    def play(self, pilot: Pilot) -> Generator[bool, None, None]:
        """Run the loop; call once.

        Args:
            pilot: asked for the command of each step.

        Raises:
            SimError: if the simulation diverged.
        """
        env, tracker, limits = self._env, self._tracker, self._limits
        observation = self._first
        while self.n_steps < limits.max_steps:
            phase_index = tracker.update(observation)
            self.stage = self._phases[phase_index]
            step = Step(self.n_steps, observation, phase_index, self.stage, tracker.progress)
            command = yield from pilot(step)
            if command is None:
                return
            observation = env.step(*command)
            self.phase_steps[phase_index] += 1
            self.n_steps += 1
            if self.success_step is None and env.is_success():
                self.success_step = self.n_steps - 1
            if (
                self.success_step is not None
                and self.n_steps > self.success_step + limits.steps_after_success
            ):
                return

    def result(self, given_up: str = "") -> EpisodeResult:
        """How the episode went so far."""
        return EpisodeResult(
            start=self.start.name,
            is_success=self.success_step is not None,
            n_steps=self.n_steps,
            success_step=self.success_step,
            stage=self.stage,
            phase_steps=tuple(self.phase_steps),
            given_up=given_up,
        )


def run_episode(
    env: Environment,
    task: Task,
    start: Start,
    controller: Controller,
    limits: EpisodeLimits | None = None,
    *,
    on_step: Callable[[Step, Command], None] | None = None,
    give_up: Callable[[Step], str] | None = None,
) -> EpisodeResult:
    """Run one episode in this process, without waiting for anything.

    Args:
        env: reset by this function.
        task: what is to be done.
        start: where to start.
        controller: one that has not acted yet.
        limits: when to end; default: those of a demonstration.
        on_step: called before each command is executed.
        give_up: called before each command until the first success; a reason ends the episode
            instead of the command.

    Raises:
        SimError: if the simulation diverged.
    """
    run = Run(env, task, start, limits or EpisodeLimits())
    given_up = ""

    def pilot(step: Step) -> Generator[bool, None, Command | None]:
        nonlocal given_up
        command = Command(*controller.act(step))
        if give_up is not None and run.success_step is None and (given_up := give_up(step)):
            return None
        if on_step is not None:
            on_step(step, command)
        return command
        yield  # a pilot is a generator; this one never waits

    run_to_end(run.play(pilot))
    return run.result(given_up)


def run_to_end(script: Generator[bool, None, Returned]) -> Returned:
    """Run a script that has nothing to wait for, and return what it returns."""
    while True:
        try:
            next(script)
        except StopIteration as end:
            value: Returned = end.value
            return value
