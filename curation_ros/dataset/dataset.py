"""A dataset on disk: bags, decision logs, truth, manifests, and an SQLite index made from them.

The files are the truth, and the index is a cache that `rebuild` makes again from them. The
recorder writes `episodes/`, the curator and the command line write `decisions/`, and the sim node
or the recording person writes `truth.jsonl`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

from curation_ros.bags import Bag, episode_of, open_bag
from curation_ros.core.decision.decision import Decision, in_force
from curation_ros.core.decision.manifest import Manifest
from curation_ros.core.decision.ties import TieKey, tie_key
from curation_ros.core.episode.identity import resolve_prefix
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset import layout
from curation_ros.dataset.index import Index, IndexedEpisode, SpoiltIndexError
from curation_ros.dataset.layout import hint_of_datasets
from curation_ros.dataset.partials import PartialBags
from curation_ros.dataset.truth import TruthLog
from curation_ros.files import (
    append_line,
    exclusive,
    named_errors,
    read_lines,
    try_lock,
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
                self.partials.folder.mkdir(parents=True, exist_ok=True)
            except OSError as err:
                raise CurationError(f"dataset {self.path}: {err.strerror}") from err
        elif not layout.is_dataset(self.path):
            hint = hint_of_datasets(self.path)
            raise CurationError(f"dataset {self.path}: no folder {layout.EPISODES!r} in it{hint}")

    # --- bags -------------------------------------------------------------------------------

    @property
    def episodes_folder(self) -> Path:
        """Folder of the bags."""
        return self.path / layout.EPISODES

    def bag_path(self, episode_id: str) -> Path:
        """Folder of an episode's bag, whether it exists or not."""
        return self.episodes_folder / episode_id

    def bags(self) -> Iterator[Path]:
        """Folders of the bags, in the order of their ids (which is the order of recording)."""
        entries = self.episodes_folder.iterdir()
        return iter(sorted(p for p in entries if p.is_dir() and p.name[0] != "."))

    @cached_property
    def partials(self) -> PartialBags:
        """Bags that are being written, and those that dead recorders have left."""
        return PartialBags(self.episodes_folder)

    def quarantine(self, bag: Path, suffix: str) -> None:
        """Move a bag to `quarantine/<its name>.<suffix>`; an OSError says why it cannot be."""
        target = self.path / layout.QUARANTINE / f"{bag.name}.{suffix}"
        target.parent.mkdir(exist_ok=True)
        bag.rename(target)

    @contextmanager
    def sole_collection(self) -> Iterator[None]:
        """Keep out other collections, which would collect the same episodes.

        Raises:
            CurationError: if another collection is running, or the dataset cannot be written.
        """
        path = self.episodes_folder / layout.COLLECTING
        with named_errors(path):
            lock = try_lock(path)
        if lock is None:
            raise CurationError(f"dataset {self.path}: another collection is running")
        with lock:
            yield

    # --- episodes ---------------------------------------------------------------------------

    def names(self) -> list[tuple[str, str]]:
        """(id, short name) of every episode, from bags and decision logs."""
        self.refresh()
        named = {e.id: e.name for e in self.index.episodes()}
        for episode_id in self.decided_ids():
            if episode_id not in named:
                lines = read_lines(self.decision_log(episode_id))
                named[episode_id] = str(lines[-1].get("name", "")) if lines else ""
        return sorted(named.items())

    def find(self, prefix: str) -> str:
        """Id of the episode with a short name, or with an id that begins with the prefix.

        Raises:
            EpisodeError: if nothing or more than one episode fits.
        """
        return resolve_prefix(prefix, self.names())

    # --- decisions --------------------------------------------------------------------------

    @property
    def decisions_folder(self) -> Path:
        """Folder of the decision logs; it may not exist yet."""
        return self.path / layout.DECISIONS

    def decision_log(self, episode_id: str) -> Path:
        """Log of an episode's decisions."""
        return self.decisions_folder / f"{episode_id}.jsonl"

    def decided_ids(self) -> list[str]:
        """Ids of the episodes that have a decision log, in order."""
        return sorted(log.stem for log in self.decisions_folder.glob("*.jsonl"))

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
            last: only the episodes with the highest (youngest) ids, this many; None: all.
        """
        ids = self.decided_ids()[-(last or 0) :]
        return in_force(d for i in ids for d in self.decisions(i))

    def append_decision(
        self,
        decision: Decision,
        *,
        amend: bool = False,
        unless: Callable[[Sequence[Decision]], bool] | None = None,
    ) -> Decision | None:
        """Log a decision under the next revision number; it is on the disk on return.

        Args:
            decision: its own revision number counts only to amend.
            amend: log it under its own number (the same decision with more evidence).
            unless: called with what is logged already; if it returns true, nothing is added.

        Returns:
            The decision with its revision; None if nothing was added.

        Raises:
            CurationError: if the log cannot be written.
        """
        log = self.decision_log(decision.episode)
        # The lock makes numbering and appending one step when curator and CLI decide at once.
        with named_errors(log), exclusive(log.parent / layout.LOCK):
            known = self.decisions(decision.episode)
            if unless is not None and unless(known):
                return None
            if not amend:
                revisions = [d.revision for d in known]
                decision = replace(decision, revision=max(revisions, default=0) + 1)
            append_line(log, decision.to_json())
        with suppress(CurationError):  # a cache that cannot be used now costs no decision
            self.index.note_decision(decision)
        return decision

    def with_content(self, content: str, *, other_than: str) -> tuple[str, str] | None:
        """An older episode (id, name) that was decided on and has the same content, if any.

        Args:
            content: `Episode.content_digest`.
            other_than: id of the episode with that content; older ones have lower ids.
        """
        try:
            return self.index.decided_with_content(content, before=other_than)
        except CurationError:  # a cache that cannot be used now costs no decision
            return None

    # --- truth ------------------------------------------------------------------------------

    @cached_property
    def truth_log(self) -> TruthLog:
        """The log of outcomes and injected defects."""
        return TruthLog(self.path / layout.TRUTH)

    def append_truth(self, record: Mapping[str, Any]) -> None:
        """Append a line to the truth; see `TruthLog.append`."""
        self.truth_log.append(record)

    def truth(self) -> dict[str, dict[str, Any]]:
        """Merged truth by episode id; see `TruthLog.by_episode`."""
        return self.truth_log.by_episode()

    def tie(self, seed: int) -> TieKey:
        """Episode id -> key that orders equal scores: a hash of its start, where that is noted."""
        starts = self.truth_log.starts()

        def key(episode_id: str) -> str:
            return tie_key(seed, *starts.get(episode_id, (episode_id,)))

        return key

    # --- selections and policies ------------------------------------------------------------

    def selection_path(self, name: str) -> Path:
        """File of a selection, whether it exists or not."""
        return self.path / layout.SELECTIONS / f"{name}.json"

    def save_manifest(self, manifest: Manifest) -> Path:
        """Write a selection; the name decides the file, and a file is never overwritten.

        Raises:
            CurationError: if a selection of that name exists, or it cannot be written.
        """
        path = self.selection_path(manifest.name)
        text = json.dumps(manifest.to_json(), indent=1, allow_nan=False) + "\n"
        with named_errors(path):
            try:
                write_atomically(path, text, replace=False)
            except FileExistsError as err:
                raise CurationError(f"selection {path} exists: choose another --name") from err
        return path

    def policy_path(self, policy_id: str) -> Path:
        """Folder of a policy that was trained on this dataset, whether it exists or not."""
        return self.path / layout.POLICIES / policy_id

    # --- index ------------------------------------------------------------------------------

    @cached_property
    def index(self) -> Index:
        """Its index: a cache made from its files."""
        return Index(self.path)

    def refresh(self) -> list[str]:
        """Add new bags to the index and remove lost ones; returns what was unreadable."""
        present = {p.name: p for p in self.bags()}
        try:
            known = {e.id for e in self.index.episodes()}
        except SpoiltIndexError:
            return self.rebuild()
        new, problems = _indexed({i: present[i] for i in sorted(set(present) - known)})
        gone = known - set(present)
        if new or gone:
            self.index.update_episodes(new, gone)
        return problems

    def rebuild(self) -> list[str]:
        """Make the index anew from bags and decision logs; returns what was unreadable."""
        episodes, problems = _indexed({p.name: p for p in self.bags()})
        decisions: list[Decision] = []
        for episode_id in self.decided_ids():
            try:
                decisions += self.decisions(episode_id)
            except CurationError as err:
                problems.append(str(err))
        self.index.refill(episodes, decisions)
        return problems


def _indexed(folders: Mapping[str, Path]) -> tuple[list[IndexedEpisode], list[str]]:
    """What the index notes on bags, and what is wrong with those that it cannot note."""
    episodes, problems = [], []
    for episode_id, folder in folders.items():
        try:
            episodes.append(_indexed_episode(open_bag(folder), episode_id))
        except CurationError as err:
            problems.append(str(err))
    return episodes, problems


def _indexed_episode(bag: Bag, episode_id: str) -> IndexedEpisode:
    event = bag.event()
    if event is None:
        raise EpisodeError(f"bag {bag.path}: no 'episode' in its custom data: not of our recorder")
    end_ns = event.end_ns
    if end_ns is None:  # the recorder died before the end was announced
        with suppress(CurationError):
            end_ns = int(episode_of(bag).stamps_ns[-1])
    return IndexedEpisode(
        id=episode_id,
        name=event.name,
        path=f"{layout.EPISODES}/{episode_id}",
        start_ns=event.start_ns,
        end_ns=end_ns or event.start_ns,
        event=event.event,
        source=event.source,
        is_recovered=bag.custom_data.get("recovered") == "true",
    )
