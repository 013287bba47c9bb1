"""Finds and reads episodes: of any source, in datasets and elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from operator import attrgetter
from pathlib import Path

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.layout import EPISODES, hint_of_datasets, is_dataset
from curation_ros.sources import episodes_at, source_of


def find_episodes(paths: Iterable[Path]) -> list[Path]:
    """Find the episodes at the paths that a person names.

    Args:
        paths: episodes, files or folders of episodes, and datasets. Names that begin with a dot
            are skipped.

    Returns:
        Paths for `read_episode` in the order given, each once. Within a dataset they are in the
        order of the recording, within another folder in the order of their names.

    Raises:
        EpisodeError: for a path that does not exist or has no episode in it.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        if is_dataset(path):  # names are ids, whose plain order is that of the recording
            inside = episodes_at(path / EPISODES, order=attrgetter("name"))
        else:
            inside = episodes_at(path)
        if not inside:
            problem = f"{path} has no episode in it" if path.exists() else f"{path}: no such path"
            raise EpisodeError(problem + hint_of_datasets(path), finding="missing-file")
        for episode in inside:
            found.setdefault(episode.resolve(), episode)
    return list(found.values())


def read_episode(path: Path, topic_map: TopicMap | None = None) -> Episode:
    """Read the episode at a path, of any source.

    Args:
        path: of the episode, such as the folder of a bag.
        topic_map: which fields to build; None: the map that comes with the recording.

    Raises:
        CurationError: if the episode cannot be read, does not fit the map, or has no map and none
            is given.
    """
    return source_of(path).read(path, topic_map, claimed_id=claimed_id(path))


def stamp_of(path: Path) -> str:
    """A text that changes when the recording of an episode changes; empty if there is none."""
    return source_of(path).stamp(path)


def read_episodes(
    dataset: Dataset, topic_map: TopicMap | None = None
) -> tuple[list[Episode], list[str]]:
    """Read all episodes of a dataset.

    Args:
        dataset: holds the bags.
        topic_map: how the episodes are built; by default the map in each bag.

    Returns:
        The episodes in the order of their ids, and a line about each bag that cannot be read.
    """
    episodes, problems = [], []
    for bag in dataset.bags():
        try:
            episodes.append(read_episode(bag, topic_map))
        except CurationError as err:
            problems.append(str(err))
    return sorted(episodes, key=lambda e: e.id), problems


def read_all_episodes(dataset: Dataset, what: str) -> list[Episode]:
    """Read all episodes of a dataset that must be whole.

    Args:
        dataset: holds the bags.
        what: name of the dataset for the error.

    Returns:
        The episodes in the order of their ids.

    Raises:
        CurationError: if a bag cannot be read.
    """
    episodes, problems = read_episodes(dataset)
    if problems:
        raise CurationError(f"{what}: {'; '.join(problems)}")
    return episodes


def claimed_id(path: Path) -> str:
    """The id that a dataset claims for a bag by the name of its folder; empty outside of one."""
    bag = path.resolve()
    return bag.name if bag.parent.name == EPISODES else ""
