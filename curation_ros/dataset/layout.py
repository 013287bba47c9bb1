"""Names of the folders and files in a dataset; no other package spells them."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

EPISODES = "episodes"
PARTIAL = ".partial"
COLLECTING = ".collecting"
DECISIONS = "decisions"
TRUTH = "truth.jsonl"
SELECTIONS = "selections"
POLICIES = "policies"
QUARANTINE = "quarantine"
INDEX = "index.sqlite"
#: The lock of a folder, in the folder; a claimed partial bag has a lock beside it, `<id>.lock`.
LOCK = ".lock"
_MOST_HINTS = 3


def is_dataset(folder: Path) -> bool:
    """Whether a folder is a dataset; every dataset has a folder of episodes."""
    return (folder / EPISODES).is_dir()


def home_of(bag: Path) -> tuple[Path, str]:
    """The folder whose index covers a bag, and the name of the bag in that index.

    Returns:
        The dataset that has the bag; for a bag outside of datasets, the folder around it.
    """
    folder = bag.resolve().parent
    name = os.fsencode(bag.name).decode(errors="backslashreplace")  # SQLite takes only UTF-8
    if folder.name == EPISODES:
        return folder.parent, f"{EPISODES}/{name}"
    return folder, name


def hint_of_datasets(folder: Path) -> str:
    """`: did you mean DATASET?` if there are datasets in a folder that is none; else empty."""
    with suppress(OSError):
        inside = sorted(entry for entry in folder.iterdir() if is_dataset(entry))
        if inside:
            return f": did you mean {' or '.join(map(str, inside[:_MOST_HINTS]))}?"
    return ""
