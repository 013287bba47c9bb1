"""Bags that are being written, or that recorders have left behind when they died."""

from __future__ import annotations

import os
from pathlib import Path

from curation_ros.core.errors import BagError
from curation_ros.dataset.layout import LOCK, PARTIAL
from curation_ros.files import FileLock, sync_folder, try_lock

#: End of the names of folders in which a partial bag is recovered.
RECOVERING = ".recovering"


class PartialBags:
    """The partial bags of a dataset, in a folder of their own until they are complete.

    Attributes:
        folder: where they are.
    """

    def __init__(self, episodes: Path) -> None:
        """Name them by the folder of the episodes; nothing is made."""
        self._episodes = episodes
        self.folder = episodes / PARTIAL

    def path(self, episode_id: str) -> Path:
        """Folder of an episode's partial bag, whether it exists or not."""
        return self.folder / episode_id

    def all(self) -> list[Path]:
        """Folders of the partial bags that exist, in the order of their ids."""
        found = (p for p in self.folder.glob("*") if p.is_dir() and p.suffix != RECOVERING)
        return sorted(found)

    def claim(self, episode_id: str) -> FileLock | None:
        """Claim an episode's partial bag until the lock is released.

        The lock lies beside the folder, because it must be taken before the folder is made.

        Returns:
            The lock; None while another recorder has it.

        Raises:
            OSError: if the lock cannot be opened.
        """
        return try_lock(self._lock_path(episode_id))

    def forget(self, episode_id: str) -> None:
        """Remove the lock's file of a partial bag that is gone; its claim must be held.

        Raises:
            OSError: if it cannot be removed.
        """
        self._lock_path(episode_id).unlink(missing_ok=True)

    def publish(self, episode_id: str) -> Path:
        """Move a complete bag to its final place, and return that.

        Raises:
            BagError: if it cannot be moved.
        """
        target = self._episodes / episode_id
        try:
            os.rename(self.path(episode_id), target)
            sync_folder(target.parent)
        except OSError as err:
            raise BagError(f"bag {target}: {err.strerror}") from err
        return target

    def _lock_path(self, episode_id: str) -> Path:
        return self.folder / f"{episode_id}{LOCK}"
