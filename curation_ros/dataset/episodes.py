"""Reads the episodes of a dataset."""

from __future__ import annotations

from curation_ros.bags.reader import read_episode
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset


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
