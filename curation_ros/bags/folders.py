"""Folders of bags: whether a folder is a bag, and which files make it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from curation_ros.core.errors import BagError
from curation_ros.files import natural_order


def is_bag(folder: Path) -> bool:
    """Whether a folder is one bag; a bag in SQLite is one, too, that cannot be read."""
    if not folder.is_dir():
        return False
    if (folder / "metadata.yaml").is_file() or any(folder.glob("*.db3")):
        return True
    files = list(folder.glob("*.mcap"))
    return len(files) == 1 or (bool(files) and _is_split(folder, files))


def listed_files(folder: Path, metadata: Mapping[str, Any]) -> tuple[Path, ...]:
    """The files that metadata.yaml names, in their order.

    Raises:
        BagError: if the bag is of another storage, compressed as a whole, or lacks a file.
    """
    storage = metadata.get("storage_identifier", "mcap")
    if storage not in ("mcap", ""):
        raise BagError(
            f"{folder}: storage {storage!r:.80} cannot be read, expected mcap; convert it with "
            "rosbags-convert or `ros2 bag convert`",
            finding="foreign-format",
        )
    if metadata.get("compression_mode"):
        raise BagError(
            f"{folder}: compression mode {metadata['compression_mode']!r:.80} cannot be read, "
            "expected MCAP's own compression of chunks; convert it with rosbags-convert",
            finding="unsupported-compression",
        )
    listed = metadata.get("relative_file_paths")
    if not isinstance(listed, list) or not listed:
        return found_files(folder)
    # Old versions name the folder of the bag, too. No name may point out of it.
    files = tuple(folder / Path(str(name)).name for name in listed)
    for file in files:
        if not file.is_file():
            raise BagError(
                f"{folder}: metadata.yaml names {file.name}, which is not there",
                finding="missing-file",
            )
    return files


def found_files(folder: Path) -> tuple[Path, ...]:
    """The files of a bag without metadata.yaml, in their order.

    Raises:
        BagError: if there is no MCAP file, or several that are not parts of one recording.
    """
    files = sorted(folder.glob("*.mcap"), key=natural_order)
    if len(files) == 1 or (files and _is_split(folder, files)):
        return tuple(files)
    if files:
        raise BagError(
            f"{folder} has {len(files)} .mcap files and no metadata.yaml: name one of them",
            finding="ambiguous",
        )
    for pattern, what, finding in (
        ("*.db3", "SQLite files (.db3)", "foreign-format"),
        ("*.zstd", "compressed files (.zstd)", "unsupported-compression"),
    ):
        if any(folder.glob(pattern)):
            raise BagError(
                f"{folder} has {what}, expected .mcap; convert it with rosbags-convert",
                finding=finding,
            )
    raise BagError(
        f"{folder} is no bag: it has neither metadata.yaml nor an .mcap file",
        finding="missing-file",
    )


def _is_split(folder: Path, files: Sequence[Path]) -> bool:
    """Whether files are the parts of one recording, as rosbag2 names them: <folder>_<number>."""
    stem = re.escape(folder.resolve().name)
    return all(re.fullmatch(rf"{stem}_\d+", file.stem) for file in files)
