"""What a policy commands: targets for training made of an episode's commands, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, PolicyError
from curation_ros.core.evidence.gripper import is_closed_command, is_open_command
from curation_ros.core.types import Floats, Span

TWIST = "twist"
GRIPPER_OPEN, GRIPPER_CLOSED = -1.0, 1.0
N_OUTPUTS = 4


@dataclass(frozen=True)
class ActionSpec:
    """How commands become targets in [-1, 1] and outputs become commands.

    Attributes:
        scale: command (unitless, as on `command/twist`) that is an output of 1. Demonstrations
            move slower than they may; targets that fill [-1, 1] are learned far better than small
            ones. Faster commands are clipped to it, so the policy is never faster than `scale`.

    Raises:
        PolicyError: if the scale is not in (0, 1].
    """

    scale: float = 0.2

    def __post_init__(self) -> None:
        if not 0.0 < self.scale <= 1.0:
            raise PolicyError(f"action scale is {self.scale}, expected a number in (0, 1]")

    def check(self, topic_map: TopicMap, where: str) -> None:
        """Refuse a topic map whose commands mean something else.

        Args:
            topic_map: of an episode or of a robot.
            where: whose requirement it is, for the message.

        Raises:
            PolicyError: if there is no twist of three unitless values, or the gripper's command
                does not go from -1, open, to +1, closed.
        """
        twist = topic_map.fields.get(TWIST)
        if twist is None or len(twist.values) != 3 or twist.unit not in ("", "1"):
            found = "none" if twist is None else f"{len(twist.values)} in {twist.unit!r}"
            raise PolicyError(
                f"{where}: the topic map's field {TWIST!r} must have 3 unitless values, "
                f"found {found}"
            )
        gripper = topic_map.gripper
        ends = None if gripper is None else (gripper.open_value, gripper.closed_value)
        if ends != (GRIPPER_OPEN, GRIPPER_CLOSED):
            raise PolicyError(
                f"{where}: the topic map's gripper (open, closed) is {ends}, "
                f"expected {(GRIPPER_OPEN, GRIPPER_CLOSED)}"
            )

    def targets(self, episode: Episode, span: Span | None = None) -> Floats:
        """What the network should answer to the steps of an episode.

        The gripper's target is the command in force: a step that holds has the target of the last
        command before it, inside the span or not. Before the first command it is 0.

        Args:
            episode: the whole episode.
            span: nanoseconds from the start stamp, inclusive; None: all steps.

        Returns:
            (T, 4) in [-1, 1]: twist / scale, clipped, and -1 open to +1 closed.

        Raises:
            PolicyError: if a field is missing or means something else, or a twist in the span is
                not finite.
        """
        scaled = self._scaled(episode, span)
        return np.clip(scaled, -1.0, 1.0)

    def clipped_fraction(self, episode: Episode, span: Span | None = None) -> float:
        """Fraction of the values of the twist that `targets` clips; raises as it does."""
        return float(np.mean(np.abs(self._scaled(episode, span)[:, :3]) > 1.0))

    def command(self, output: Floats) -> tuple[Floats, float]:
        """The command that an output of the network means.

        Args:
            output: (4,) in [-1, 1].

        Returns:
            (3,) twist in [-scale, scale], and the gripper: the sign of the output, -1 opens, +1
            closes. Exactly 0 is 0, which holds what was last commanded.
        """
        return output[:3] * self.scale, float(np.sign(output[3]))

    def _scaled(self, episode: Episode, span: Span | None) -> Floats:
        where = f"episode {episode.id}"
        self.check(episode.topic_map, where)
        try:
            twist = episode.field(TWIST)
            # Of the whole episode: what a cut begins with may have been commanded before it.
            gripper = 1.0 * is_closed_command(episode) - is_open_command(episode)
        except CurationError as err:
            raise PolicyError(str(err)) from err
        every = np.column_stack([twist / self.scale, gripper])
        stamps = episode.stamps_ns - episode.start_ns
        part = every if span is None else every[(stamps >= span[0]) & (stamps <= span[1])]
        bad = np.flatnonzero(~np.isfinite(part).all(axis=1))
        if len(bad):
            raise PolicyError(f"{where}: {TWIST} in row {bad[0]} is not finite")
        return part
