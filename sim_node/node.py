"""Sim node: a simulated task on the graph, in lockstep or free, by its expert or by commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node
from std_srvs.srv import Trigger

from curation_ros.core.episode.messages import CLOCK, PlainMessage
from curation_ros.core.episode.status import (
    ERROR,
    OK,
    EpisodeEvent,
    Status,
    counts_from_status,
    event_to_status,
)
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.delivery import deliver
from curation_ros.nodes.discovery import Discovery
from curation_ros.nodes.health import Health, publishers_found
from curation_ros.nodes.messages import (
    array_to_ros,
    message_type,
    status_from_ros,
    time_from_ros,
    to_ros,
)
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import EVENTS, LATCHED, MAPPED
from curation_ros.nodes.spinning import Finished, WorkingNode, run
from sim_node.defects import DEFECTS
from sim_node.driving import Commands, DrivenEpisode, Driver
from sim_node.messages import CLOCK_TOPIC, COMMAND_TOPICS, COMMAND_TYPES, RobotMessages
from sim_node.planning import EpisodePlan, plan_episodes
from sim_node.settings import SIMULATED_TASK, DriveSettings
from sim_node.tasks import TASKS, start_names

_DEFAULT = DriveSettings()

PARAMETERS = (
    Parameter("mode", _DEFAULT.mode, "who gives the commands", choices=("expert", "command")),
    Parameter("sync", _DEFAULT.sync, "when the robot steps", choices=("lockstep", "free")),
    Parameter("simulated_task", SIMULATED_TASK, "what is simulated", choices=tuple(TASKS)),
    Parameter("episodes", 1, "how many; 0: no end, and another node owns episodes", 0, 100_000),
    Parameter("task", "bowl", "short names are <task>-<number>"),
    Parameter("first_number", 1, "number of the first episode", 0, 1_000_000),
    Parameter("seed", 0, "seed of order, expert and defects", 0, 2**31 - 1),
    Parameter("contamination", 0.0, "fraction of defective demonstrations", 0.0, 1.0),
    Parameter("defect", "early_release", "kind of the defect", choices=tuple(DEFECTS)),
    Parameter("paired", False, "whether defective demonstrations reuse the starts of clean ones"),
    Parameter("starts", "", "official:0:50 or generated:SEED:COUNT; empty: generated, by seed"),
    Parameter("max_steps", _DEFAULT.max_steps, "most commands of an episode", 1, 100_000),
    Parameter(
        "max_steps_defective",
        _DEFAULT.max_steps_defective,
        "the same for defective episodes; 0: max_steps",
        0,
        100_000,
    ),
    Parameter(
        "steps_after_success", _DEFAULT.steps_after_success, "commands after success", 0, 1000
    ),
    Parameter("dataset", "", "where outcomes are written, to truth.jsonl; empty: nowhere"),
    Parameter(
        "realtime_factor", _DEFAULT.realtime_factor, "free: speed, 1 is real time", 0.01, 100.0
    ),
    Parameter(
        "hold_timeout_s", _DEFAULT.hold_timeout_s, "free: older commands become zero, s", 0.0, 60.0
    ),
    Parameter(
        "command_timeout_s",
        _DEFAULT.command_timeout_s,
        "lockstep: longest wait for a command, s",
        0.1,
        3600.0,
    ),
    Parameter(
        "wait_for", (), "nodes that must run before the first reset; recorder: also for its bags"
    ),
    Parameter("lean", True, "fast stepping; false: the benchmark's own, LIBERO's env.step"),
)
_REPORT_S = 5.0


#: Stands for the name of a publisher's node until the name has been discovered.
_UNNAMED = "_NODE_NAME_UNKNOWN_"


class _Publishers:
    """All publishers of the sim node; `episode` and the commands exist only for their owner.

    Args:
        node: the sim node.
        observation_types: topic -> message type of all observations.
        owner: whether this node owns the episodes.
        expert: whether this node gives the commands.
    """

    def __init__(
        self, node: Node, observation_types: Mapping[str, str], *, owner: bool, expert: bool
    ) -> None:
        self._node = node
        self.observation_topics = tuple(observation_types)
        make = node.create_publisher
        self._episode = make(DiagnosticArray, "episode", LATCHED) if owner else None
        self._outcome = make(DiagnosticArray, "episode/outcome", LATCHED) if owner else None
        types = {**observation_types, **(COMMAND_TYPES if expert else {})}
        self._publishers = {t: make(message_type(kind), t, MAPPED) for t, kind in types.items()}
        self._publishers[CLOCK_TOPIC] = make(message_type(CLOCK), CLOCK_TOPIC, EVENTS)
        self._discovery = Discovery(node)

    def send(self, message: PlainMessage) -> None:
        """Publish a message of an observation or a command."""
        self._publishers[message.topic].publish(to_ros(message.type, message.content))

    def event(self, event: EpisodeEvent) -> None:
        """Publish an event of an episode.

        This does not wait for acknowledgements: Fast DDS asks for them every 3 s only. Later
        messages overtake an event only where a packet is lost. Use `wait_for` with the recorder
        to be sure.
        """
        if self._episode is not None:
            self._episode.publish(array_to_ros([event_to_status(event)], event.start_ns))

    def outcome(self, status: Status) -> None:
        """Publish an outcome, for evaluation only."""
        if self._outcome is not None:
            stamp_ns = self._node.get_clock().now().nanoseconds
            self._outcome.publish(array_to_ros([status], stamp_ns))

    def flush(self) -> None:
        """Wait until every subscriber has everything of our episodes."""
        if self._episode is not None:
            observations = [self._publishers[topic] for topic in self.observation_topics]
            deliver([self._episode, self._outcome, *observations])

    def is_matched(self, node_name: str) -> bool:
        """Whether a node runs and has subscribed, to `episode` too if that is ours."""
        topics = [] if self._episode is None else [self._episode.topic_name]
        return self._discovery.is_complete(node_name, topics)


def several_commanders(node: Node) -> str:
    """Names of the nodes that send commands, if there are several or one has two publishers."""
    infos = [i for t in COMMAND_TOPICS for i in node.get_publishers_info_by_topic(t)]
    # A publisher is discovered a moment before the name of its node.
    infos = [i for i in infos if i.node_name != _UNNAMED]
    owners = {(i.node_namespace, i.node_name) for i in infos}
    if len(owners) <= 1 and len(infos) <= len(COMMAND_TOPICS):
        return ""
    return " and ".join(sorted(name for _, name in owners)) + f" ({len(infos)} publishers)"


class SimNode(WorkingNode):
    """Owns the episodes: it reports where each starts and ends, and how many steps it has."""

    def __init__(self) -> None:
        super().__init__("sim_node")
        self._p = p = declare(self, PARAMETERS)
        n = max(1, p["episodes"])
        began_s = time.perf_counter()
        task = TASKS[p["simulated_task"]]
        names = start_names(p["starts"] or f"generated:{p['seed']}:{n}", task.name)
        self._starts = {name: task.start(name) for name in names}
        self._expert = p["mode"] == "expert"
        if self._expert:
            self._plans = plan_episodes(
                n, p["contamination"], p["defect"], p["seed"], names, paired=p["paired"]
            )
        else:  # the commands come from another node: no defects, and the starts in their order
            k = len(names)
            self._plans = [EpisodePlan(i, names[i % k], i // k, "none", 0, 0) for i in range(n)]
        dataset = Path(p["dataset"]).expanduser()
        self._dataset = Dataset(dataset, create=True) if p["dataset"] else None
        self._env = task.environment(lean=p["lean"])
        ready_s = time.perf_counter() - began_s
        self.get_logger().info(
            f"{task.benchmark_id} and {len(names)} starts ready in {ready_s:.1f} s"
        )
        self._out = _Publishers(
            self, RobotMessages(self._env).types, owner=p["episodes"] > 0, expert=self._expert
        )
        self._commands = Commands()
        settings = DriveSettings(**{field.name: p[field.name] for field in fields(DriveSettings)})
        self._driver = Driver(self._env, task, self._out, self._commands, settings, peers=self)
        self._is_recorded = p["episodes"] > 0 and "recorder" in p["wait_for"]
        self._recorder: dict[str, Status] = {}
        self._outcomes: list[str] = []
        if not self._expert:
            for topic, kind in COMMAND_TYPES.items():
                self.create_subscription(message_type(kind), topic, self._taker(topic), MAPPED)
        self.create_subscription(DiagnosticArray, "recorder/status", self._on_recorder, LATCHED)
        self.create_service(Trigger, "~/reset", self._reset)
        self._health = Health(self)
        self._script = self._play()

    # --- messages in ------------------------------------------------------------------------

    def _taker(self, topic: str) -> Callable[[Any], None]:
        return lambda message: self._commands.take(
            topic, time_from_ros(message.header.stamp), message
        )

    def _on_recorder(self, message: DiagnosticArray) -> None:
        for status in map(status_from_ros, message.status):
            self._recorder[status.hardware_id] = status

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._driver.reset_wanted = True
        response.success, response.message = True, "the running episode is given up"
        return response

    # --- the script -------------------------------------------------------------------------

    def work(self) -> bool:
        """Resume the script; raises Finished after the last episode."""
        now_s = time.monotonic()
        if self._health.due(now_s):
            two = self._p["episodes"] > 0 and self.count_publishers("episode") > 1
            problems = ["topic episode has two owners: stop one of them"] if two else []
            commands = map(self.resolve_topic_name, COMMAND_TOPICS)
            found = publishers_found({t: self.count_publishers(t) for t in commands})
            self._health.publish(now_s, problems, {"sync": self._p["sync"], **found})
        try:
            return next(self._script)
        except StopIteration:
            raise Finished from None

    def close(self) -> None:
        """Abort the running episode, and wait until every subscriber has its end."""
        self._script.close()
        self._out.flush()
        self._env.close()

    def _play(self) -> Generator[bool, None, None]:
        """All episodes; yields to the executor, and yields True to be resumed at once."""
        yield from self._until_none(
            lambda: [n for n in self._p["wait_for"] if not self._out.is_matched(n)]
        )
        number = self._p["first_number"]
        while True:
            for plan in self._plans:
                name = f"{self._p['task']}-{number:04d}"
                episode = yield from self._driver.drive(plan, self._starts[plan.start], name)
                number += 1
                self._report(episode)
                yield from self._until_recorder(episode.id, "closed", "failed")
            if self._p["episodes"]:
                n = self._outcomes.count("succeeded")
                self.get_logger().info(f"{n} of {len(self._outcomes)} episodes succeeded")
                return

    def wait_for_recorder(self, episode_id: str) -> Iterator[bool]:
        """Wait until the recorder records an episode, if `wait_for` names it."""
        return self._until_recorder(episode_id, "recording", "closed", "failed")

    def unconfirmed(self, episode_id: str) -> str:
        """The recorder and those of our topics that it lacks in an episode, or empty."""
        status = self._recorder.get(episode_id)
        if not self._is_recorded or status is None or not status.message.startswith("recording"):
            return ""
        counts = counts_from_status(status)  # of the topics that it records
        ours = (*COMMAND_TOPICS, *self._out.observation_topics)
        missing = [topic for topic in ours if counts.get(topic) == 0]
        if not counts or not missing:
            return "" if counts else "recorder"
        return f"recorder on {' and '.join(missing)}"

    def several_commanders(self) -> str:
        """Names of the nodes that send commands if there are several, or empty."""
        return several_commanders(self)

    def _until_recorder(self, episode_id: str, *states: str) -> Iterator[bool]:
        """Wait until the recorder reports one of these states of an episode."""

        def missing() -> list[str]:
            status = self._recorder.get(episode_id)
            state = status.message.partition(" ")[0] if status is not None else ""
            return [] if state in states else ["recorder"]

        if self._is_recorded:
            yield from self._until_none(missing)

    def _until_none(self, missing: Callable[[], list[str]]) -> Iterator[bool]:
        """Wait until no node is missing, with a line in the log every few seconds."""
        reported_s = time.monotonic()
        while names := missing():
            if time.monotonic() - reported_s > _REPORT_S:
                reported_s = time.monotonic()
                self.get_logger().info(f"waiting for {', '.join(names)}")
            yield False

    def _report(self, episode: DrivenEpisode) -> None:
        """Log and publish the outcome; write the truth, apart from the data."""
        steps = f"{episode.run.n_steps} steps, reset {1e3 * episode.reset_s:.0f} ms"
        # rclpy refuses a line of code that logs with two severities.
        if episode.reason:
            self.get_logger().error(f"{episode.name}: {episode.reason} ({steps})")
        else:
            self.get_logger().info(f"{episode.name}: {episode.outcome} ({steps})")
        self._outcomes.append(episode.outcome)
        level = OK if episode.outcome == "succeeded" else ERROR
        self._out.outcome(Status(level, episode.name, episode.outcome, episode.id))
        if self._dataset is not None:
            self._dataset.append_truth(episode.truth())


def main() -> int:
    """Entry point of `ros2 run curation_ros sim_node`."""
    return run(SimNode, PARAMETERS)


if __name__ == "__main__":
    raise SystemExit(main())
