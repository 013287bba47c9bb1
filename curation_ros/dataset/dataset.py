"""A dataset on disk: bags, decision logs, truth, manifests, and an SQLite index made from them.

The files are the truth; the index is a cache that `rebuild` makes again from them. Who writes
what: the recorder `episodes/`, the curator and the command line `decisions/`, the sim node (or
the recording person) `truth.jsonl`.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from curation_ros.bags.reader import Bag, episode_of, hint_of_datasets, open_bag
from curation_ros.core.decision.decision import Decision, in_force
from curation_ros.core.decision.manifest import Manifest
from curation_ros.core.decision.ties import TieKey, tie_key
from curation_ros.core.episode.identity import resolve_prefix
from curation_ros.core.errors import BagError, CurationError, EpisodeError
from curation_ros.dataset.index import TABLES, Index, SpoiltIndexError
from curation_ros.files import (
    append_line,
    locked,
    named_errors,
    read_lines,
    sync_folder,
    write_atomically,
)


class Dataset:
    """A dataset folder; every method may be called by several processes at once."""

    def __init__(self, path: Path | str, *, create: bool = False) -> None:
        """Open a dataset.

        Args:
            path: its folder.
            create: make the folder where it does not exist.

        Raises:
            CurationError: if it is no folder, or cannot be made.
        """
        self.path = Path(path)
        if create:
            try:
                (self.path / "episodes" / ".partial").mkdir(parents=True, exist_ok=True)
            except OSError as err:
                raise CurationError(f"dataset {self.path}: {err.strerror}") from err
        elif not (self.path / "episodes").is_dir():
            hint = hint_of_datasets(self.path)
            raise CurationError(f"dataset {self.path}: no folder 'episodes' in it{hint}")

    # --- bags -------------------------------------------------------------------------------

    def bag_path(self, episode_id: str) -> Path:
        """Folder of an episode's bag, whether it exists or not."""
        return self.path / "episodes" / episode_id

    def partial_path(self, episode_id: str) -> Path:
        """Folder that a recorder claims, by exclusive creation, while it writes."""
        return self.path / "episodes" / ".partial" / episode_id

    def publish_bag(self, episode_id: str) -> Path:
        """Move a finished bag out of `.partial`.

        Raises:
            BagError: if it cannot be moved.
        """
        target = self.bag_path(episode_id)
        try:
            os.rename(self.partial_path(episode_id), target)
            sync_folder(target.parent)
        except OSError as err:
            raise BagError(f"bag {target}: {err.strerror}") from err
        return target

    def bags(self) -> Iterator[Path]:
        """Folders of the bags, in the order of their ids (which is the order of recording)."""
        episodes = self.path / "episodes"
        return iter(sorted(p for p in episodes.iterdir() if p.is_dir() and p.name[0] != "."))

    def names(self) -> list[tuple[str, str]]:
        """(id, short name) of every episode, from bags and decision logs."""
        self.refresh()
        with self.index.transaction() as db:
            named = dict(db.execute("SELECT id, name FROM episodes"))
        for log in (self.path / "decisions").glob("*.jsonl"):
            lines = read_lines(log)
            named.setdefault(log.stem, str(lines[-1].get("name", "")) if lines else "")
        return sorted(named.items())

    def find(self, prefix: str) -> str:
        """Id of the episode that a person means by a short name or the beginning of an id.

        Raises:
            EpisodeError: if nothing or more than one episode fits.
        """
        return resolve_prefix(prefix, self.names())

    # --- decisions --------------------------------------------------------------------------

    def decision_log(self, episode_id: str) -> Path:
        """Log of an episode's decisions."""
        return self.path / "decisions" / f"{episode_id}.jsonl"

    def decisions(self, episode_id: str) -> list[Decision]:
        """All decisions on an episode, oldest first.

        Raises:
            CurationError: naming the log, if it cannot be read or a whole line is no decision.
        """
        log = self.decision_log(episode_id)
        try:
            return [Decision.from_json(line) for line in read_lines(log)]
        except EpisodeError as err:
            raise EpisodeError(f"{log}: {err}") from err

    def latest_decisions(self, last: int | None = None) -> dict[str, Decision]:
        """The decision in force of every decided episode, by id and in the order of ids.

        Args:
            last: of so many episodes, those with the highest (youngest) ids; None: of all.
        """
        logs = sorted((self.path / "decisions").glob("*.jsonl"))[-(last or 0) :]
        return in_force(d for log in logs for d in self.decisions(log.stem))

    def start_of(self) -> dict[str, tuple[str, str, int]]:
        """Episode id -> (task, start state, repetition), where they were noted; no labels."""
        return {
            i: (str(t.get("task", "")), str(t["start"]), int(t.get("repetition", 0)))
            for i, t in self.truth().items()
            if "start" in t
        }

    def tie(self, seed: int) -> TieKey:
        """Episode id -> key that orders equal scores: a hash of its start, where that is noted."""
        starts = self.start_of()

        def key(episode_id: str) -> str:
            return tie_key(seed, *starts.get(episode_id, (episode_id,)))

        return key

    def append_decision(
        self,
        decision: Decision,
        *,
        amend: bool = False,
        unless: Callable[[Sequence[Decision]], bool] | None = None,
    ) -> Decision | None:
        """Log a decision under the next revision number, on disk when this returns.

        Args:
            decision: its own revision number counts only to amend.
            amend: log it under its own number (the same decision with more evidence).
            unless: is shown what is logged already; where it says so, nothing is added.

        Returns:
            The decision with the revision that it got; None if it was not wanted any more.

        Raises:
            CurationError: if the log cannot be written.
        """
        log = self.decision_log(decision.episode)
        # The lock makes numbering and appending one step when curator and CLI decide at once.
        with named_errors(log), locked(log.parent):
            known = self.decisions(decision.episode)
            if unless is not None and unless(known):
                return None
            if not amend:
                revisions = [d.revision for d in known]
                decision = replace(decision, revision=max(revisions, default=0) + 1)
            append_line(log, decision.to_json())
        with suppress(CurationError), self.index.transaction() as db:
            _index_decision(db, decision)
        return decision

    def with_content(self, content: str, *, other_than: str) -> tuple[str, str] | None:
        """An older episode (id, name) that was decided on and has the same content, if any.

        Args:
            content: `Episode.content_digest`.
            other_than: id of the episode that is asked for; older ones have lower ids.
        """
        query = (
            "SELECT d.episode, coalesce(e.name, '') FROM decisions d "
            "LEFT JOIN episodes e ON e.id = d.episode "
            "WHERE d.content = ? AND d.episode < ? ORDER BY d.episode LIMIT 1"
        )
        try:
            with self.index.transaction() as db:
                row = db.execute(query, (content, other_than)).fetchone()
        except CurationError:  # a cache that cannot be used now costs no decision
            return None
        return (str(row[0]), str(row[1])) if row is not None else None

    # --- truth and selections ---------------------------------------------------------------

    def append_truth(self, record: Mapping[str, Any]) -> None:
        """Append a line to truth.jsonl: outcomes and injected defects, for evaluation only.

        Raises:
            CurationError: if it cannot be written.
        """
        path = self.path / "truth.jsonl"
        with named_errors(path):
            append_line(path, record)

    def truth(self) -> dict[str, dict[str, Any]]:
        """Merged truth lines by episode id; later lines win."""
        merged: dict[str, dict[str, Any]] = {}
        for line in read_lines(self.path / "truth.jsonl"):
            merged.setdefault(str(line.get("episode")), {}).update(line)
        return merged

    def save_manifest(self, manifest: Manifest) -> Path:
        """Write a selection; the name decides the file, and a file is never overwritten.

        Raises:
            CurationError: if a selection of that name exists, or it cannot be written.
        """
        path = self.path / "selections" / f"{manifest.name}.json"
        text = json.dumps(manifest.to_json(), indent=1, allow_nan=False) + "\n"
        with named_errors(path), locked(path.parent):
            if path.exists():
                raise CurationError(f"selection {path} exists: choose another --name")
            write_atomically(path, text)
        with suppress(CurationError), self.index.transaction() as db:
            _index_selection(db, manifest, path)
        return path

    # --- index ------------------------------------------------------------------------------

    @cached_property
    def index(self) -> Index:
        """Its index: a cache made from its files."""
        return Index(self.path)

    def refresh(self) -> list[str]:
        """Bring the index up to date with bags that have come or gone.

        Returns:
            One line for every bag that could not be read; the others are indexed all the same.
        """
        present = {p.name: p for p in self.bags()}
        try:
            with self.index.transaction() as db:
                known = {row[0] for row in db.execute("SELECT id FROM episodes")}
        except SpoiltIndexError:
            return self.rebuild()
        rows, problems = _bag_rows({i: present[i] for i in sorted(set(present) - known)})
        gone = [(i,) for i in known - set(present)]
        if rows or gone:
            with self.index.transaction() as db:
                db.executemany("DELETE FROM episodes WHERE id = ?", gone)
                db.executemany(_INSERT_EPISODE, rows)
        return problems

    def rebuild(self) -> list[str]:
        """Make the index anew from bags, logs and manifests; returns what was unreadable."""
        rows, problems = _bag_rows({p.name: p for p in self.bags()})
        decisions: list[Decision] = []
        for log in sorted((self.path / "decisions").glob("*.jsonl")):
            try:
                decisions += self.decisions(log.stem)
            except CurationError as err:
                problems.append(str(err))
        manifests: list[tuple[Manifest, Path]] = []
        for path in sorted((self.path / "selections").glob("*.json")):
            try:
                manifests.append((Manifest.from_json(json.loads(path.read_text())), path))
            except (ValueError, OSError, CurationError) as err:
                problems.append(f"selection {path}: {err}")

        def fill() -> None:
            with self.index.transaction() as db:
                for table in TABLES:
                    db.execute(f"DELETE FROM {table}")
                db.executemany(_INSERT_EPISODE, rows)
                for decision in decisions:
                    _index_decision(db, decision)
                for manifest, path in manifests:
                    _index_selection(db, manifest, path)

        try:
            fill()
        except SpoiltIndexError:
            # Only a file that is of no use to anybody is removed from under other processes.
            self.index.remove()
            fill()
        return problems

    def rows(self, query: str, parameters: tuple[object, ...] = ()) -> list[sqlite3.Row]:
        """Read from the index (its tables stand in index.py).

        Raises:
            CurationError: if it is spoilt, or the query makes no sense.
        """
        with self.index.transaction() as db:
            db.row_factory = sqlite3.Row
            return list(db.execute(query, parameters))


