"""Whether the fingers held something for as long as something was to be carried."""

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

    For graphs without the pose of an object; evidence of the gripper, not of the object.
    `on='fingers'`: the gap is neither closed (below 2.5 % of the widest opening so far) nor wider
    by 5 % of it than at its narrowest since the grasp. `on='effort'`: the efforts of the fingers,
    the field that `effort` names, still have a fifth of what they had at the grasp, and in its
    direction; an empty grasp shows only where it is as good as without effort. Two steps in a row
    make it sure.

    Without these phases in the topic map, the time from half a second after a closing command to
    the opening counts: it abstains then but for what slips out of the fingers.

    Abstains without fingers (or effort) in the topic map, and where the episode ends in
    mid-carry. It looks at the whole episode, whatever the length control.
    """

    needs = "nothing"
    length_controlled = False
    resolution = 0.02
    version = 2
    choices: ClassVar = {"on": ("fingers", "effort")}

    def __init__(self, *, on: str = "fingers", effort: str = "") -> None:
        """Store the parameters.

        Args:
            on: what is read: the gap between the fingers, or their effort.
            effort: the field with the efforts of the fingers, for `effort`.
        """
        self.on = on
        self.effort = effort

    def check_params(self) -> None:
        """Check that effort has a field."""
        super().check_params()
        if (self.on == "effort") != bool(self.effort):
            raise ConfigError(
                f"GripConsistency: on is {self.on!r} and effort {self.effort!r}, expected the "
                "field of the topic map with the efforts, with on: effort and only then"
            )

    def look(self, episode: Episode) -> Look:
        """1: held all the way; less: let go or closed on nothing at that share; 0: never held.

        The steps are the first one without a grip and the one that makes it sure.
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
    """When and where the fingers held nothing any more."""
    hold = carrying.worst
    if hold is None or hold.departed is None:
        return None
    where = f", in {hold.phase}" if hold.phase else ""
    return (
        f"the fingers {'had let go' if hold.opened else 'held nothing'} at "
        f"{seconds(episode, hold.departed):.2f} s{where}, as {hold.object} shows"
    )
