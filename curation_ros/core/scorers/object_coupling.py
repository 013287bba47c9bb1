"""Whether what was grasped stayed with the effector until it was let go."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.carrying import carrying_of
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.evidence.holds import Carrying, Hold, carry_labels
from curation_ros.core.scorers.features import checked_command
from curation_ros.core.scorers.scorer import Abstain, Look, Scorer
from curation_ros.core.types import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode


class ObjectCoupling(Scorer):
    """Share of the steps of LIFT and TRANSPORT in which the grasped object was carried.

    The object is the one that is nearest to the effector at the grasp. It is carried as long as
    its distance from the effector does not grow: an object that turns in the fingers (a bowl that
    is held by its rim tilts by 2 to 3 cm) keeps that distance, one that falls or stays behind
    does not. Growth beyond 15 mm and half the noise of the pose adds up from step to step, and
    beyond 12 mm and four times that noise it is sure (a CUSUM test), beyond two thirds of that
    after a command to open; the noise is measured on the object at rest before the grasp. The
    reference follows slowly, so that an object may settle. What is opened in TRANSPORT and does
    not fall was put down.

    Without these phases in the topic map, the time from half a second after a closing command to
    the opening counts: an early opening is then no break, as nobody says where the goal is, nor
    whether anything was to be carried; it abstains but for what slips.

    Abstains, with what it could not know, where an object has no pose, its pose freezes or jumps
    (to another object, perhaps), two objects are equally near, or the episode ends in mid-carry.

    It looks at the whole episode, whatever the length control: what follows after TRANSPORT does
    not change it.
    """

    needs = "object pose"
    length_controlled = False
    resolution = 0.02
    version = 2

    def look(self, episode: Episode) -> Look:
        """1: carried all the way; less: it left at that share of the way; 0: never carried.

        The steps run from the first one of leaving to the one that makes it sure.
        """
        if episode.topic_map.gripper is not None:
            checked_command(episode)
        carrying = known(episode, carrying_of(episode))
        return Look(
            carrying.coupling,
            steps=lost_steps(carrying),
            explanation=_explanation(episode, carrying),
            broke_at=opened_too_early(episode, carrying),
        )


def _explanation(episode: Episode, carrying: Carrying) -> str | None:
    """When and where the object left the effector."""
    hold = carrying.worst
    if hold is None or hold.departed is None or hold.noticed is None:
        return None
    where = f", in {hold.phase}" if hold.phase else ""
    if hold.state == "never":
        left_s = seconds(episode, hold.departed)
        return f"{hold.object} was not taken along: left behind at {left_s:.2f} s{where}"
    return (
        f"{hold.object} left the effector at {seconds(episode, hold.departed):.2f} s{where}"
        f"{', opened' if hold.opened else ''}; at {seconds(episode, hold.noticed):.2f} s it "
        f"was {hold.gap_m:.3f} m farther away"
    )


def known(episode: Episode, carrying: Carrying) -> Carrying:
    """What became of what was grasped, if that is known.

    Raises:
        Abstain: with the reason, if it is not.
    """
    worst = carrying.worst
    if worst is None or worst.state == "unknown":
        raise Abstain(carrying.reason if worst is None else worst.reason)
    if worst.state != "broken" and not carry_labels(episode.topic_map):
        raise Abstain(
            "it was held until the gripper opened; without phases, maybe too early"
            if worst.state == "carried"
            else "nothing was taken along; without phases, maybe nothing was to be"
        )
    return carrying


def opened_too_early(episode: Episode, carrying: Carrying) -> int | None:
    """Step at which a hold began to break by a command to open; None where none broke so.

    A noisy pose may seem to leave a little before that command, or after it: the earlier of the
    two counts. What slips out of closed fingers may have been grasped badly: how far back the
    episode is bad then, nobody knows.
    """
    hold = carrying.worst
    if hold is None or hold.state != "broken" or hold.departed is None or hold.noticed is None:
        return None
    try:
        is_open = commanded(episode) > 0
    except EpisodeError:
        return None
    opened = np.flatnonzero(is_open[hold.first : hold.noticed + 1])
    return min(hold.departed, hold.first + int(opened[0])) if len(opened) else None


def lost_steps(carrying: Carrying) -> tuple[int, int] | None:
    """First step of the loss and the one that makes it sure, of the hold that decides."""
    hold: Hold | None = carrying.worst
    if hold is None or hold.departed is None or hold.noticed is None:
        return None
    return hold.departed, hold.noticed


def seconds(episode: Episode, step: int) -> float:
    """Time of a step from the start of the episode."""
    return (int(episode.stamps_ns[step]) - episode.start_ns) / NS_PER_S
