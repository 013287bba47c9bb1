"""How episodes run: every default of the simulator stands here. Nothing heavy is imported."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from curation_ros.core.errors import ConfigError

SIMULATED_TASK = "bowl_on_plate"
"""Task that is simulated unless another one is named: a key of `sim_node.tasks.TASKS`."""

MAX_STEPS = 500
"""Most commands of an episode."""

STEPS_AFTER_SUCCESS = 20
"""Commands after success: a demonstration goes on for 1 s, to show what success looks like."""


@dataclass(frozen=True)
class EpisodeLimits:
    """When an episode ends.

    Attributes:
        max_steps: most commands, at least 1.
        steps_after_success: commands after the one that succeeded; 0 for rollouts of policies.
    """

    max_steps: int = MAX_STEPS
    steps_after_success: int = STEPS_AFTER_SUCCESS

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: if one is out of range.
        """
        if self.max_steps < 1 or self.steps_after_success < 0:
            raise ConfigError(
                f"max_steps must be >= 1 and steps_after_success >= 0, "
                f"got {self.max_steps} and {self.steps_after_success}"
            )


@dataclass(frozen=True)
class DriveSettings:
    """How the sim node drives episodes; the attributes are its parameters.

    Attributes:
        mode: `expert`: the scripted expert gives the commands; `command`: messages do.
        sync: `lockstep`: step when the command is there; `free`: step once per control period.
        max_steps: most commands of an episode.
        max_steps_defective: the same for episodes with a defect; 0: max_steps.
        steps_after_success: commands after the one that succeeded.
        realtime_factor: speed in `free`, 1 is real time.
        hold_timeout_s: in `free`, a command older than this counts as zero.
        command_timeout_s: in `lockstep`, longest wait for a command.
    """

    mode: Literal["expert", "command"] = "expert"
    sync: Literal["lockstep", "free"] = "lockstep"
    max_steps: int = MAX_STEPS
    max_steps_defective: int = 0
    steps_after_success: int = STEPS_AFTER_SUCCESS
    realtime_factor: float = 1.0
    hold_timeout_s: float = 0.5
    command_timeout_s: float = 5.0

    def limits(self, *, is_defective: bool) -> EpisodeLimits:
        """When an episode ends.

        Raises:
            ConfigError: if a number is out of range.
        """
        steps = self.max_steps_defective if is_defective else 0
        return EpisodeLimits(steps or self.max_steps, self.steps_after_success)
