"""When the gripper was opened within phases in which it must stay closed."""

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
    """How much of LIFT or TRANSPORT was done when the gripper was commanded to open.

    It serves graphs with phases and without objects. Each of the two phases counts by the share of
    its steps before the first one that is commanded open; 1 if there is none. A phase that begins
    open because the one before it ended open counts 1, as it has no opening of its own. The worst
    phase decides, by a soft minimum: -s ln(mean(exp(-v / s))) with s = `softness`. A mean over
    phases would dilute an opening that only one of them shows.

    It sees commands, not their effect. Abstains without these phases, if the episode never reached
    one of them, and if it ends in one of them. It always sees the whole episode.
    """

    needs = "nothing"
    length_controlled = False
    resolution = 0.02

    def __init__(self, *, softness: float = 0.1) -> None:
        """Store the parameters.

        Args:
            softness: how much the second phase counts next to the worst; above 0.
        """
        self.softness = softness

    def check_params(self) -> None:
        """Check the range."""
        super().check_params()
        if not (np.isfinite(self.softness) and self.softness > 0):
            raise ConfigError(f"PhaseEvents: expected softness > 0, found {self.softness}")

    def look(self, episode: Episode) -> Look:
        """1: not opened in either phase; towards 0 the earlier it was opened in the worst one.

        The step is that of the opening in the worst phase. The episode broke at the first opening
        in any phase.
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
        """Phase -> share of its steps before the opening, and the step of the opening."""
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
