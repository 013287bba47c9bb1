"""Pauses nodes for a while, as a long computation or a slow disk would.

SIGSTOP is no way to do that while others publish to the process through shared memory. In about
one of fifty trials it stops the process while that holds a lock there. Its publishers then block
for a second and give up that memory, and the process may receive nothing after it continues. With
discovery on this machine alone, rmw_fastrtps has no other transport.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

#: Signals for a process that was started in `pausable`. Its Python stops within 20 ms, and
#: continues. The threads of its transport take messages all the time, until its queues are full.
PAUSE, RESUME = signal.SIGUSR1, signal.SIGUSR2
#: A node that spins wakes up several times in this period.
_STILL_S = 0.1


def stands_still(pid: int) -> bool:
    """Whether the main thread of a node, which otherwise wakes up every 20 ms, is still."""
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
