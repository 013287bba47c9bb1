"""Node processes on a ROS domain of their own. None is left behind."""

from __future__ import annotations

import ctypes
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType, TracebackType
from typing import IO, Any

from curation_ros.core.errors import CurationError
from curation_ros.files import try_lock
from curation_ros.nodes.programs import NODE_MODULES

# Domains above 101 need ports from Linux's ephemeral range.
_DOMAINS = range(1, 102)
_PATIENCE_S = 10.0
_PR_SET_PDEATHSIG = 1
# Looked up once: a child of a process with threads must do next to nothing between fork and exec.
_PRCTL = getattr(ctypes.CDLL(None), "prctl", None)


class Domain:
    """A ROS domain id that no other process of this package uses, until it is closed."""

    def __init__(self) -> None:
        """Take a free domain id.

        Raises:
            CurationError: if all are taken.
        """
        for candidate in random.sample(list(_DOMAINS), len(_DOMAINS)):
            if _is_in_use(candidate):
                continue
            path = Path(tempfile.gettempdir()) / f"curation_ros-domain-{candidate}.lock"
            try:
                lock = try_lock(path)
            except OSError:  # the file is another user's
                continue
            if lock is None:
                continue
            self.id = candidate
            self._lock = lock
            return
        raise CurationError(f"no free ROS domain id among {_DOMAINS[0]} to {_DOMAINS[-1]}")

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables of the processes on this domain."""
        return {
            "ROS_DOMAIN_ID": str(self.id),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }

    def close(self) -> None:
        """Give the domain id back."""
        self._lock.release()


def _is_in_use(domain_id: int) -> bool:
    """Whether a DDS participant of this machine listens on the domain's discovery ports."""
    first = 7400 + 250 * domain_id  # DDSI-RTPS 2.5, 9.6.2.3
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                port = int(line.split()[1].rpartition(":")[2], 16)
                if first <= port < first + 250:
                    return True
    return False


def _die_with_parent() -> None:
    # A process that a shell has started in the background ignores SIGINT. Children inherit that.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    # Linux only. Elsewhere, children outlive a parent that was killed.
    if _PRCTL is not None:
        _PRCTL(_PR_SET_PDEATHSIG, signal.SIGTERM)


class Nodes:
    """Node processes, which are stopped in reverse order when the `with` block ends.

    They run in sessions of their own. Ctrl-C in a terminal reaches only this process, which then
    stops them in order.
    """

    def __init__(self, domain: Domain, log_folder: Path) -> None:
        """Start without processes.

        Args:
            domain: where they will run.
            log_folder: gets the output of each process, in `<key>.log`.
        """
        self._domain = domain
        self._logs = log_folder
        self._running: dict[str, tuple[subprocess.Popen[bytes], IO[bytes]]] = {}
        log_folder.mkdir(parents=True, exist_ok=True)

    def __enter__(self) -> Nodes:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for key in reversed(list(self._running)):
            self.stop(key)

    def start(
        self,
        node: str,
        parameters: Mapping[str, Any],
        *,
        key: str = "",
        remaps: Mapping[str, str] | None = None,
    ) -> None:
        """Start a node.

        Args:
            node: one of NODE_MODULES.
            parameters: values of its parameters.
            key: name of the process and its log; empty: the name of the node.
            remaps: ROS name -> new name; `__ns` is the namespace.
        """
        key = key or node
        arguments = [sys.executable, "-m", NODE_MODULES[node]]
        arguments += node_arguments(parameters, remaps or {})
        log = (self._logs / f"{key}.log").open("ab")
        process = subprocess.Popen(
            arguments,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, **self._domain.environment},
            start_new_session=True,
            preexec_fn=_die_with_parent,
        )
        self._running[key] = (process, log)

    def send(self, key: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        self._running[key][0].send_signal(number)

    def pid(self, key: str) -> int:
        """Process id."""
        return self._running[key][0].pid

    def ended(self, key: str) -> int | None:
        """Exit code of a process; None while it runs."""
        return self._running[key][0].poll()

    def check(self) -> None:
        """Raise an error if a process has failed.

        Raises:
            CurationError: with the last line of its log.
        """
        for key, (process, _) in self._running.items():
            if process.poll() not in (None, 0):
                path = self._logs / f"{key}.log"
                lines = path.read_text(errors="replace").strip().splitlines()
                last = lines[-1] if lines else "its log is empty"
                raise CurationError(f"{key} ended with code {process.returncode}: {last} ({path})")

    def wait(self, key: str, timeout_s: float) -> None:
        """Wait for a process to end by itself.

        Raises:
            CurationError: if it fails or does not end in time.
        """
        deadline_s = time.monotonic() + timeout_s
        while self.ended(key) is None:
            self.check()
            if time.monotonic() > deadline_s:
                raise CurationError(f"{key} has not ended within {timeout_s:g} s")
            time.sleep(0.05)
        self.check()

    def stop(self, key: str) -> None:
        """Stop a process by SIGINT, then SIGTERM, then SIGKILL, if it needs them."""
        process, log = self._running.pop(key)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            if process.poll() is not None:
                break
            process.send_signal(number)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE_S)
        log.close()


def node_arguments(
    parameters: Mapping[str, Any], remaps: Mapping[str, str] = MappingProxyType({})
) -> list[str]:
    """Command line arguments for parameters and remaps of a node."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        arguments += ["-p", f"{name}:={_yaml(value)}"]
    for name, value in remaps.items():
        arguments += ["-r", f"{name}:={value}"]
    return arguments


def _yaml(value: Any) -> str:
    """A parameter value, as ROS arguments spell it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(_yaml(v) for v in value) + "]"
    if isinstance(value, (str, Path)):
        return "'" + str(value).replace("'", "''") + "'"
    return repr(value)
