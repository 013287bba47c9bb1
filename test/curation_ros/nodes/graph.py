"""A ROS graph for one test module: node processes, and a probe in this process."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import pytest
from pausing import PAUSE, RESUME, stands_still

from curation_ros.core.decision.decision import Decision
from curation_ros.core.episode.status import EpisodeEvent, Status, event_from_status
from curation_ros.core.errors import EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.processes import Domain, Nodes

try:
    import rclpy
    import rclpy.context
    from diagnostic_msgs.msg import DiagnosticArray, KeyValue
    from geometry_msgs.msg import PoseStamped, TwistStamped
    from rcl_interfaces.srv import DescribeParameters
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import JointState
    from std_srvs.srv import Trigger

    from curation_ros.nodes.messages import single_from_ros, status_from_ros
    from curation_ros.nodes.qos import DECISIONS, EVENTS, LATCHED, MAPPED
except ImportError as err:
    pytest.skip(f"rclpy is not installed: {err}", allow_module_level=True)

#: Tests import ROS classes from here, so that they are skipped without ROS.
__all__ = [
    "DECISIONS",
    "LATCHED",
    "MAPPED",
    "PATIENCE_S",
    "DescribeParameters",
    "DiagnosticArray",
    "Graph",
    "JointState",
    "KeyValue",
    "PoseStamped",
    "QoSProfile",
    "ReliabilityPolicy",
    "Trigger",
    "TwistStamped",
    "jsonl",
]

#: How long to wait for anything that takes a fraction of a second on an idle machine.
PATIENCE_S = 60.0
_TAIL = 12


class Graph:
    """Nodes on a domain of their own, and all messages on their topics since the start.

    Attributes:
        folder: for datasets and files of the test.
        events: messages on `episode`.
        outcomes: messages on `episode/outcome`.
        recorders: messages on `recorder/status`.
        decisions: messages on `curator/decision`.
        health: messages on /diagnostics.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.events: list[EpisodeEvent] = []
        self.outcomes: list[Status] = []
        self.recorders: list[Status] = []
        self.decisions: list[Status] = []
        self.health: list[Status] = []
        self._clients: dict[str, Any] = {}

    def __enter__(self) -> Graph:
        self.domain = Domain()
        os.environ.update(self.domain.environment)
        self.nodes = Nodes(self.domain, self.folder / "logs")
        self.context = rclpy.context.Context()
        rclpy.init(context=self.context, domain_id=self.domain.id)
        self.node = rclpy.create_node("probe", context=self.context, enable_rosout=False)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.node.create_subscription(
            DiagnosticArray,
            "/diagnostics",
            lambda m: self.health.extend(status_from_ros(s) for s in m.status),
            EVENTS,
        )
        self.override_publisher = self.node.create_publisher(KeyValue, "curator/override", EVENTS)
        self.listen("")
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.nodes.__exit__(kind, error, trace)
        self.node.destroy_node()
        self.context.try_shutdown()
        self.domain.close()

    def listen(self, namespace: str) -> None:
        """Subscribe to the episodes and decisions of a namespace, too."""
        for topic, qos, sink in (
            ("episode", LATCHED, self._on_event),
            ("episode/outcome", LATCHED, self.outcomes.append),
            ("recorder/status", LATCHED, self.recorders.append),
            ("curator/decision", DECISIONS, self.decisions.append),
        ):
            self.node.create_subscription(
                DiagnosticArray,
                namespace + topic,
                lambda m, sink=sink: sink(single_from_ros(m)),
                qos,
            )

    def _on_event(self, status: Status) -> None:
        with suppress(EpisodeError):  # a test may publish a spoilt event
            self.events.append(event_from_status(status))

    # --- nodes ------------------------------------------------------------------------------

    def start(
        self,
        node: str,
        key: str = "",
        remaps: Mapping[str, str] | None = None,
        **parameters: Any,
    ) -> None:
        """Start a node; its key is its name in the other methods."""
        self.nodes.start(node, parameters, key=key, remaps=remaps)

    def stop(self, *keys: str) -> None:
        """Stop nodes that were started."""
        for key in keys:
            self.nodes.stop(key)

    def pause(self, key: str) -> None:
        """Pause a node that was started in `pausing.pausable`, and wait until it stands still."""
        self.nodes.send(key, PAUSE)
        self.until(lambda: stands_still(self.nodes.pid(key)), f"{key} stands still")

    def resume(self, key: str) -> None:
        """Let a paused node continue."""
        self.nodes.send(key, RESUME)

    def log(self, key: str) -> str:
        """The output of a node so far."""
        path = self.folder / "logs" / f"{key}.log"
        return path.read_text(errors="replace") if path.exists() else ""

    def expect_exit(self, key: str, timeout_s: float = PATIENCE_S) -> tuple[int, str]:
        """Wait for a node to end by itself. Returns its exit code and its output."""
        self.until(lambda: self.nodes.ended(key) is not None, f"{key} ends", timeout_s)
        code = self.nodes.ended(key)
        self.stop(key)
        assert code is not None
        return code, self.log(key)

    # --- waiting ----------------------------------------------------------------------------

    def spin(self, seconds: float = 0.02) -> None:
        """Receive at most one message, and wait for it at most that long."""
        self._executor.spin_once(timeout_sec=seconds)

    def until(self, condition: Callable[[], Any], what: str, timeout_s: float = PATIENCE_S) -> Any:
        """Receive messages until a condition holds. Returns what the condition returned."""
        deadline_s = time.monotonic() + timeout_s
        while not (found := condition()):
            if time.monotonic() > deadline_s:
                raise AssertionError(f"not within {timeout_s:g} s: {what}\n{self._tails()}")
            self.spin()
        return found

    def quiet(self, seconds: float) -> None:
        """Receive messages for a while, to see that something does not happen."""
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            self.spin()

    def _tails(self) -> str:
        logs = sorted((self.folder / "logs").glob("*.log"))
        return "\n".join(
            f"--- {log.name}\n" + "\n".join(log.read_text().splitlines()[-_TAIL:]) for log in logs
        )

    def ready(self, *keys: str, line: str = "domain ") -> None:
        """Wait until a line in their logs says that nodes are up."""
        for key in keys:

            def is_up(key: str = key) -> bool:
                assert self.nodes.ended(key) is None, self.log(key)
                return line in self.log(key)

            self.until(is_up, f"{key} logs {line!r}")

    def recorded(self, episode_id: str) -> Status:
        """Wait until a recorder has closed the bag of an episode, or has failed."""
        return self.until(
            lambda: next(
                (
                    s
                    for s in self.recorders
                    if s.hardware_id == episode_id and not s.message.startswith("recording")
                ),
                None,
            ),
            f"recorder closes {episode_id}",
        )

    def decided(self, episode_id: str, revision: int = 1) -> Status:
        """Wait for a published decision on an episode, of that revision or a later one."""
        return self.until(
            lambda: next(
                (
                    s
                    for s in reversed(self.decisions)
                    if s.hardware_id == episode_id and int(s.values["revision"]) >= revision
                ),
                None,
            ),
            f"revision {revision} of the decision on {episode_id}",
        )

    def settled(self, dataset: Path, episode_id: str) -> Decision:
        """Wait until the curator has compared an episode with its bag; its last decision."""

        def compared() -> Decision | None:
            known = Dataset(dataset).decisions(episode_id)
            return known[-1] if known and "bag" in known[-1].evidence else None

        return self.until(compared, f"decision on {episode_id} compared with its bag")

    def client(self, kind: Any, service: str) -> Any:
        """A client of a service that is there. It is kept, because the server has found it."""
        if service not in self._clients:
            self._clients[service] = self.node.create_client(kind, service)
        self.until(self._clients[service].service_is_ready, f"service {service}")
        return self._clients[service]

    def call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service. Returns its response."""
        future = self.client(kind, service).call_async(request)
        self.until(future.done, f"answer of {service}")
        return future.result()

    def counts_publishers(self, node: str, topics: Sequence[str], n: int) -> None:
        """Wait until a node reports that it has found n publishers of each topic."""
        since = len(self.health)
        wanted = {f"publishers/{topic}": str(n) for topic in topics}
        self.until(
            lambda: any(
                s.name == node and wanted.items() <= s.values.items() for s in self.health[since:]
            ),
            f"{node} has found {n} publishers of {' and '.join(topics)}",
        )

    def problem(self, node: str, text: str) -> Status:
        """Wait until a node reports a problem on /diagnostics."""
        return self.until(
            lambda: next(
                (s for s in self.health if s.name == node and s.level and text in s.message), None
            ),
            f"{node} reports {text!r} on /diagnostics",
        )


def jsonl(text: str) -> list[dict[str, Any]]:
    """Rows of JSON lines."""
    return [json.loads(line) for line in text.splitlines()]