_INSERT_EPISODE = "INSERT OR REPLACE INTO episodes VALUES (?,?,?,?,?,?,?,?)"


def _bag_rows(folders: Mapping[str, Path]) -> tuple[list[tuple[object, ...]], list[str]]:
    """Rows of the table episodes, and what is wrong with the bags that have none."""
    rows, problems = [], []
    for episode_id, folder in folders.items():
        try:
            rows.append(_bag_row(open_bag(folder), episode_id))
        except CurationError as err:
            problems.append(str(err))
    return rows, problems


def _bag_row(bag: Bag, episode_id: str) -> tuple[object, ...]:
    event = bag.event()
    if event is None:
        raise EpisodeError(f"bag {bag.path}: no 'episode' in its custom data: not of our recorder")
    end_ns = event.end_ns
    if end_ns is None:  # the recorder died before it was said
        with suppress(CurationError):
            end_ns = int(episode_of(bag).stamps_ns[-1])
    return (
        episode_id,
        event.name,
        f"episodes/{episode_id}",
        event.start_ns,
        end_ns or event.start_ns,
        event.event,
        event.source,
        int(bag.custom_data.get("recovered") == "true"),
    )


def _index_decision(db: sqlite3.Connection, d: Decision) -> None:
    db.execute(
        "INSERT OR REPLACE INTO decisions VALUES (?,?,?,?,?,?,?,?,?)",
        (
            d.episode,
            d.revision,
            d.verdict,
            d.reason,
            d.by,
            d.state_hash,
            *d.span,
            str(d.evidence.get("content", "")),
        ),
    )
    scoring = str(d.evidence.get("scoring", ""))
    db.executemany(
        "INSERT OR REPLACE INTO scores VALUES (?,?,?,?,?)",
        [
            (d.episode, scorer, scoring, value, d.abstained.get(scorer))
            for scorer, value in d.scores.items()
        ],
    )


def _index_selection(db: sqlite3.Connection, manifest: Manifest, path: Path) -> None:
    db.execute(
        "INSERT OR REPLACE INTO selections VALUES (?,?,?,?,?)",
        (manifest.name, str(path), manifest.created_at, len(manifest.entries), manifest.kept_of),
    )
