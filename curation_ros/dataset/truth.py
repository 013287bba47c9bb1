"""The truth about episodes, outcomes and injected defects: for evaluation, never for scoring."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from curation_ros.files import append_line, named_errors, read_lines, write_atomically


class TruthLog:
    """A log of JSON lines, each with the id of an `episode` and what is known about it.

    Attributes:
        path: of the log; it may not exist yet.
    """

    def __init__(self, path: Path) -> None:
        """Name the log."""
        self.path = path

    def append(self, record: Mapping[str, Any]) -> None:
        """Append a line; it is on the disk on return.

        Raises:
            CurationError: if it cannot be written.
        """
        with named_errors(self.path):
            append_line(self.path, record)

    def replace(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Write the whole log anew.

        Raises:
            CurationError: if it cannot be written.
        """
        with named_errors(self.path):
            write_atomically(self.path, "".join(json.dumps(r) + "\n" for r in records))

    def lines(self) -> list[dict[str, Any]]:
        """All lines, oldest first.

        Raises:
            CurationError: if the log cannot be read.
        """
        return read_lines(self.path)

    def by_episode(self) -> dict[str, dict[str, Any]]:
        """Episode id -> all its lines merged; later lines win."""
        merged: dict[str, dict[str, Any]] = {}
        for line in self.lines():
            merged.setdefault(str(line.get("episode")), {}).update(line)
        return merged

    def starts(self) -> dict[str, tuple[str, str, int]]:
        """Episode id -> (task, start state, repetition), where they were noted; no labels."""
        return {
            i: (str(t.get("task", "")), str(t["start"]), int(t.get("repetition", 0)))
            for i, t in self.by_episode().items()
            if "start" in t
        }
