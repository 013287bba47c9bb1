"""Smoothness and gripper timing together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.scorer import Abstain, Look, Need, Scorer
from curation_ros.core.scorers.smoothness import Smoothness

if TYPE_CHECKING:
    from typing_extensions import Self

    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats


class Ensemble(Scorer):
    """Weighted sum of smoothness and gripper timing (the paper's 0.5 and 0.5).

    The paper adds raw scores. Smoothness (about -10 to -1.5) and timing (0 to 1) have different
    scales, so the one that varies more decides. `standardised=True` subtracts the mean of each in
    the reference and divides by its standard deviation. Then a reference is needed.

    The parameters `rate_hz` and `gripper_channel` are those of smoothness, `on` is that of gripper
    timing. Abstains if either part does.

    Attributes:
        mean_: (2,) mean of smoothness and timing in the reference; zeros if not standardised.
        scale_: (2,) their standard deviation, at least their resolution; ones if not standardised.
    """

    needs: Need = "nothing"
    resolution = 0.05
    choices: ClassVar = {"on": GripperTiming.choices["on"]}

    def __init__(
        self,
        *,
        smoothness_weight: float = 0.5,
        gripper_weight: float = 0.5,
        standardised: bool = False,
        rate_hz: float = 0.0,
        gripper_channel: bool = True,
        on: str = "command",
    ) -> None:
        """Store the parameters.

        Args:
            smoothness_weight: weight of smoothness.
            gripper_weight: weight of gripper timing.
            standardised: whether the parts are standardised by the reference first.
            rate_hz: sampling rate that smoothness assumes; 0 takes that of the episode.
            gripper_channel: whether smoothness includes the command of the gripper.
            on: what gripper timing reads, the command or the measured fingers.
        """
        self.smoothness_weight = smoothness_weight
        self.gripper_weight = gripper_weight
        self.standardised = standardised
        self.rate_hz = rate_hz
        self.gripper_channel = gripper_channel
        self.on = on
        self.needs = "reference" if standardised else "nothing"

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        self._smoothness().check_params()
        weights = (self.smoothness_weight, self.gripper_weight)
        if not (np.isfinite(weights).all() and min(weights) >= 0 and sum(weights) > 0):
            raise ConfigError(
                "Ensemble: expected smoothness_weight and gripper_weight not negative and not "
                f"both 0, found {weights}"
            )

    def fit(self, episodes: Sequence[Episode]) -> Self:
        """Learn the scales of the parts, if they are standardised."""
        self.check_params()
        mean, scale = np.zeros(2), np.ones(2)
        if self.standardised:
            try:
                parts = np.array([self._parts(e) for e in episodes])
            except Abstain as reason:
                raise EpisodeError(f"a reference episode cannot be used: {reason}") from None
            if len(parts) < 2:
                raise EpisodeError(
                    f"the reference has {len(parts)} episodes, at least 2 are needed"
                )
            mean = parts.mean(axis=0)
            floor = [Smoothness.resolution, GripperTiming.resolution]
            scale = np.maximum(parts.std(axis=0), floor)
        self.mean_, self.scale_ = mean, scale
        return self

    def look(self, episode: Episode) -> Look:
        """The weighted sum, without a unit."""
        self.check_params()
        if self.standardised:
            self._check_fitted()
        parts = self._parts(episode)
        if self.standardised:
            parts = (parts - self.mean_) / self.scale_
        return Look(float(np.dot((self.smoothness_weight, self.gripper_weight), parts)))

    def _parts(self, episode: Episode) -> Floats:
        timing = GripperTiming(on=self.on)
        return np.array([self._smoothness().score(episode), timing.score(episode)])

    def _smoothness(self) -> Smoothness:
        return Smoothness(rate_hz=self.rate_hz, gripper_channel=self.gripper_channel)
