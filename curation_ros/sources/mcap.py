"""MCAP bags as a source of episodes: ours, those of rosbag2, and of other writers."""

from __future__ import annotations

from pathlib import Path

from curation_ros.bags import episode_of, is_bag, open_bag
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.sources.source import stamp_of_files


class McapSource:
    """One episode per bag; a bag is a folder or a single .mcap file."""

    name = "mcap"

    def recognises(self, path: Path) -> bool:
        """Whether a path is a bag."""
        return path.suffix == ".mcap" if path.is_file() else is_bag(path)

    def find(self, path: Path) -> list[Path]:
        """The bag itself."""
        return [path]

    def read(
        self, path: Path, topic_map: TopicMap | None = None, *, claimed_id: str = ""
    ) -> Episode:
        """Read the episode of a bag, equal to the live one; see `episode_of`."""
        return episode_of(open_bag(path), topic_map, claimed_id=claimed_id)

    def stamp(self, path: Path) -> str:
        """Sizes and times of the files of a bag."""
        return stamp_of_files(path)
