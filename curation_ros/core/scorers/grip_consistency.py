"""Whether the fingers held something while something was to be carried."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from curation_ros.core.errors import ConfigError
from curation_ros.core.evidence.fingers import held_by_fingers
from curation_ros.core.evidence.holds import Carrying
from curation_ros.core.scorers.features import checked_command
from curation_ros.core.scorers.object_coupling import (
    known,
    lost_steps,
    opened_too_early,
    seconds,
)
from curation_ros.core.scorers.scorer import Look, Scorer

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


class GripConsistency(Scorer):
    """Share of the steps of LIFT and TRANSPORT in which the fingers held something.

    It serves graphs without the pose of an object. It is evidence of the gripper, not of the
    object.

    `on='fingers'`: the fingers hold something while their gap is at least 2.5 % of the widest
    opening so far, and no wider than at its narrowest since the grasp plus 5 % of that opening.

    `on='effort'`: they hold something while their efforts, in the field that `effort` names, keep
    a fifth of the value at the grasp, in its direction. An empty grasp is noticed only if it takes
    next to no effort.

    Two steps in a row without a grip make a loss certain. Without LIFT and TRANSPORT in the topic
    map, a carry lasts from half a second after a closing command to the opening. Then only an
    object that slips out of the fingers gets a score; for the others it abstains.

    Abstains without fingers (or effort) in the topic map, and if the episode ends during a carry.
    It always sees the whole episode.
    """

    needs = "nothing"
    length_controlled = False
    resolution = 0.02
    version = 2
    choices: ClassVar = {"on": ("fingers", "effort")}

    def __init__(self, *, on: str = "fingers", effort: str = "") -> None:
        """Store the parameters.

        Args:
            on: what is read, the gap between the fingers or their effort.
            effort: field with the efforts of the fingers, for `on: effort`.
        """
        self.on = on
        self.effort = effort

    def check_params(self) -> None:
        """Check that there is a field for effort, and only for effort."""
        super().check_params()
        if (self.on == "effort") != bool(self.effort):
            raise ConfigError(
                f"GripConsistency: on is {self.on!r} and effort {self.effort!r}, expected the "
                "field of the topic map with the efforts, with on: effort and only then"
            )

    def look(self, episode: Episode) -> Look:
        """1: held to the end; less: lost after that share of the carry; 0: never held.

        The steps are the first one without a grip and the one that makes it certain.
        """
        self.check_params()
        checked_command(episode)
        carrying = known(episode, held_by_fingers(episode, effort=self.effort))
        return Look(
            carrying.coupling,
            steps=lost_steps(carrying),
            explanation=_explanation(episode, carrying),
            broke_at=opened_too_early(episode, carrying),
        )


def _explanation(episode: Episode, carrying: Carrying) -> str | None:
    """When and in which phase the fingers lost it."""
    hold = carrying.worst
    if hold is None or hold.departed is None:
        return None
    where = f", in {hold.phase}" if hold.phase else ""
    return (
        f"the fingers {'had let go' if hold.opened else 'held nothing'} at "
        f"{seconds(episode, hold.departed):.2f} s{where}, as {hold.object} shows"
    )
