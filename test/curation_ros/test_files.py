"""Files: atomic writes, locks and JSON lines, and that no other module does these on its own."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from curation_ros.core.errors import CurationError
from curation_ros.files import (
    append_line,
    exclusive,
    named_errors,
    read_lines,
    try_lock,
    write_atomically,
    write_folder_atomically,
)

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("curation_ros", "sim_node", "policy_node")


@pytest.mark.parametrize("replace", [True, False])
def test_file_is_written_whole_or_not_at_all(tmp_path: Path, replace: bool) -> None:
    path = tmp_path / "a" / "file.json"
    with pytest.raises(UnicodeEncodeError):
        write_atomically(path, "new \ud800", replace=replace)
    assert not path.exists()
    write_atomically(path, "old é", replace=replace)
    assert path.read_bytes() == "old é".encode()
    assert [p.name for p in path.parent.iterdir()] == ["file.json"]


def test_file_is_replaced_unless_told_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "file"
    write_atomically(path, b"old")
    with pytest.raises(FileExistsError) as refused:
        write_atomically(path, b"new", replace=False)
    assert refused.value.filename == str(path)
    assert path.read_bytes() == b"old"
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_existing_file_is_kept_where_hard_links_cannot_be_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    path = tmp_path / "file"
    write_atomically(path, "old", replace=False)
    with pytest.raises(FileExistsError):
        write_atomically(path, "new", replace=False)
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_folder_is_made_unless_told_otherwise(tmp_path: Path) -> None:
    path = tmp_path / "a" / "file"
    with pytest.raises(FileNotFoundError):
        write_atomically(path, "x", make_folder=False)
    assert list(tmp_path.iterdir()) == []
    write_atomically(path, "x")
    assert path.read_text() == "x"


def test_file_can_be_read_by_those_whom_the_umask_lets(tmp_path: Path) -> None:
    before = os.umask(0o022)
    try:
        write_atomically(tmp_path / "file", "x")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == 0o644


def test_folder_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "folder"
    with pytest.raises(UnicodeEncodeError):
        write_folder_atomically(folder, {"x": b"1", "y": "new \ud800"})
    with pytest.raises(FileNotFoundError):
        write_folder_atomically(folder, {"x": b"1", "no/such": "2"})
    assert not folder.exists()
    write_folder_atomically(folder, {"x": b"1", "y": "é"})
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == {"x": b"1", "y": "é".encode()}
    with pytest.raises(FileExistsError) as refused:
        write_folder_atomically(folder, {"x": b"2"})
    assert refused.value.filename == str(folder)
    assert (folder / "x").read_bytes() == b"1"
    assert [p.name for p in folder.parent.iterdir()] == ["folder"]


def test_lock_is_held_until_it_is_released(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    lock = try_lock(path)
    assert lock is not None
    assert try_lock(path) is None
    lock.release()
    lock.release()
    with exclusive(path):
        assert try_lock(path) is None
    again = try_lock(path)
    assert again is not None
    again.release()


_HOLDS = """
import sys, time
from pathlib import Path
from curation_ros.files import exclusive
with exclusive(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
    Path(sys.argv[2]).write_text("done")
"""


def test_exclusive_waits_for_another_process(tmp_path: Path) -> None:
    path, done = tmp_path / "folder" / "lock", tmp_path / "done"
    command = [sys.executable, "-c", _HOLDS, str(path), str(done)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdin is not None
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        assert try_lock(path) is None
        other.stdin.close()
        with exclusive(path):
            assert done.read_text() == "done"


def test_lock_of_a_killed_process_is_free(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    command = [sys.executable, "-c", _HOLDS, str(path), str(tmp_path / "done")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        other.kill()
        other.wait()
        lock = try_lock(path)
        assert lock is not None
        lock.release()


def test_lines_are_read_in_order_and_torn_ones_are_skipped(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "log.jsonl"
    assert read_lines(path) == []
    append_line(path, {"a": 1})
    path.write_bytes(path.read_bytes() + b'{"a": ')
    append_line(path, {"a": 2})
    path.write_bytes(path.read_bytes() + b"[3]\n\xff\n")
    assert read_lines(path) == [{"a": 1}, {"a": 2}]


def test_line_that_is_not_json_leaves_the_log_as_it_was(tmp_path: Path) -> None:
    path = tmp_path / "log.jsonl"
    append_line(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        append_line(path, {"a": float("nan")})
    assert path.read_text() == json.dumps({"a": 1}) + "\n"


def test_errors_of_the_system_become_ours_and_name_the_file(tmp_path: Path) -> None:
    with pytest.raises(CurationError, match=f"{tmp_path}: Is a directory"):
        read_lines(tmp_path)
    with (
        pytest.raises(CurationError, match=r"^x: No space left on device$"),
        named_errors(Path("x")),
    ):
        raise OSError(28, "No space left on device")


# --- one home -----------------------------------------------------------------------------------


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text())


def test_only_files_locks_and_syncs() -> None:
    calls = {"flock", "lockf", "mkstemp", "NamedTemporaryFile"}
    found = set()
    for name, tree in _modules():
        for node in ast.walk(tree):
            imported = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                imported = [node.module or ""]
            called = node.attr if isinstance(node, ast.Attribute) else ""
            if "fcntl" in imported or called in calls:
                found.add(name)
    assert found == {"curation_ros/files.py"}
