"""What a task is: names, start states, phases, and an expert that solves it.

A new task is one file with a class, or an object, that has the members of `Task`, and one line in
`sim_node.tasks.TASKS`. `sim_node.testing.check_task` runs it through the rules.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from curation_ros.core.types import Floats
from sim_node.environment import Environment, Observation
from sim_node.starts import Start


@dataclass(frozen=True)
class Step:
    """What is known when a command is asked for.

    Attributes:
        index: from 0.
        observation: before the command.
        phase_index: index of the phase in the task's phases.
        phase_name: its name.
        phase_progress: how much of the phase is done, in [0, 1].
    """

    index: int
    observation: Observation
    phase_index: int
    phase_name: str
    phase_progress: float


class Controller(Protocol):
    """Drives the robot through one episode; asked once per step, in order."""

    def act(self, step: Step) -> tuple[Floats, float]:
        """The command that answers a step.

        Returns:
            (3,) action in [-1, 1] and gripper command in {-1, 0, +1}, see
            `sim_node.environment.Command`.
        """


class PhaseTracker(Protocol):
    """Follows the phases of one episode, which only advance.

    It reads what a robot can measure, and where the objects were at the start. It never reads the
    objects of later observations, contacts or success: a controller that has lost the object
    passes through the same phases as one that has not.
    """

    @property
    def index(self) -> int:
        """Index of the present phase in the task's phases."""

    @property
    def progress(self) -> float:
        """How much of the present phase is done, in [0, 1]; never falls within a phase."""

    def update(self, observation: Observation) -> int:
        """Take the next observation; called exactly once per step.

        Returns:
            Index of the phase that the command answering this observation belongs to.
        """


class Task(Protocol):
    """A task in a simulated scene: an object is to be moved to a goal."""

    @property
    def name(self) -> str:
        """Key in `TASKS`."""

    @property
    def benchmark_id(self) -> str:
        """What the benchmark calls it, for truth.jsonl: `libero_spatial/0`."""

    @property
    def phases(self) -> tuple[str, ...]:
        """Names of the phases, in their order; the topic map's labels are the same."""

    @property
    def carry_phases(self) -> tuple[str, ...]:
        """Phases in which the object is to move with the effector, in their order."""

    @property
    def moved_object(self) -> str:
        """Name of the object that is moved, one of the environment's."""

    @property
    def goal_object(self) -> str:
        """Name of the object to which it is moved, one of the environment's."""

    @property
    def n_official_starts(self) -> int:
        """Number of start states that the benchmark provides for final measurements."""

    def environment(self, *, lean: bool = True) -> Environment:
        """A new environment of this task.

        Args:
            lean: the fast way of stepping; False: the benchmark's own, where it has one.

        Raises:
            SimError: if the simulator cannot be loaded.
        """

    def start(self, name: str) -> Start:
        """The start state of a name, the same bits in every process; see `sim_node.starts`.

        Raises:
            ConfigError: if there is no such start.
            SimError: if it cannot be made.
        """

    def tracker(self, first: Observation) -> PhaseTracker:
        """A tracker for the episode that begins with an observation."""

    def expert(self, seed: int) -> Controller:
        """A controller that solves the task once; all that varies comes from the seed."""
