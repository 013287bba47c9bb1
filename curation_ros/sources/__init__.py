"""Where episodes come from: one module per format, and the table of formats."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from curation_ros.core.errors import EpisodeError
from curation_ros.files import natural_order
from curation_ros.sources.mcap import McapSource
from curation_ros.sources.source import Source, stamp_of_files

#: Name -> source; the only list. Another format is one module here and one line.
SOURCES: dict[str, Source] = {
    "mcap": McapSource(),
}

__all__ = ["SOURCES", "Source", "episodes_at", "source_of", "stamp_of_files"]


def source_of(path: Path) -> Source:
    """The source that reads a path; for an unknown one the first, whose errors say what it is."""
    for source in SOURCES.values():
        if source.recognises(path):
            return source
    return next(iter(SOURCES.values()))


def episodes_at(path: Path, order: Callable[[Path], Any] = natural_order) -> list[Path]:
    """Paths of the episodes at a path, or in a folder of any formats.

    Args:
        path: an episode, a file of episodes, or a folder. In a folder, names that begin with a dot
            are skipped, and so is what no source recognises.
        order: sort key of the entries of a folder.

    Returns:
        The paths; none if there is no episode. A file that no source recognises is returned as it
        is, so that reading it says what it is.

    Raises:
        CurationError: if something cannot be listed.
    """
    for source in SOURCES.values():
        if source.recognises(path):
            return source.find(path)
    if path.is_file():
        return [path]
    try:
        entries = sorted(path.iterdir(), key=order) if path.is_dir() else []
    except OSError as err:
        raise EpisodeError(f"{path}: {err.strerror}", finding="unreadable") from err
    return [episode for entry in entries for episode in _recognised(entry)]


def _recognised(entry: Path) -> list[Path]:
    if not entry.name.startswith("."):
        for source in SOURCES.values():
            if source.recognises(entry):
                return source.find(entry)
    return []
