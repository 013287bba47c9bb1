"""No defect: a clean demonstration."""

from __future__ import annotations

from typing import Any

from curation_ros.core.types import Floats
from sim_node.defects.defect import Defect
from sim_node.tasks.task import Controller, Step, Task


class NoDefect:
    """The controller as it is.

    Args:
        controller: drives the robot.
        task: not needed here.
        seed: nothing varies.
    """

    def __init__(self, controller: Controller, task: Task, seed: int) -> None:
        del task, seed
        self._controller = controller

    def act(self, step: Step) -> tuple[Floats, float]:
        """The command of the controller."""
        return self._controller.act(step)

    def truth(self) -> dict[str, Any]:
        """Nothing was injected."""
        return {"defect": "none"}


DEFECT = Defect("none", "a clean demonstration", NoDefect)
