"""When the gripper opens after it was closed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence import gripper
from curation_ros.core.scorers.features import checked_command, phase_name
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode


class GripperTiming(Scorer):
    """Step of the first opening after a closing, over the number of steps (the paper's).

    `on='command'` reads the command. `on='fingers'` reads the measured width, for hand-guided
    demonstrations without a command. The paper leaves open what an episode scores that never opens
    again: `never='latest'` gives it 1.0, `never='abstain'` no score. Abstains if the gripper never
    closed, and if the data contradict the meaning that the topic map declares.

    It needs no reference. With one, its explanation names the time at which trusted episodes open.

    Attributes:
        earliest_opening_s_: earliest opening in the reference, in seconds from the start. If none
            opened, the end of the shortest episode, until which all stayed closed.
    """

    needs = "nothing"
    resolution = 0.05
    choices: ClassVar = {"on": ("command", "fingers"), "never": ("latest", "abstain")}

    def __init__(self, *, on: str = "command", never: str = "latest") -> None:
        """Store the parameters.

        Args:
            on: which opening counts, that of the command or that of the measured fingers.
            never: score of an episode that never opens again: 1 (`latest`), or none (`abstain`).
        """
        self.on = on
        self.never = never

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn when the reference opens. This changes explanations, not scores."""
        self.check_params()
        opened, ended = [], []
        for episode in episodes:
            try:
                step = self._opening(episode)
            except Abstain:  # a rule that is fitted on these scores refuses the episode by name
                continue
            ended.append(_seconds(episode, len(episode) - 1))
            if step is not None:
                opened.append(_seconds(episode, step))
        self.earliest_opening_s_: float | None = min(opened or ended, default=None)
        return self

    def look(self, episode: Episode) -> Look:
        """From 0 (opened at once) to 1 (never opened again).

        The step of the look is that of the opening.
        """
        step = self._opening(episode)
        if step is None:
            if self.never == "abstain":
                raise Abstain("the gripper never opened again")
            return Look(1.0)
        explanation = self._explanation(episode, step)
        return Look(step / len(episode), steps=(step, step), explanation=explanation)

    def _explanation(self, episode: Episode, step: int) -> str:
        """When and in which phase it opened, and when trusted episodes do."""
        opened_s, phase = _seconds(episode, step), phase_name(episode, step)
        text = f"the gripper opened at {opened_s:.1f} s" + (f", in {phase}" if phase else "")
        earliest_s: float | None = getattr(self, "earliest_opening_s_", None)
        if earliest_s is not None and opened_s < earliest_s:
            return f"{text}; clean demonstrations open at {earliest_s:.1f} s or later"
        return f"{text}, after {step / len(episode):.0%} of {len(episode)} steps"

    def _opening(self, episode: Episode) -> int | None:
        self.check_params()
        if self.on == "command":
            return gripper.opening_of(checked_command(episode))
        if len(episode) < 2:
            raise Abstain(f"too short: the episode has {len(episode)} steps")
        try:
            width = gripper.finger_width(episode)
        except EpisodeError as err:
            raise Abstain(str(err).partition(": ")[2]) from None
        if width is None:
            raise Abstain("the topic map declares no fingers")
        if not np.isfinite(width).all():
            raise Abstain("the fingers have values that are not finite")
        state = gripper.width_state(width)
        if not (state < 0).any():
            raise Abstain("the fingers never closed")
        return gripper.opening_of(state)


def _seconds(episode: Episode, step: int) -> float:
    return (int(episode.stamps_ns[step]) - episode.start_ns) / NS_PER_S
