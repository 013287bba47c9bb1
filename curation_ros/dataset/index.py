"""The SQLite index of a dataset, or of any folder of bags: a cache that processes share."""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import astuple, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from curation_ros.core.decision.decision import Decision
from curation_ros.core.decision.examination import Examination
from curation_ros.core.errors import CurationError
from curation_ros.dataset.layout import INDEX, home_of, is_dataset
from curation_ros.files import exclusive

_SCHEMA_VERSION = 3
_EPISODES = """
CREATE TABLE episodes (
    id TEXT PRIMARY KEY, name TEXT NOT NULL, path TEXT NOT NULL, start_ns INTEGER NOT NULL,
    end_ns INTEGER NOT NULL, event TEXT NOT NULL, source TEXT NOT NULL,
    recovered INTEGER NOT NULL)
"""
_DECISIONS = """
CREATE TABLE decisions (
    episode TEXT NOT NULL, revision INTEGER NOT NULL, content TEXT NOT NULL,
    PRIMARY KEY (episode, revision))
"""
_DECISIONS_CONTENT = "CREATE INDEX decisions_content ON decisions (content)"
_EXAMINATIONS = """
CREATE TABLE examinations (
    bag TEXT NOT NULL, scoring_hash TEXT NOT NULL, stamp TEXT NOT NULL, result TEXT NOT NULL,
    PRIMARY KEY (bag, scoring_hash))
"""
_SET_VERSION = f"PRAGMA user_version = {_SCHEMA_VERSION}"
_SCHEMA = (_EPISODES, _DECISIONS, _DECISIONS_CONTENT, _EXAMINATIONS, _SET_VERSION)
#: What makes the present schema of an older one, by its version. Versions that are missing here
#: are made anew from the files of the dataset.
_UPGRADES: Mapping[int, Sequence[str]] = {
    # Nobody read the scores, the selections, and most of what was noted on a decision.
    2: (
        "DROP TABLE scores",
        "DROP TABLE selections",
        "DROP INDEX decisions_content",
        "ALTER TABLE decisions RENAME TO old_decisions",
        _DECISIONS,
        "INSERT INTO decisions SELECT episode, revision, content FROM old_decisions",
        "DROP TABLE old_decisions",
        _DECISIONS_CONTENT,
        _SET_VERSION,
    ),
}
_BUSY_TIMEOUT_S = 10.0
# SQLite's limit on parameters in one statement was 999 for long.
_MOST_PARAMETERS = 500

#: File systems on which processes cannot share the memory that SQLite's WAL needs.
_SHARED = {"9p", "beegfs", "ceph", "cifs", "fuse.sshfs", "gpfs", "lustre", "nfs", "nfs4", "smb3"}


class SpoiltIndexError(CurationError):
    """The file is no database, or an index of a version that cannot be upgraded."""


@dataclass(frozen=True)
class IndexedEpisode:
    """What the index has on an episode; the order of the fields is that of the columns.

    Attributes:
        id, name: identity of the episode.
        path: of its bag, from the dataset's folder.
        start_ns, end_ns: its first and last nanosecond.
        event: the last event of its owner, such as `ended`.
        source: whether it was recorded live or replayed.
        is_recovered: whether its bag was recovered after its recorder had died.
    """

    id: str
    name: str
    path: str
    start_ns: int
    end_ns: int
    event: str
    source: str
    is_recovered: bool

    @property
    def duration_ns(self) -> int:
        """Nanoseconds from start to end."""
        return self.end_ns - self.start_ns


