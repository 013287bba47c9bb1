"""Smoothness of the action, as spectral arc length."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from scipy import fft

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers.features import moving_action
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats


def spectral_arc_length(
    speed: Floats,
    rate_hz: float,
    *,
    cutoff_hz: float = 10.0,
    threshold: float = 0.05,
    pad_level: int = 4,
) -> float:
    """Arc length of a speed profile's spectrum; 0 is smoothest, more negative is jerkier.

    Args:
        speed: (T,) not negative, not all zero, T >= 1.
        rate_hz: sampling rate of `speed`.
        cutoff_hz: frequencies above it are ignored; at most half the rate is used.
        threshold: the band ends at the last frequency with this share of the largest amplitude.
        pad_level: the spectrum has 2**(ceil(log2(T)) + pad_level) points.

    Returns:
        The negative arc length of the normalised amplitude spectrum, without a unit.

    Raises:
        Abstain: if the rate is not positive, or the speed is zero throughout.

    Source: Balasubramanian, Melendez-Calderon, Burdet, IEEE TBME 59(8), 2012, with the adaptive
    cut-off of Balasubramanian et al., J. NeuroEngineering and Rehabilitation 12:112, 2015.
    Differences: the cut-off is limited to half the rate. The authors' code (monalysa) takes the
    whole FFT, so a cut-off above half the rate includes the mirror image of the spectrum. Below
    half the rate the two agree to rounding.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise Abstain(f"the rate of the clock is {rate_hz} Hz")
    n_fft = 2 ** (int(np.ceil(np.log2(len(speed)))) + pad_level)
    amplitude = np.abs(fft.rfft(speed, n_fft))
    if not amplitude.max() > 0:
        raise Abstain("the speed is zero throughout")
    frequency_hz = np.arange(len(amplitude)) * (rate_hz / n_fft)
    amplitude = (amplitude / amplitude.max())[frequency_hz <= cutoff_hz]
    band = np.flatnonzero(amplitude >= threshold)
    amplitude = amplitude[band[0] : band[-1] + 1] if len(band) else amplitude[:0]
    if len(amplitude) < 2:
        raise Abstain(f"no spectrum below {cutoff_hz} Hz at {rate_hz:.3g} Hz")
    step = 1.0 / (len(amplitude) - 1)
    return -float(np.sum(np.sqrt(step**2 + np.diff(amplitude) ** 2)))


class Smoothness(Scorer):
    """Spectral arc length of the norm of the action over time (the paper's 'smoothness').

    The paper names neither rate, cut-off nor threshold. By default the rate is that of the
    episode, and the others are those of the authors of the measure. `rate_hz` sets one rate for
    all episodes. At 1 Hz, the default of the paper's released library, the cut-off never applies.

    The norm of an action is a speed if actions are velocities. For commanded positions,
    `profile='change'` takes the norm of their differences. With a binary gripper in the action,
    its constant 1 dominates the norm. That is the paper's definition and the default;
    `gripper_channel=False` leaves it out.
    """

    needs = "nothing"
    resolution = 0.05
    choices: ClassVar = {"profile": ("norm", "change")}

    def __init__(
        self,
        *,
        rate_hz: float = 0.0,
        cutoff_hz: float = 10.0,
        threshold: float = 0.05,
        pad_level: int = 4,
        profile: str = "norm",
        gripper_channel: bool = True,
    ) -> None:
        """Store the parameters.

        Args:
            rate_hz: sampling rate that is assumed; 0 takes that of the episode.
            cutoff_hz: frequencies above it are ignored.
            threshold: the band ends at the last frequency with this share of the largest.
            pad_level: how many times the number of points of the spectrum is doubled.
            profile: whose spectrum is taken: `norm` of the action, or norm of its `change`.
            gripper_channel: whether the command of the gripper is part of the action.
        """
        self.rate_hz = rate_hz
        self.cutoff_hz = cutoff_hz
        self.threshold = threshold
        self.pad_level = pad_level
        self.profile = profile
        self.gripper_channel = gripper_channel

    def check_params(self) -> None:
        """Check the ranges."""
        super().check_params()
        if not (self.cutoff_hz > 0 and 0 < self.threshold < 1 and self.pad_level >= 0):
            raise ConfigError(
                "Smoothness: expected cutoff_hz > 0, 0 < threshold < 1 and pad_level >= 0, found "
                f"{self.cutoff_hz}, {self.threshold} and {self.pad_level}"
            )
        if not (np.isfinite(self.rate_hz) and self.rate_hz >= 0):
            raise ConfigError(
                f"Smoothness: expected rate_hz > 0, or 0 for the episode's, found {self.rate_hz}"
            )

    def look(self, episode: Episode) -> Look:
        """0 is smoothest, more negative is jerkier."""
        self.check_params()
        action = moving_action(episode, gripper_channel=self.gripper_channel)
        if self.profile == "change":
            action = np.diff(action, axis=0)
        score = spectral_arc_length(
            np.linalg.norm(action, axis=1),
            self.rate_hz or episode.rate_hz,
            cutoff_hz=self.cutoff_hz,
            threshold=self.threshold,
            pad_level=self.pad_level,
        )
        return Look(score)
