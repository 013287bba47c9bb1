"""What a defect is: a demonstration that is wrong in a known way.

What was injected is truth for evaluation only; it must never reach builder or scorers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from sim_node.tasks.task import Controller, Task


class DefectiveController(Controller, Protocol):
    """A controller that knows what was injected into it."""

    def truth(self) -> dict[str, Any]:
        """What was injected so far, for the truth log only: JSON, with the key `defect`."""


@dataclass(frozen=True)
class Defect:
    """A kind of defect.

    Attributes:
        name: its key in `DEFECTS`.
        description: one line for people.
        inject: makes a defective controller of a sound one, for one episode of a task; all that
            varies comes from the seed.
    """

    name: str
    description: str
    inject: Callable[[Controller, Task, int], DefectiveController]
