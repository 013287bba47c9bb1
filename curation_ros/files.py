"""Files that survive a crash: atomic writes, locks between processes, and logs of JSON lines.

No other module imports fcntl or syncs a file on its own.
"""

from __future__ import annotations

import errno
import fcntl
import json
import os
import re
import shutil
import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from curation_ros.core.episode.identity import is_uuid
from curation_ros.core.errors import CurationError


@contextmanager
def named_errors(path: Path) -> Iterator[None]:
    """Turn an error of the system into one of ours that names the file.

    Args:
        path: named where the system's error names no file.

    Raises:
        CurationError: for each OSError.
    """
    try:
        yield
    except OSError as err:
        raise CurationError(f"{err.filename or path}: {err.strerror or err}") from err


def natural_order(path: Path) -> tuple[tuple[int, str], ...]:
    """Sort key of files and folders by name: part 10 follows part 9, and ids follow their time."""
    if is_uuid(path.stem):
        return ((-1, path.stem),)
    pieces = re.findall(r"\d+|\D+", path.name)
    return tuple((int(p), "") if p.isdigit() and p.isascii() else (-1, p) for p in pieces)


# --- atomic writes ------------------------------------------------------------------------------


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


def write_atomically(
    path: Path, content: str | bytes, *, replace: bool = True, make_folder: bool = True
) -> None:
    """Write a whole file or nothing; it is on the disk when this returns.

    Args:
        path: the file.
        content: text is written as UTF-8.
        replace: whether a file that exists is replaced.
        make_folder: whether its folder is made where it does not exist.

    Raises:
        FileExistsError: if the file exists and must not be replaced.
        OSError: if it cannot be written.
    """
    data = content.encode() if isinstance(content, str) else content
    if make_folder:
        path.parent.mkdir(parents=True, exist_ok=True)
    name = _hidden_name(path)
    try:
        _write_synced(name, data)
        if replace:
            os.replace(name, path)
        else:
            _rename_to_new(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
    sync_folder(path.parent)


def write_folder_atomically(folder: Path, files: Mapping[str, str | bytes]) -> None:
    """Write a new folder with all of its files, or nothing; it is on the disk when this returns.

    Args:
        folder: must not exist; its parents are made.
        files: name -> content; text is written as UTF-8.

    Raises:
        FileExistsError: if the folder exists.
        OSError: if it cannot be written.
    """
    contents = {k: v.encode() if isinstance(v, str) else v for k, v in files.items()}
    name = _hidden_name(folder)
    name.mkdir(parents=True)
    try:
        for file, content in contents.items():
            _write_synced(name / file, content)
        sync_folder(name)
        if folder.exists():
            raise _exists(folder)
        os.rename(name, folder)
    except BaseException:
        shutil.rmtree(name, ignore_errors=True)
        raise
    sync_folder(folder.parent)


def _hidden_name(path: Path) -> Path:
    """A name beside a path that no other process uses."""
    return path.parent / f".{path.name}.{uuid.uuid4().hex}"


def _write_synced(path: Path, data: bytes) -> None:
    # Not a file of `tempfile`: only its owner could read it.
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
    with os.fdopen(fd, "wb") as out:
        out.write(data)
        out.flush()
        os.fsync(out.fileno())


def _exists(path: Path) -> FileExistsError:
    return FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def _rename_to_new(name: Path, path: Path) -> None:
    """Rename a file to a name that does not exist; of several processes, one succeeds."""
    try:
        os.link(name, path)  # a rename would replace the file
    except FileExistsError:
        raise _exists(path) from None
    except OSError:  # a file system without hard links
        if path.exists():
            raise _exists(path) from None
        os.rename(name, path)
    else:
        os.unlink(name)


# --- locks --------------------------------------------------------------------------------------


class FileLock:
    """A lock on a file, held until `release`, the end of a `with`, or the end of the process."""

    def __init__(self, file: IO[str]) -> None:
        """Take over a file that is locked; `exclusive` and `try_lock` make locks."""
        self._file = file

    def release(self) -> None:
        """Let others have the lock; a second call changes nothing."""
        self._file.close()

    def __enter__(self) -> FileLock:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.release()


def exclusive(path: Path) -> FileLock:
    """Wait for the lock on a file, against other processes and threads.

    Args:
        path: the lock's file; it and its folder are made where they do not exist, and stay.

    Raises:
        OSError: if it cannot be opened.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX)
    except BaseException:
        file.close()
        raise
    return FileLock(file)


def try_lock(path: Path) -> FileLock | None:
    """Take the lock on a file if it is free.

    Args:
        path: the lock's file in a folder that exists; the file is made where it does not exist.

    Returns:
        The lock; None while another process or thread has it.

    Raises:
        OSError: if the file cannot be opened.
    """
    file = path.open("a")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        return None
    return FileLock(file)


# --- JSON lines ---------------------------------------------------------------------------------


def append_line(path: Path, record: Mapping[str, Any]) -> None:
    """Append one JSON line; it is on the disk when this returns.

    A torn last line, left by a crash, is ended first.

    Args:
        path: the log; it and its folder are made where they do not exist.
        record: JSON values; NaN and infinity are refused.

    Raises:
        OSError: if the line cannot be written.
        ValueError: if the record is not JSON.
    """
    line = json.dumps(record, allow_nan=False).encode() + b"\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+b") as out:
        # Without the lock, half of another process's line would look like a torn one.
        fcntl.flock(out, fcntl.LOCK_EX)
        end = out.seek(0, os.SEEK_END)
        if end:
            out.seek(end - 1)
            if out.read(1) != b"\n":
                out.write(b"\n")
        out.write(line)
        out.flush()
        os.fsync(out.fileno())


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read the whole lines of a log.

    Returns:
        The records, oldest first. Torn lines are skipped; a log that does not exist is empty.

    Raises:
        CurationError: if the log cannot be read.
    """
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
