"""The SQLite index of a dataset, or of any folder of bags: a cache shared by processes."""

from __future__ import annotations

import fcntl
import hashlib
import os
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cached_property
from pathlib import Path

from curation_ros.core.errors import CurationError

_SCHEMA = """
CREATE TABLE episodes (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, path TEXT NOT NULL, start_ns INTEGER NOT NULL,
    end_ns INTEGER NOT NULL, event TEXT NOT NULL, source TEXT NOT NULL,
    recovered INTEGER NOT NULL);
CREATE TABLE decisions (
    episode TEXT NOT NULL, revision INTEGER NOT NULL, verdict TEXT NOT NULL, reason TEXT NOT NULL,
    by TEXT NOT NULL, state_hash TEXT NOT NULL, span_start INTEGER NOT NULL,
    span_end INTEGER NOT NULL, content TEXT NOT NULL, PRIMARY KEY (episode, revision));
CREATE INDEX decisions_content ON decisions (content);
CREATE TABLE scores (
    episode TEXT NOT NULL, scorer TEXT NOT NULL, scoring_hash TEXT NOT NULL, value REAL,
    abstained TEXT, PRIMARY KEY (episode, scorer, scoring_hash));
CREATE TABLE selections (
    name TEXT PRIMARY KEY, path TEXT NOT NULL, created_at TEXT NOT NULL, kept INTEGER NOT NULL,
    total INTEGER NOT NULL);
CREATE TABLE examinations (
    bag TEXT NOT NULL, scoring_hash TEXT NOT NULL, stamp TEXT NOT NULL, result TEXT NOT NULL,
    PRIMARY KEY (bag, scoring_hash));
PRAGMA user_version = 2;
"""
_SCHEMA_VERSION = 2
TABLES = ("episodes", "decisions", "scores", "selections", "examinations")
_BUSY_TIMEOUT_S = 10.0

#: File systems on which processes cannot share the memory that SQLite's WAL needs.
_SHARED = {"9p", "beegfs", "ceph", "cifs", "fuse.sshfs", "gpfs", "lustre", "nfs", "nfs4", "smb3"}


class SpoiltIndexError(CurationError):
    """The index is no database, or one of another version of ours."""


class Index:
    """Where the index of a folder lives, and one transaction at a time on it."""

    def __init__(self, folder: Path, *, is_dataset: bool = True) -> None:
        """Name an index; it is made when it is first used.

        Args:
            folder: a dataset, or a folder of bags.
            is_dataset: whether the folder is ours to keep an index in.
        """
        self.folder = folder
        self._is_dataset = is_dataset

    @cached_property
    def elsewhere(self) -> str:
        """Why the index is not in the folder but in the user's cache; empty if it is there."""
        if not self._is_dataset:
            return "the folder is no dataset"
        kind = file_system(self.folder.resolve())
        if kind in _SHARED:
            return f"the dataset is on a network file system ({kind})"
        return "" if os.access(self.folder, os.W_OK) else "the dataset cannot be written"

    @property
    def path(self) -> Path:
        """Where the index lives."""
        if not self.elsewhere:
            return self.folder / "index.sqlite"
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        key = hashlib.sha256(str(self.folder.resolve()).encode()).hexdigest()[:16]
        return cache / "curation_ros" / f"index-{key}.sqlite"

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """One transaction, that makes the index where there is none.

        Raises:
            SpoiltIndexError: if it is no index of ours.
            CurationError: if it cannot be used now.
        """
        path = self.path
        try:
            if not path.exists():
                _create(path)
            with closing(sqlite3.connect(path, timeout=_BUSY_TIMEOUT_S)) as db:
                [version] = db.execute("PRAGMA user_version").fetchone()
                if version != _SCHEMA_VERSION:
                    raise sqlite3.DatabaseError(f"version {version}, not {_SCHEMA_VERSION}")
                db.execute("PRAGMA synchronous=NORMAL")  # a cache may lose its last lines
                with db:
                    yield db
        except (OSError, sqlite3.Error) as err:
            # The classes below DatabaseError are about a statement or the moment.
            kind = SpoiltIndexError if type(err) is sqlite3.DatabaseError else CurationError
            raise kind(f"index {path}: {err}; curation index --rebuild makes it anew") from err

    def remove(self) -> None:
        """Delete the file: only one that is of no use to anybody.

        Raises:
            CurationError: if it cannot be deleted.
        """
        try:
            self.path.unlink(missing_ok=True)
        except OSError as err:
            raise CurationError(f"{self.path}: {err.strerror}") from err


def _create(path: Path) -> None:
    """Make an empty index; it appears whole, so that nobody ever opens half of one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(f".{path.name}.new")
    with new.with_suffix(".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if path.exists():
            return
        # What an index that was deleted has left would be played into the new one.
        for left in (new, *(Path(f"{p}{end}") for p in (new, path) for end in ("-wal", "-shm"))):
            left.unlink(missing_ok=True)
        with closing(sqlite3.connect(new)) as db:
            db.execute("PRAGMA journal_mode=WAL")
            db.executescript(_SCHEMA)
        os.rename(new, path)


def file_system(path: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    """Kind of the file system that a path without links is on; empty where that is unknown.

    Args:
        path: absolute, without links.
        mounts: the system's table of mounts.
    """
    found, depth = "", 0
    try:
        lines = mounts.read_text(errors="surrogateescape").splitlines()
    except OSError:  # not Linux
        return ""
    for line in lines:
        _, point, kind, *_ = line.split(" ")
        at = Path(point.replace("\\040", " "))
        if len(at.parts) >= depth and path.is_relative_to(at):  # of one place, the last mount
            found, depth = kind, len(at.parts)
    return found
