"""Length alone: the baseline for the length confound."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from curation_ros.core.scorers.features import moving_action
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


class Length(Scorer):
    """Negative length: shorter is better. It shows what a scorer gains from length alone.

    `of='steps'` counts steps. `of='path'` sums the way of the effector (the paper's 'cumulative
    path'). It is never length-controlled, as then all lengths would be equal.
    """

    needs = "nothing"
    length_controlled = False
    choices: ClassVar = {"of": ("steps", "path")}

    def __init__(self, *, of: str = "steps") -> None:
        """Store the parameters.

        Args:
            of: what is measured, steps or the path of the effector.
        """
        self.of = of
        self.resolution = 0.01 if of == "path" else 1.0

    def look(self, episode: Episode) -> Look:
        """Negative number of steps, or negative path in the unit of the effector."""
        self.check_params()
        moving_action(episode)  # a broken or frozen recording has no meaningful length
        if self.of == "steps":
            return Look(-float(len(episode)))
        effectors = episode.topic_map.with_role("effector")
        if not effectors:
            raise Abstain("the topic map declares no effector")
        path = episode.fields[effectors[0].name]
        if not np.isfinite(path).all():
            raise Abstain("the effector has values that are not finite")
        return Look(-float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()))
