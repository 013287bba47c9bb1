"""What a source of episodes is: one format of recordings, found on disk and read."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap


class Source(Protocol):
    """Finds and reads the episodes of one format. `curation_ros.testing.sources` checks one.

    Each episode has a path of its own, by which everything else refers to it. Where a file holds
    several episodes, their paths continue that of the file, such as `demos.npz/demo-3`. Such a
    path need not exist.

    A source reads what was recorded, and never a label. Success and injected defects belong to the
    truth of a dataset.

    Attributes:
        name: of the format, such as `mcap`.
    """

    name: str

    def recognises(self, path: Path) -> bool:
        """Whether a path is one episode, or one file or folder of episodes, in this format.

        Must not raise, and must be fast: it is called for every entry of a folder.
        """
        ...

    def find(self, path: Path) -> list[Path]:
        """The episodes at a path that is recognised, in the order of their recording.

        Returns:
            Their paths; for the path of an episode, that path alone.

        Raises:
            CurationError: if it cannot be listed.
        """
        ...

    def read(
        self, path: Path, topic_map: TopicMap | None = None, *, claimed_id: str = ""
    ) -> Episode:
        """Read one episode, with the faults of its recording as findings.

        Args:
            path: of the episode, as `find` returns it.
            topic_map: which fields to build; None: the map that comes with the recording.
            claimed_id: id that a dataset claims for the episode by the name of its folder. An
                episode with another id of its own has the finding `wrong-id`.

        Returns:
            The episode. Its id depends on the recording alone, and not on where it lies.

        Raises:
            CurationError: if it cannot be read, does not fit the map, or has no map and none is
                given; the message names the path.
        """
        ...

    def stamp(self, path: Path) -> str:
        """A text that changes when the recording of an episode changes, see `stamp_of_files`.

        Args:
            path: of the episode.

        Returns:
            The stamp; empty if there is none, so that nothing is kept about the episode.
        """
        ...


def stamp_of_files(path: Path) -> str:
    """Sizes and times of a file, or of the files in a folder; empty if they cannot be read."""
    try:
        if path.is_dir():
            with os.scandir(path) as entries:
                found = sorted((e.name, e.stat()) for e in entries if e.is_file())
        else:
            found = [(path.name, path.stat())]
    except OSError:
        return ""
    return ";".join(f"{name}:{s.st_size}:{s.st_mtime_ns}" for name, s in found)
