"""Nodes that hang for a while, as one does that computes or waits for a disk.

The whole process must not be stopped for that (SIGSTOP) while others publish to it through shared
memory: about once in fifty it is stopped while it holds a lock there. Who publishes to it is then
held up for a second and gives that memory up, and the process may hear nothing when it goes on.
With discovery on this machine alone, rmw_fastrtps has no other transport.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

#: Sent to a process started in `pausable`. Its Python stops within some 20 ms, and goes on; the
#: threads of its transport take messages all the time, until its queues are full.
PAUSE, RESUME = signal.SIGUSR1, signal.SIGUSR2
#: A node that spins wakes up several times in that.
_STILL_S = 0.1


def stands_still(pid: int) -> bool:
    """Whether the main thread of a node, which wakes up every 20 ms, does so no more."""
    before = _switches(pid)
    time.sleep(_STILL_S)
    return _switches(pid) == before


def _switches(pid: int) -> int:
    status = Path(f"/proc/{pid}/task/{pid}/status").read_text()
    return sum(int(line.split()[1]) for line in status.splitlines() if "ctxt_switches" in line)


@contextmanager
def pausable() -> Iterator[None]:
    """Processes started in this block, and the nodes that they start, can be paused."""
    folder = str(Path(__file__).parent / "pausable")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", folder, prepend=os.pathsep)
        yield
