"""When the gripper was opened within the phases in which it must not be."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import ConfigError
from curation_ros.core.evidence.holds import carry_labels
from curation_ros.core.scorers.features import checked_command
from curation_ros.core.scorers.object_coupling import seconds
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


class PhaseEvents(Scorer):
    """How far LIFT and TRANSPORT had come when the gripper was commanded to open: the worst.

    For graphs that have phases and no objects. Each of these phases counts by its own progress,
    the share of its steps before the first one that is commanded open, 1 if there is none; a
    phase that begins open because an earlier one was left open has no event of its own and counts
    1. The phases are put together by the worst, softly: -s ln(mean(exp(-v / s))) with
    s = `softness`. A mean of ranks over phases would dilute what shows in one of them alone.

    It sees commands and no consequence. Abstains without these phases, where the episode never
    came to one of them, and where it ends in one of them. It looks at the whole episode, whatever
    the length control.
    """

    needs = "nothing"
    length_controlled = False
    resolution = 0.02

    def __init__(self, *, softness: float = 0.1) -> None:
        """Store the parameters.

        Args:
            softness: how much a second phase counts beside the worst; above 0.
        """
        self.softness = softness

    def check_params(self) -> None:
        """Check the range."""
        super().check_params()
        if not (np.isfinite(self.softness) and self.softness > 0):
            raise ConfigError(f"PhaseEvents: expected softness > 0, found {self.softness}")

    def look(self, episode: Episode) -> Look:
        """1: not opened in any of them; towards 0 the earlier it was opened in the worst.

        The step is that of the opening in the worst phase; it broke at the first one in any.
        """
        events = self._events(episode)
        shares = np.array([share for share, _ in events.values()])
        score = -self.softness * float(np.log(np.mean(np.exp(-shares / self.softness))))
        label = min(events, key=lambda name: events[name][0])
        share, step = events[label]
        if step is None:
            return Look(score)
        return Look(
            score,
            steps=(step, step),
            explanation=(
                f"the gripper was opened at {seconds(episode, step):.2f} s, "
                f"after {share:.0%} of {label}"
            ),
            broke_at=min(at for _, at in events.values() if at is not None),
        )

    def _events(self, episode: Episode) -> dict[str, tuple[float, int | None]]:
        """Phase -> share of it before the opening, and the step of that."""
        self.check_params()
        is_open = checked_command(episode) > 0
        labels, phase = carry_labels(episode.topic_map), episode.phase
        if not labels or phase is None:
            raise Abstain("the topic map has no phase in which something is carried")
        events: dict[str, tuple[float, int | None]] = {}
        was_opened = False
        for index, label in labels.items():
            steps = np.flatnonzero(phase == index)
            if not len(steps):
                raise Abstain(f"it never came to {label}")
            opened = np.flatnonzero(is_open[steps])
            if len(opened) and opened[0] == 0 and was_opened:
                events[label] = (1.0, None)
            elif steps[-1] == len(phase) - 1:
                raise Abstain(f"it ends in {label}: how far that had come is not known")
            elif not len(opened):
                events[label] = (1.0, None)
            else:
                events[label] = (int(opened[0]) / len(steps), int(steps[opened[0]]))
            was_opened = bool(is_open[steps[-1]])
        return events
