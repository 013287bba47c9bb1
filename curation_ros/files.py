"""Files that survive a crash: whole or absent, locked, and appended line by line."""

from __future__ import annotations

import fcntl
import json
import os
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from curation_ros.core.errors import CurationError


def sync_folder(folder: Path) -> None:
    """Make new and renamed entries of a folder survive a loss of power.

    Raises:
        OSError: if the folder cannot be opened or synchronised.
    """
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def write_atomically(path: Path, text: str) -> None:
    """Write a whole file or nothing, and have it on disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # Not tempfile's: its files are for their owner's eyes alone.
    name = path.parent / f".{path.name}.{uuid.uuid4().hex}"
    handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    try:
        with os.fdopen(handle, "w") as out:
            out.write(text)
            out.flush()
            os.fsync(out.fileno())
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
    sync_folder(path.parent)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock file of a folder against other processes and threads."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """What the system refuses becomes an error for people, with the file's name."""
    try:
        yield
    except OSError as err:
        raise CurationError(f"{err.filename or path}: {err.strerror or err}") from err


def append_line(path: Path, record: Mapping[str, Any]) -> None:
    """Append one JSON line and sync it; a torn last line (a crash) is ended first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as out:
        fcntl.flock(out, fcntl.LOCK_EX)  # half of another's line would look like a torn one
        end = out.seek(0, os.SEEK_END)
        if end:
            out.seek(end - 1)
            if out.read(1) != b"\n":
                out.write(b"\n")
        out.write(json.dumps(record, allow_nan=False).encode() + b"\n")
        out.flush()
        os.fsync(out.fileno())


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Whole JSON lines of a log; a torn line is skipped, a missing file is empty."""
    try:
        with named_errors(path):
            lines = path.read_bytes().splitlines()
    except CurationError as err:
        if isinstance(err.__cause__, FileNotFoundError):
            return []
        raise
    records = []
    for line in lines:
        with suppress(ValueError):
            record = json.loads(line)
            if isinstance(record, dict):
                records.append(record)
    return records
