"""What a task is made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from curation_ros.core.types import Floats
from sim_node.environment import Observation


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
