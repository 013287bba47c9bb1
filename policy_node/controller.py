"""Drives a policy through an episode: the same object in the ROS node and in rollouts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import PolicyError
from curation_ros.core.types import Floats
from policy_node.observation import PHASE
from policy_node.policy import Policy


class PolicyController:
    """Remembers what the first step of the episode looked like; nothing else has a memory.

    So the same values answered twice give the same command, and `reset` makes a new episode.

    Args:
        policy: what decides.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._start: dict[str, Floats] | None = None

    def reset(self) -> None:
        """Forget the episode: the next step is the first of another one."""
        self._start = None

    def act(self, values: Mapping[str, npt.ArrayLike], phase_index: int) -> tuple[Floats, float]:
        """The command that answers one step.

        Args:
            values: (d,) values by field of the topic map; more than needed is no harm.
            phase_index: place of the present phase in the policy's phase labels.

        Returns:
            (3,) twist, unitless in [-1, 1], and the gripper: -1 opens, +1 closes, 0 holds.

        Raises:
            PolicyError: if a field is missing, has a wrong width or is not finite, or there is
                no such phase. A first step that raises is not remembered.
        """
        spec = self.policy.spec
        for name in spec.fields:
            if name not in values and name != PHASE:
                raise PolicyError(
                    f"observation: no field {name!r}; it has {', '.join(values) or 'none'}"
                )
        start = self._start
        if start is None:
            # Copies: the caller may fill the same arrays anew in the next step.
            start = {k: np.array(values[k], dtype=np.float64) for k in spec.start_fields}
        command = self.policy.act(spec.from_step({**values, PHASE: [phase_index]}, start))
        self._start = start
        return command
