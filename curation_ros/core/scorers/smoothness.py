"""Smoothness of the action, as spectral arc length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers.features import moving_action
from curation_ros.core.scorers.scorer import Abstain, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode import Episode
    from curation_ros.core.stream import Floats


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
        speed: (T,) not negative, not all zero, T >= 2.
        rate_hz: sampling rate of `speed`.
        cutoff_hz: frequencies above it are ignored; lowered to half the rate where it exceeds it.
        threshold: the band ends at the last frequency with this share of the largest amplitude.
        pad_level: the spectrum is taken over 2**(ceil(log2(T)) + pad_level) points.

    Returns:
        The negative arc length of the normalised amplitude spectrum, no unit.

    Raises:
        Abstain: if the rate is not positive, or the speed is zero throughout.

    Source: Balasubramanian, Melendez-Calderon, Burdet, IEEE TBME 59(8), 2012, with the adaptive
    cut-off of Balasubramanian et al., J. NeuroEngineering and Rehabilitation 12:112, 2015.
    Differences: the cut-off is limited to half the rate.
    """
    if not (np.isfinite(rate_hz) and rate_hz > 0):
        raise Abstain(f"the rate of the clock is {rate_hz} Hz")
    n_fft = 2 ** (int(np.ceil(np.log2(len(speed)))) + pad_level)
    amplitude = np.abs(np.fft.rfft(speed, n_fft))
    if not amplitude.max() > 0:
        raise Abstain("the speed is zero throughout")
    frequency_hz = np.arange(len(amplitude)) * (rate_hz / n_fft)
    amplitude = (amplitude / amplitude.max())[frequency_hz <= cutoff_hz]
    band = np.flatnonzero(amplitude >= threshold)
    amplitude = amplitude[band[0] : band[-1] + 1] if len(band) else amplitude[:0]
    if len(amplitude) < 2:
        raise Abstain(f"no spectrum below {cutoff_hz} Hz at {rate_hz:.3g} Hz")
    step = 1.0 / (len(amplitude) - 1)
    return -float(np.sum(np.hypot(step, np.diff(amplitude))))


class Smoothness(Scorer):
    """Spectral arc length of the norm of the action over time (the paper's 'smoothness').

    The rate is the episode's own. With a binary gripper in the action its constant 1 dominates
    the norm: the paper's definition, kept as the default; `gripper_channel=False` leaves it out.
    """

    needs = "nothing"
    resolution = 0.05

    def __init__(
        self,
        *,
        cutoff_hz: float = 10.0,
        threshold: float = 0.05,
        pad_level: int = 4,
        gripper_channel: bool = True,
    ) -> None:
        """Store the parameters of `spectral_arc_length`, and whether the gripper counts."""
        self.cutoff_hz = cutoff_hz
        self.threshold = threshold
        self.pad_level = pad_level
        self.gripper_channel = gripper_channel

    def check_params(self) -> None:
        """Check the ranges."""
        if not (self.cutoff_hz > 0 and 0 < self.threshold < 1 and self.pad_level >= 0):
            raise ConfigError(
                "Smoothness: expected cutoff_hz > 0, 0 < threshold < 1 and pad_level >= 0, found "
                f"{self.cutoff_hz}, {self.threshold} and {self.pad_level}"
            )

    def score(self, episode: Episode) -> float:
        """0 is smoothest, more negative is jerkier."""
        self.check_params()
        action = moving_action(episode, gripper_channel=self.gripper_channel)
        return spectral_arc_length(
            np.linalg.norm(action, axis=1),
            episode.rate_hz,
            cutoff_hz=self.cutoff_hz,
            threshold=self.threshold,
            pad_level=self.pad_level,
        )
