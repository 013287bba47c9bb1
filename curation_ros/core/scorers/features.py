"""What scorers read from an episode, with the reason to abstain if it cannot be read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence import gripper
from curation_ros.core.scorers.scorer import Abstain

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats


def _columns(episode: Episode, names: tuple[str, ...], what: str) -> Floats:
    if len(episode) < 2:
        raise Abstain(f"too short: the episode has {len(episode)} steps")
    if not names:
        raise Abstain(f"the topic map declares no {what}")
    missing = [n for n in names if n.partition("@")[0] not in episode.fields]
    if missing:
        raise Abstain(f"the {what} lacks the field {missing[0]!r}")
    topic_map = episode.topic_map
    if names == topic_map.action:
        values = episode.action  # computed once for all scorers
    elif names == topic_map.state:
        values = episode.state
    else:
        values = episode.columns(names)
    if not np.isfinite(values).all():
        raise Abstain(f"the {what} has values that are not finite")
    return values


def moving_action(episode: Episode, *, gripper_channel: bool = True) -> Floats:
    """Actions of an episode in which the robot was commanded to move.

    Args:
        episode: any episode.
        gripper_channel: whether the command of the gripper is included.

    Returns:
        (T, A) with T >= 2, finite, with at least two different rows.

    Raises:
        Abstain: if there are no such actions.
    """
    topic_map = episode.topic_map
    names = topic_map.action
    if not gripper_channel:
        grippers = {spec.name for spec in topic_map.with_role("gripper")}
        names = tuple(n for n in names if n.partition("@")[0] not in grippers)
    values = _columns(episode, names, "action")
    if (values == values[0]).all():
        raise Abstain("the action never changes")
    return values


def finite_state(episode: Episode) -> Floats:
    """(T, S) states, T >= 2, finite.

    Raises:
        Abstain: if there are no such states.
    """
    return _columns(episode, episode.topic_map.state, "state")


def mean_std_rms(values: Floats) -> Floats:
    """(3 D,) mean, standard deviation and root mean square of each column of (T, D)."""
    rms = np.sqrt(np.mean(values**2, axis=0))
    return np.concatenate([values.mean(axis=0), values.std(axis=0), rms])


def reference_features(rows: Sequence[Floats], episodes: Sequence[Episode], least: int) -> Floats:
    """Features of reference episodes as one table.

    Args:
        rows: one (F,) vector per episode.
        episodes: the episodes, for messages.
        least: smallest useful number of episodes.

    Returns:
        (n, F).

    Raises:
        EpisodeError: if there are too few episodes, or their widths differ.
    """
    if len(rows) < least:
        raise EpisodeError(f"the reference has {len(rows)} episodes, at least {least} are needed")
    for row, episode in zip(rows, episodes, strict=True):
        if len(row) != len(rows[0]):
            raise EpisodeError(
                f"reference episode {episode.id}: its state and action have other columns than "
                f"those of {episodes[0].id}"
            )
    return np.array(rows)


def check_width(found: int, expected: int, what: str, of: str = "reference") -> None:
    """Abstain on an episode of another robot than that of the reference or dataset.

    Raises:
        Abstain: if the widths differ.
    """
    if found != expected:
        raise Abstain(f"{what}: {found} values, the {of} has {expected}")


def start_state(episode: Episode) -> Floats:
    """Where an episode started, from its data. Repetitions of one start share it.

    Returns:
        (S,) first row of the fields with role object, or of the effectors if the map has no
        object.

    Raises:
        Abstain: if there is no such field or row, or if it is not finite.
    """
    topic_map = episode.topic_map
    specs = topic_map.with_role("object") or topic_map.with_role("effector")
    if not specs or not len(episode):
        raise Abstain("its start is unknown: no step, or neither object nor effector in the map")
    missing = [spec.name for spec in specs if spec.name not in episode.fields]
    if missing:
        raise Abstain(f"its start lacks the field {missing[0]!r}")
    start: Floats = np.concatenate([episode.fields[spec.name][0] for spec in specs])
    if not np.isfinite(start).all():
        raise Abstain("its start is not finite")
    return start


def phase_name(episode: Episode, step: int) -> str | None:
    """Name of the phase at a step; None if it is unknown or the map has no phases."""
    phase, labels = episode.phase, episode.phase_labels
    if phase is None or not 0 <= phase[step] < len(labels):
        return None
    return labels[int(phase[step])]


def checked_command(episode: Episode) -> npt.NDArray[np.int8]:
    """(T,) commanded state of the gripper, see `gripper.commanded`, if it can be trusted.

    Raises:
        Abstain: if the episode has fewer than two steps, or the command is missing, not finite,
            in contradiction to its declared meaning, or never closes.
    """
    if len(episode) < 2:
        raise Abstain(f"too short: the episode has {len(episode)} steps")
    try:
        if not np.isfinite(gripper.gripper_command(episode)).all():
            raise Abstain("the gripper's command has values that are not finite")
        inverted = gripper.contradiction(episode)
        if inverted is not None:
            raise Abstain(inverted)
        state = gripper.commanded(episode)
    except Abstain:
        raise
    except EpisodeError as err:
        raise Abstain(str(err).partition(": ")[2]) from None
    if not (state < 0).any():
        raise Abstain("the gripper was never commanded to close")
    return state
