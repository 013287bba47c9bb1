"""Reads episodes: of bags, of folders of bags, and of datasets."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from curation_ros.bags import episode_of, is_bag, open_bag
from curation_ros.bags.folders import natural_order
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import BagError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.layout import EPISODES, hint_of_datasets, is_dataset


def find_bags(paths: Iterable[Path]) -> list[Path]:
    """Find the bags that a person means.

    Args:
        paths: .mcap files, bags, folders of bags or files, and datasets. Names that begin with a
            dot are skipped.

    Returns:
        Paths for `read_episode` in the order given, each once. Within a dataset they are in the
        order of the recording, within another folder in the order of their names.

    Raises:
        BagError: for a path that does not exist or has no bag in it.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        bags = _bags_in(path)
        if not bags:
            problem = f"{path} has no bag in it" if path.exists() else f"{path}: no such path"
            raise BagError(problem + hint_of_datasets(path), finding="missing-file")
        for bag in bags:
            found.setdefault(bag.resolve(), bag)
    return list(found.values())


def read_episode(path: Path, topic_map: TopicMap | None = None) -> Episode:
    """Read the episode at a path.

    Args:
        path: folder of a bag, or an .mcap file.
        topic_map: which fields to build; None: the map that is stored in the bag.

    Raises:
        BagError: if the bag cannot be read, does not fit the map, or has no map and none is given.
        ConfigError: if a path of the map does not exist in its type.
        EpisodeError: if the episode cannot be built.
    """
    return episode_of(open_bag(path), topic_map, claimed_id=claimed_id(path))


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


def _bags_in(path: Path) -> list[Path]:
    if path.is_file() or is_bag(path):
        return [path]
    try:
        if is_dataset(path):  # names are ids, whose plain order is that of the recording
            inside = sorted((path / EPISODES).iterdir())
        else:
            inside = sorted(path.iterdir(), key=natural_order) if path.is_dir() else []
    except OSError as err:
        raise BagError(f"{path}: {err.strerror}") from err
    return [
        entry
        for entry in inside
        if not entry.name.startswith(".")
        and (entry.suffix == ".mcap" if entry.is_file() else is_bag(entry))
    ]
