"""Spread of the action, which the paper calls entropy."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from curation_ros.core.scorers.features import moving_action
from curation_ros.core.scorers.scorer import Look, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


class Entropy(Scorer):
    """Negative standard deviation of the action sequence (the paper's 'entropy').

    The paper leaves open over what. `over='dimensions'` averages the standard deviations over time
    of the action dimensions. `over='values'` takes one standard deviation of all numbers. A binary
    gripper dominates both; `gripper_channel=False` leaves it out. The deviation is that of the
    population (divided by T).
    """

    needs = "nothing"
    resolution = 0.02
    choices: ClassVar = {"over": ("dimensions", "values")}

    def __init__(self, *, over: str = "dimensions", gripper_channel: bool = True) -> None:
        """Store the parameters.

        Args:
            over: whether the deviations of the dimensions are averaged, or one is taken of all
                values.
            gripper_channel: whether the command of the gripper is part of the action.
        """
        self.over = over
        self.gripper_channel = gripper_channel

    def look(self, episode: Episode) -> Look:
        """0 for no spread, more negative for more spread; in the unit of the action."""
        self.check_params()
        action = moving_action(episode, gripper_channel=self.gripper_channel)
        spread = action.std(axis=0).mean() if self.over == "dimensions" else action.std()
        return Look(-float(spread))
