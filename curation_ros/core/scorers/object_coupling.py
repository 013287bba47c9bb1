"""Whether what was grasped stayed with the effector until it was let go."""

from __future__ import annotations

from typing import TYPE_CHECKING

from curation_ros.core.carrying import Carrying, Hold, carrying_of
from curation_ros.core.scorers.features import checked_command
from curation_ros.core.scorers.scorer import Abstain, Scorer
from curation_ros.core.stream import NS_PER_S

if TYPE_CHECKING:
    from curation_ros.core.episode import Episode


class ObjectCoupling(Scorer):
    """Share of the steps of LIFT and TRANSPORT in which the grasped object was carried.

    The object is the one that is nearest to the effector at the grasp. It is carried as long as
    its distance from the effector does not grow: an object that turns in the fingers (a bowl that
    is held by its rim tilts by 2 to 3 cm) keeps that distance, one that falls or stays behind
    does not. Growth beyond 15 mm and half the noise of the pose adds up from step to step, and
    beyond 12 mm and four times that noise it is sure (a CUSUM test); the noise is measured on the
    object at rest before the grasp. The reference follows slowly, so that an object may settle.
    What is opened in TRANSPORT and does not fall was put down.

    Without these phases in the topic map, the time from half a second after a closing command to
    the opening counts: an early opening is then no break, as nobody says where the goal is.

    Abstains, with what it could not know, where an object has no pose, its pose freezes or jumps
    (to another object, perhaps), two objects are equally near, or the episode ends in mid-carry.

    It looks at the whole episode, whatever the length control: what follows after TRANSPORT does
    not change it.
    """

    needs = "object pose"
    length_controlled = False
    resolution = 0.02

    def score(self, episode: Episode) -> float:
        """1: carried all the way; less: it left at that share of the way; 0: never carried."""
        return self._carrying(episode).coupling

    def location(self, episode: Episode) -> tuple[int, int] | None:
        """From the first step of leaving to the one that makes it sure."""
        return lost_steps(self._carrying(episode))

    def explain(self, episode: Episode) -> str | None:
        """When and where it left the effector."""
        hold = self._carrying(episode).worst
        if hold is None or hold.departed is None or hold.noticed is None:
            return None
        where = f", in {hold.phase}" if hold.phase else ""
        if hold.state == "never":
            left_s = seconds(episode, hold.departed)
            return f"{hold.object} was not taken along: left behind at {left_s:.1f} s{where}"
        after_s = seconds(episode, hold.noticed) - seconds(episode, hold.departed)
        return (
            f"{hold.object} left the effector at {seconds(episode, hold.departed):.1f} s{where}"
            f"{', opened' if hold.opened else ''}; {after_s:.2f} s later it was "
            f"{hold.gap_m:.3f} m farther away"
        )

    def _carrying(self, episode: Episode) -> Carrying:
        if episode.topic_map.gripper is not None:
            checked_command(episode)
        return known(carrying_of(episode))


def known(carrying: Carrying) -> Carrying:
    """What became of what was grasped, if that is known.

    Raises:
        Abstain: with the reason, if it is not.
    """
    worst = carrying.worst
    if worst is None or worst.state == "unknown":
        raise Abstain(carrying.reason if worst is None else worst.reason)
    return carrying


def lost_steps(carrying: Carrying) -> tuple[int, int] | None:
    """First step of the loss and the one that makes it sure, of the hold that decides."""
    hold: Hold | None = carrying.worst
    if hold is None or hold.departed is None or hold.noticed is None:
        return None
    return hold.departed, hold.noticed


def seconds(episode: Episode, step: int) -> float:
    """Time of a step from the start of the episode."""
    return (int(episode.stamps_ns[step]) - episode.start_ns) / NS_PER_S
