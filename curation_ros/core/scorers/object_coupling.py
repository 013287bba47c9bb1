"""Whether the grasped object stayed with the effector until it was released."""

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

    The object is the one nearest to the effector at the grasp. It counts as carried while its
    distance from the effector does not grow. An object that turns in the fingers keeps that
    distance; one that falls or stays behind does not. (A bowl that is held by its rim tilts by 2
    to 3 cm.)

    Growth beyond an allowance of 15 mm plus half the noise of the pose adds up from step to step
    (a CUSUM test). The loss is certain when the sum exceeds 12 mm plus four times the noise; after
    a command to open, two thirds of that suffice. The noise is measured on the object at rest
    before the grasp. The reference distance follows slowly, so that an object may settle. An
    object that is released in TRANSPORT and does not fall was put down.

    Without LIFT and TRANSPORT in the topic map, a carry lasts from half a second after a closing
    command to the opening. Then an early opening is no loss, as the goal is unknown, and an empty
    closing need not have been a grasp. Only an object that slips gets a score; for the others it
    abstains.

    Abstains, with the reason, if an object has no pose, its pose freezes or jumps (perhaps to
    another object), two objects are equally near, or the episode ends during a carry.

    It always sees the whole episode. Steps after TRANSPORT do not change the score.
    """

    needs = "object pose"
    length_controlled = False
    resolution = 0.02
    version = 2

    def look(self, episode: Episode) -> Look:
        """1: carried to the end; less: it left after that share of the carry; 0: never carried.

        The steps run from the first one of leaving to the one that makes it certain.
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
    """The carrying of an episode, if its outcome is known.

    Raises:
        Abstain: with the reason, if it is not known.
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
    """Step at which a hold began to break because of a command to open; None if none did.

    With a noisy pose the object may seem to leave a little before the command or after it. The
    earlier of the two steps counts. An object that slips out of closed fingers may have been
    grasped badly. Then it is unknown from which step on the episode is bad, so there is no step.
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
    """First step of the loss and the one that makes it certain, of the hold that decides."""
    hold: Hold | None = carrying.worst
    if hold is None or hold.departed is None or hold.noticed is None:
        return None
    return hold.departed, hold.noticed


def seconds(episode: Episode, step: int) -> float:
    """Seconds from the start of the episode to a step."""
    return (int(episode.stamps_ns[step]) - episode.start_ns) / NS_PER_S
