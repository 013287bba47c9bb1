"""Structural defects: demonstrations that are wrong in a way that every step of them shows.

What was injected is truth for evaluation only; it must never reach builder or scorers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from curation_ros.core.types import Floats
from sim_node import phases
from sim_node.env import BOWL
from sim_node.environment import GRIPPER_OPEN
from sim_node.tasks.task import Controller, Step


class DefectiveController(Controller, Protocol):
    """A controller that knows what was injected into it."""

    def truth(self) -> dict[str, Any]:
        """What was injected so far, for the truth log only; values are JSON."""


@dataclass(frozen=True)
class Defect:
    """A kind of defect.

    Attributes:
        name: its key in `DEFECTS`.
        description: one line for people.
        inject: makes a defective controller of a sound one; all that varies comes from the seed.
    """

    name: str
    description: str
    inject: Callable[[Controller, int], DefectiveController]


class NoDefect:
    """The controller as it is."""

    def __init__(self, controller: Controller, seed: int) -> None:
        del seed  # nothing varies
        self._controller = controller

    def act(self, step: Step) -> tuple[Floats, float]:
        """The command of the controller."""
        return self._controller.act(step)

    def truth(self) -> dict[str, Any]:
        """That nothing was injected."""
        return {"defect": "none"}


class EarlyRelease:
    """Opens the gripper in the middle of LIFT, for good, and goes through the motions empty.

    Args:
        controller: moves the arm, and the gripper until the release.
        seed: of the height at which the gripper opens.
    """

    FRACTION_RANGE = (0.3, 0.7)
    """Of the height that LIFT covers."""

    def __init__(self, controller: Controller, seed: int) -> None:
        self._controller = controller
        self._fraction = float(np.random.default_rng(seed).uniform(*self.FRACTION_RANGE))
        self._bowl_start_m: Floats | None = None
        self._lift_start_m: float | None = None
        self._release_step: int | None = None
        self._n_steps = 0

    def act(self, step: Step) -> tuple[Floats, float]:
        """The controller's motion, with the gripper opened from the release on."""
        action, gripper = self._controller.act(step)
        observation = step.observation
        if self._bowl_start_m is None:
            self._bowl_start_m = observation.objects[BOWL][0].copy()
        if self._release_step is None and step.phase_index >= phases.LIFT:
            height_m = float(observation.eef_position_m[2])
            if self._lift_start_m is None:
                self._lift_start_m = height_m
            end_m = phases.lift_end_height_m(self._bowl_start_m)
            release_m = self._lift_start_m + self._fraction * (end_m - self._lift_start_m)
            if height_m >= release_m:
                self._release_step = self._n_steps
        self._n_steps += 1
        return action, gripper if self._release_step is None else GRIPPER_OPEN

    def truth(self) -> dict[str, Any]:
        """At which fraction of the lift the gripper opens, and in which step it did, if any."""
        return {
            "defect": "early_release",
            "release_fraction": self._fraction,
            "release_step": self._release_step,
        }


DEFECTS: dict[str, Defect] = {
    "none": Defect("none", "a clean demonstration", NoDefect),
    "early_release": Defect(
        "early_release", "the gripper opens at 30 to 70 % of the lift", EarlyRelease
    ),
}
"""Every defect that can be asked for."""