class Index:
    """The index of a folder: where its file is, and what can be read and written in it.

    Each method is one transaction, and makes the file where there is none. Each raises
    SpoiltIndexError if the file is no index of ours, and CurationError if it cannot be used now.
    """

    def __init__(self, folder: Path, *, is_dataset: bool = True) -> None:
        """Name an index; its file is made by the first transaction.

        Args:
            folder: a dataset, or a folder of bags.
            is_dataset: whether the folder is a dataset, which has its index inside.
        """
        self.folder = folder
        self._is_dataset = is_dataset

    @classmethod
    def covering(cls, bag: Path) -> Index:
        """The index that covers a bag, of its dataset or of the folder around it."""
        folder, _ = home_of(bag)
        return cls(folder, is_dataset=is_dataset(folder))

    @cached_property
    def elsewhere(self) -> str:
        """Why the index is in the user's cache and not in the folder; empty if it is there."""
        if not self._is_dataset:
            return "the folder is no dataset"
        kind = file_system(self.folder.resolve())
        if kind in _SHARED:
            return f"the dataset is on a network file system ({kind})"
        return "" if os.access(self.folder, os.W_OK) else "the dataset cannot be written"

    @property
    def path(self) -> Path:
        """Where the file is."""
        if not self.elsewhere:
            return self.folder / INDEX
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        key = hashlib.sha256(str(self.folder.resolve()).encode()).hexdigest()[:16]
        return cache / "curation_ros" / f"index-{key}.sqlite"

    # --- episodes ---------------------------------------------------------------------------

    def episodes(self) -> list[IndexedEpisode]:
        """All episodes that are indexed, in the order of their ids."""
        with self._transaction() as db:
            return [_episode(row) for row in db.execute("SELECT * FROM episodes ORDER BY id")]

    def episode(self, episode_id: str) -> IndexedEpisode | None:
        """One episode; None if it is not indexed."""
        with self._transaction() as db:
            row = db.execute("SELECT * FROM episodes WHERE id = ?", (episode_id,)).fetchone()
        return _episode(row) if row is not None else None

    def update_episodes(self, new: Iterable[IndexedEpisode], gone: Iterable[str]) -> None:
        """Add episodes, and remove others by their ids."""
        with self._transaction() as db:
            db.executemany("DELETE FROM episodes WHERE id = ?", [(i,) for i in gone])
            _insert_episodes(db, new)

    # --- decisions --------------------------------------------------------------------------

    def note_decision(self, decision: Decision) -> None:
        """Note the content that a decision was made on."""
        with self._transaction() as db:
            _insert_decisions(db, [decision])

    def decided_with_content(self, content: str, *, before: str) -> tuple[str, str] | None:
        """The first decided episode with some content; ids are in the order of recording.

        Args:
            content: `Episode.content_digest`.
            before: only episodes with lower ids are looked at.

        Returns:
            Id and name of the episode; None if there is none.
        """
        query = (
            "SELECT d.episode, coalesce(e.name, '') FROM decisions d "
            "LEFT JOIN episodes e ON e.id = d.episode "
            "WHERE d.content = ? AND d.episode < ? ORDER BY d.episode LIMIT 1"
        )
        with self._transaction() as db:
            row = db.execute(query, (content, before)).fetchone()
        return (str(row[0]), str(row[1])) if row is not None else None

    # --- examinations -----------------------------------------------------------------------

    def examinations(self, key: str, stamps: Mapping[Path, str]) -> dict[Path, Examination]:
        """Examinations of bags that have not changed since.

        Args:
            key: under which they were kept.
            stamps: bag -> its change stamp now; an empty stamp fits none.

        Returns:
            Bag -> examination; bags without one are absent.
        """
        if not self.path.exists():
            return {}
        bags = {home_of(bag)[1]: bag for bag in stamps}
        names = list(bags)
        rows: list[tuple[str, str, str]] = []
        with self._transaction() as db:
            for k in range(0, len(names), _MOST_PARAMETERS):
                some = names[k : k + _MOST_PARAMETERS]
                query = (
                    "SELECT bag, stamp, result FROM examinations "
                    f"WHERE scoring_hash = ? AND bag IN ({','.join('?' * len(some))})"
                )
                rows += db.execute(query, (key, *some)).fetchall()
        found = {}
        for name, stamp, text in rows:
            if stamp and stamp == stamps[bags[name]]:
                with suppress(CurationError, ValueError):
                    found[bags[name]] = Examination.from_json(json.loads(text))
        return found

    def keep_examinations(
        self, key: str, found: Mapping[Path, Examination], stamps: Mapping[Path, str]
    ) -> None:
        """Keep examinations for the next time.

        Args:
            key: hash of all that they depend on except the bag.
            found: bag -> examination.
            stamps: bag -> its change stamp before it was read.
        """
        rows = [
            (home_of(bag)[1], key, stamps[bag], json.dumps(e.to_json(), allow_nan=False))
            for bag, e in found.items()
        ]
        with self._transaction() as db:
            db.executemany("INSERT OR REPLACE INTO examinations VALUES (?,?,?,?)", rows)

    # --- the file ---------------------------------------------------------------------------

    def refill(self, episodes: Iterable[IndexedEpisode], decisions: Iterable[Decision]) -> None:
        """Replace all that the index has; a file that is of no use is replaced as a whole."""
        episodes, decisions = list(episodes), list(decisions)
        try:
            self._refill(episodes, decisions)
        except SpoiltIndexError:
            # Only a file that is of no use to anybody is removed from under other processes.
            self._remove()
            self._refill(episodes, decisions)

    def _refill(
        self, episodes: Collection[IndexedEpisode], decisions: Collection[Decision]
    ) -> None:
        with self._transaction() as db:
            for table in ("episodes", "decisions", "examinations"):
                db.execute(f"DELETE FROM {table}")
            _insert_episodes(db, episodes)
            _insert_decisions(db, decisions)

    def _remove(self) -> None:
        try:
            self.path.unlink(missing_ok=True)
        except OSError as err:
            raise CurationError(f"{self.path}: {err.strerror}") from err

    @contextmanager
    def _transaction(self) -> Iterator[sqlite3.Connection]:
        path = self.path
        try:
            if not path.exists():
                _create(path)
            with closing(sqlite3.connect(path, timeout=_BUSY_TIMEOUT_S)) as db:
                if _version(db) != _SCHEMA_VERSION:
                    _upgrade(db)
                db.execute("PRAGMA synchronous=NORMAL")  # a cache may lose its last lines
                with db:
                    yield db
        except (OSError, sqlite3.Error) as err:
            # The classes below DatabaseError are about a statement or the moment.
            kind = SpoiltIndexError if type(err) is sqlite3.DatabaseError else CurationError
            raise kind(f"index {path}: {err}; curation index --rebuild makes it anew") from err


