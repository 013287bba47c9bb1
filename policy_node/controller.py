"""Drives a policy of any kind through an episode: the same object in the ROS node and rollouts."""

from __future__ import annotations

import numpy as np

from curation_ros.core.errors import PolicyError
from policy_node.policy import Command, Policy, Values, check_observed


class PolicyController:
    """Shows each step to a policy once, and answers the step with one command.

    A step that is repeated, as the simulator does in lockstep, gets the same command again.

    Args:
        policy: what decides. It is reset, and must drive nothing else meanwhile.
    """

    def __init__(self, policy: Policy) -> None:
        self.policy = policy
        self._commanded = set(policy.commanded)
        self.reset()

    def reset(self) -> None:
        """Forget the episode: the next step is the first of another one."""
        self.policy.reset()
        self._observed_step: int | None = None
        self._command: Command | None = None

    def answer(self, step: int, values: Values) -> Command:
        """The command that answers one step.

        Args:
            step: number or stamp of the step; grows from step to step.
            values: by field of the topic map; fields that the policy does not observe are ignored.

        Returns:
            (d,) values of each field that the policy commands.

        Raises:
            PolicyError: if a field is missing or unusable, the step is older than the last one, or
                the policy's command is incomplete or not finite. A step that the policy has not
                taken may be tried again.
        """
        last = self._observed_step
        if last is not None and step < last:
            raise PolicyError(f"step {step} comes after step {last}, expected a later one")
        if step == last and self._command is not None:
            return self._command
        if step != last:
            check_observed(values, self.policy.observed)
            self.policy.observe(values)
            self._observed_step, self._command = step, None
        self._command = self._checked(self.policy.act())
        return self._command

    def _checked(self, command: Command) -> Command:
        policy = self.policy
        if command.keys() != self._commanded:
            raise PolicyError(
                f"policy {policy.card.id}: its command has {', '.join(command) or 'no field'}, "
                f"expected {', '.join(policy.commanded)}"
            )
        for name, values in command.items():
            if not np.isfinite(values).all():
                raise PolicyError(
                    f"policy {policy.card.id}: its command {name} is {values}, "
                    "expected finite numbers"
                )
        return command
