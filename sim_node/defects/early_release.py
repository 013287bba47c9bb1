"""Early release: the gripper opens during the lift, and the motion goes on empty."""

from __future__ import annotations

from typing import Any

import numpy as np

from curation_ros.core.types import Floats
from sim_node.defects.defect import Defect
from sim_node.environment import GRIPPER_OPEN
from sim_node.tasks.task import Controller, Step, Task


class EarlyRelease:
    """Opens the gripper in the middle of the first phase that carries the object, for good.

    Args:
        controller: moves the arm, and the gripper until the release.
        task: names the phase.
        seed: seed of the progress at which the gripper opens.
    """

    FRACTION_RANGE = (0.3, 0.7)
    """Progress of the phase at the release; in LIFT it is the fraction of the height."""

    def __init__(self, controller: Controller, task: Task, seed: int) -> None:
        self._controller = controller
        self._phase_index = task.phases.index(task.carry_phases[0])
        self._fraction = float(np.random.default_rng(seed).uniform(*self.FRACTION_RANGE))
        self._release_step: int | None = None

    def act(self, step: Step) -> tuple[Floats, float]:
        """The controller's motion, with the gripper open from the release on."""
        action, gripper = self._controller.act(step)
        if self._release_step is None and (
            step.phase_index > self._phase_index
            or (step.phase_index == self._phase_index and step.phase_progress >= self._fraction)
        ):
            self._release_step = step.index
        return action, gripper if self._release_step is None else GRIPPER_OPEN

    def truth(self) -> dict[str, Any]:
        """The progress at which the gripper opens, and the step of the release, if any."""
        return {
            "defect": "early_release",
            "release_fraction": self._fraction,
            "release_step": self._release_step,
        }


DEFECT = Defect("early_release", "the gripper opens at 30 to 70 % of the lift", EarlyRelease)
