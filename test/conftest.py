"""Fixtures of tests that run nodes: a graph per module, and no process left behind."""

from __future__ import annotations

import os
import time
import uuid
from contextlib import ExitStack
from pathlib import Path

import pytest

_MARK = "CURATION_ROS_TEST"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Tests of the graph come last: DDS leaves threads behind, and forking then may hang."""
    items.sort(key=lambda item: item.get_closest_marker("ros") is not None)


@pytest.fixture(scope="module")
def graph(tmp_path_factory, no_process_left):
    """A ROS graph on a domain of its own. Its nodes end with the module."""
    with ExitStack() as stack:
        yield from _graph(stack, tmp_path_factory)


@pytest.fixture(scope="module")
def other_graph(tmp_path_factory, no_process_left):
    """A second graph, on another domain."""
    with ExitStack() as stack:
        yield from _graph(stack, tmp_path_factory)


def _graph(stack, tmp_path_factory):
    from graph import Graph  # where rclpy is missing, importing it skips

    yield stack.enter_context(Graph(tmp_path_factory.mktemp("graph")))


@pytest.fixture(scope="session")
def no_process_left():
    """Checks that all processes that tests have started, directly or not, have ended."""
    mark = f"{_MARK}={uuid.uuid4()}"
    os.environ.update([mark.split("=")])
    yield
    deadline_s = time.monotonic() + 5.0
    while (left := _processes(mark.encode())) and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert not left, f"left behind: {left}"


def _processes(mark: bytes) -> list[str]:
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            # /proc shows the environment at the start of a process, so this process has no mark.
            if mark in (folder / "environ").read_bytes().split(b"\0"):
                found.append((folder / "cmdline").read_bytes().replace(b"\0", b" ").decode())
        except OSError:
            continue
    return found