def _episode(row: Sequence[Any]) -> IndexedEpisode:
    episode_id, name, path, start_ns, end_ns, event, source, recovered = row
    return IndexedEpisode(
        episode_id, name, path, start_ns, end_ns, event, source, is_recovered=bool(recovered)
    )


def _insert_episodes(db: sqlite3.Connection, episodes: Iterable[IndexedEpisode]) -> None:
    rows = [astuple(e) for e in episodes]
    db.executemany("INSERT OR REPLACE INTO episodes VALUES (?,?,?,?,?,?,?,?)", rows)


def _insert_decisions(db: sqlite3.Connection, decisions: Iterable[Decision]) -> None:
    rows = [(d.episode, d.revision, str(d.evidence.get("content", ""))) for d in decisions]
    db.executemany("INSERT OR REPLACE INTO decisions VALUES (?,?,?)", rows)


def _version(db: sqlite3.Connection) -> int:
    [version] = db.execute("PRAGMA user_version").fetchone()
    return int(version)


def _upgrade(db: sqlite3.Connection) -> None:
    """Bring an older index to the present schema; the others that use the file may go on."""
    db.isolation_level = None  # transactions are ours: this one holds statements on the schema
    db.execute("BEGIN IMMEDIATE")
    version = _version(db)
    if version != _SCHEMA_VERSION:  # no other process has been faster
        if version not in _UPGRADES:
            raise sqlite3.DatabaseError(f"version {version}, not {_SCHEMA_VERSION}")
        for statement in _UPGRADES[version]:
            db.execute(statement)
    db.execute("COMMIT")
    db.isolation_level = "DEFERRED"


def _create(path: Path) -> None:
    """Make an empty index; it appears whole, so that no process opens half of one."""
    new = path.with_name(f".{path.name}.new")
    with exclusive(new.with_suffix(".lock")):
        if path.exists():
            return
        # SQLite would play the remains of a deleted index into the new one.
        for left in (new, *(Path(f"{p}{end}") for p in (new, path) for end in ("-wal", "-shm"))):
            left.unlink(missing_ok=True)
        with closing(sqlite3.connect(new)) as db:
            db.execute("PRAGMA journal_mode=WAL")
            for statement in _SCHEMA:
                db.execute(statement)
            db.commit()
        os.rename(new, path)


def file_system(path: Path, mounts: Path = Path("/proc/self/mounts")) -> str:
    """Kind of the file system that holds a path; empty where that is unknown.

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
        if len(at.parts) >= depth and path.is_relative_to(at):  # the last mount at a place counts
            found, depth = kind, len(at.parts)
    return found
