"""Sim node: LIBERO on the graph, in lockstep or free, driven by its expert or by commands."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TwistStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from curation_ros.core.errors import SimError
from curation_ros.core.identity import new_episode_id
from curation_ros.core.status import ERROR, OK, EpisodeEvent, Status
from curation_ros.core.stream import NS_PER_S
from curation_ros.dataset import Dataset
from curation_ros.nodes.health import Health
from curation_ros.nodes.messages import time_from_ros
from curation_ros.nodes.parameters import Parameter, declare
from curation_ros.nodes.qos import LATCHED, MAPPED
from curation_ros.nodes.spinning import Finished, run
from sim_node.defects import DEFECTS, DefectiveController
from sim_node.env import LiberoEnv, Observation
from sim_node.episodes import EpisodePlan, plan_episodes
from sim_node.phases import PhaseTracker
from sim_node.publishing import COMMAND_TOPICS, GRIPPER_JOINT, SimPublishers
from sim_node.starts import Start, parse_starts

PARAMETERS = (
    Parameter("mode", "expert", "who drives", choices=("expert", "command")),
    Parameter("sync", "lockstep", "when to step", choices=("lockstep", "free")),
    Parameter("episodes", 1, "how many; 0: on and on, owned by somebody else", 0, 100_000),
    Parameter("task", "bowl", "short names are <task>-<number>"),
    Parameter("first_number", 1, "number of the first episode", 0, 1_000_000),
    Parameter("seed", 0, "of order, expert and defects", 0, 2**31 - 1),
    Parameter("contamination", 0.0, "fraction of defective demonstrations", 0.0, 1.0),
    Parameter("defect", "early_release", "what is wrong with those", choices=tuple(DEFECTS)),
    Parameter("paired", False, "defective demonstrations recur on the starts of clean ones"),
    Parameter("starts", "", "official:0:50 or generated:SEED:COUNT; empty: generated, by seed"),
    Parameter("max_steps", 500, "steps after which an episode ends", 1, 100_000),
    Parameter("max_steps_defective", 0, "the same where a defect is in; 0: max_steps", 0, 100_000),
    Parameter("steps_after_success", 20, "steps recorded after success", 0, 1000),
    Parameter("dataset", "", "its truth.jsonl gets the outcomes; empty: they are not written"),
    Parameter("realtime_factor", 1.0, "speed when free", 0.01, 100.0),
    Parameter("hold_timeout_s", 0.5, "free: an older command becomes zero, s", 0.0, 60.0),
    Parameter("command_timeout_s", 5.0, "lockstep: patience for a command, s", 0.1, 3600.0),
    Parameter("wait_for", (), "nodes to wait for before the first reset; recorder: also for bags"),
    Parameter("lean", True, "our own stepping; false: LIBERO's env.step"),
)
Command = tuple[list[float], float]

_REPEAT_S = 0.5
_REPORT_S = 5.0


class AbortedError(Exception):
    """The running episode cannot go on; the message says why."""


@dataclass
class _Running:
    """The episode that is running; `accepted` are the stamps of commands that were taken."""

    id: str
    name: str
    plan: EpisodePlan
    start_ns: int
    controller: DefectiveController | None
    tracker: PhaseTracker
    began_s: float = field(default_factory=time.monotonic)
    executed: int = 0
    success_step: int | None = None
    accepted: set[int] = field(default_factory=set)


class SimNode(Node):
    """Owns the episodes: says where each starts and ends, and what was executed in between."""

    def __init__(self) -> None:
        super().__init__("sim_node")
        self._p = p = declare(self, PARAMETERS)
        n = max(1, p["episodes"])
        began_s = time.perf_counter()
        starts = parse_starts(p["starts"] or f"generated:{p['seed']}:{n}")
        self._starts = {start.name: start for start in starts}
        names = list(self._starts)
        self._expert = p["mode"] == "expert"
        if self._expert:
            self._plans = plan_episodes(
                n, p["contamination"], p["defect"], p["seed"], names, paired=p["paired"]
            )
        else:  # nothing to inject into somebody else's commands: the starts in their order
            k = len(names)
            self._plans = [EpisodePlan(i, names[i % k], i // k, "none", 0, 0) for i in range(n)]
        dataset = Path(p["dataset"]).expanduser()
        self._dataset = Dataset(dataset, create=True) if p["dataset"] else None
        self._env = LiberoEnv(lean=p["lean"])
        ready_s = time.perf_counter() - began_s
        self.get_logger().info(f"LIBERO and {len(starts)} starts ready in {ready_s:.1f} s")
        self._out = SimPublishers(self, self._env, owner=p["episodes"] > 0, expert=self._expert)
        self._commands: dict[str, tuple[int, Any]] = {}
        self._commanded_s = 0.0
        self._recorder: dict[str, str] = {}
        self._reset_wanted = False
        self._running: _Running | None = None
        if not self._expert:
            for topic, kind in zip(COMMAND_TOPICS, (TwistStamped, JointState), strict=True):
                self.create_subscription(kind, topic, self._taker(topic), MAPPED)
        self.create_subscription(DiagnosticArray, "recorder/status", self._on_recorder, LATCHED)
        self.create_service(Trigger, "~/reset", self._reset)
        self._health = Health(self)
        # Stamps begin at the wall's time and never go back, not at a reset either.
        self._stamp_ns = time.time_ns()
        self._script = self._play()

    # --- messages in ------------------------------------------------------------------------

    def _taker(self, topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            stamp_ns = time_from_ros(message.header.stamp)
            self._commands[topic] = (stamp_ns, message)
            self._commanded_s = time.monotonic()
            if self._running is not None and topic == COMMAND_TOPICS[0]:
                self._running.accepted.add(stamp_ns)

        return take

    def _on_recorder(self, message: DiagnosticArray) -> None:
        status = message.status[0]
        self._recorder[status.hardware_id] = status.message.partition(" ")[0]

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset_wanted = True
        response.success, response.message = True, "the running episode is given up"
        return response

    # --- the script -------------------------------------------------------------------------

    def work(self) -> bool:
        """Go on with the script; raises Finished after the last episode."""
        now_s = time.monotonic()
        if self._health.due(now_s):
            two = self._p["episodes"] > 0 and self.count_publishers("episode") > 1
            problems = ["topic episode has two owners: stop one of them"] if two else []
            self._health.publish(now_s, problems, {"sync": self._p["sync"]})
        try:
            return next(self._script)
        except StopIteration:
            raise Finished from None

    def close(self) -> None:
        """Give up the running episode, saying so."""
        self._script.close()
        self._env.close()

    def _play(self) -> Generator[bool, None, None]:
        """All episodes; a generator that yields to the executor, True to go on at once."""
        reported_s = time.monotonic()
        while missing := [n for n in self._p["wait_for"] if not self._out.is_matched(n)]:
            if time.monotonic() - reported_s > _REPORT_S:
                reported_s = time.monotonic()
                self.get_logger().info(f"waiting for {', '.join(missing)}")
            yield False
        number = self._p["first_number"]
        while True:
            for plan in self._plans:
                name = f"{self._p['task']}-{number:04d}"
                episode_id = yield from self._episode(plan, self._starts[plan.start], name)
                number += 1
                if "recorder" in self._p["wait_for"]:
                    while self._recorder.get(episode_id) not in ("closed", "failed"):
                        yield False
            if self._p["episodes"]:
                self._out.flush()
                return

    def _episode(self, plan: EpisodePlan, start: Start, name: str) -> Generator[bool, None, str]:
        period_ns = self._env.control_period_ns
        observation = self._env.reset(start.state)
        self.get_logger().info(f"{name}: reset in {1e3 * self._env.reset_s:.0f} ms")
        tracker = PhaseTracker.from_observation(observation)
        controller = plan.controller() if self._expert else None
        limit = self._p["max_steps"]
        if plan.defect != "none":
            limit = self._p["max_steps_defective"] or limit
        self._stamp_ns += period_ns
        self._reset_wanted = False
        self._commands.clear()
        self._running = r = _Running(
            new_episode_id(), name, plan, self._stamp_ns, controller, tracker
        )
        reason = "the sim node was stopped"
        try:
            self._out.event(EpisodeEvent(r.id, name, "started", r.start_ns))
            while r.executed < limit:
                self._stamp_ns = r.start_ns + r.executed * period_ns
                phase = tracker.update(observation)
                self._out.observation(self._stamp_ns, observation, tracker, r.id)
                command = yield from self._command(r, observation, tracker, phase)
                observation = self._env.step(*command)
                if r.success_step is None and self._env.is_success():
                    r.success_step = r.executed
                r.executed += 1
                after = self._p["steps_after_success"]
                if r.success_step is not None and r.executed > r.success_step + after:
                    break
                yield True
            reason = ""
        except (AbortedError, SimError) as err:
            reason = str(err)
        finally:
            self._end(r, reason)
        return r.id

    def _command(
        self, r: _Running, observation: Observation, tracker: PhaseTracker, phase: int
    ) -> Generator[bool, None, Command]:
        """The command of this step, once it is there."""
        if self._reset_wanted:
            raise AbortedError("reset was asked for")
        if r.controller is not None:
            xyz, gripper = r.controller.act(observation, phase)
            self._out.command(self._stamp_ns, xyz, gripper)
            r.accepted.add(self._stamp_ns)
            yield from self._paced(r)
            return list(xyz), gripper
        if self._p["sync"] == "free":
            yield from self._paced(r)
            fresh = time.monotonic() - self._commanded_s <= self._p["hold_timeout_s"]
            whole = fresh and len(self._commands) == len(COMMAND_TOPICS)
            return self._taken() if whole else ([0.0] * 3, 0.0)
        asked_s = repeated_s = time.monotonic()
        while missing := [
            t for t in COMMAND_TOPICS if self._commands.get(t, (0,))[0] != self._stamp_ns
        ]:
            now_s = time.monotonic()
            if self._reset_wanted:
                raise AbortedError("reset was asked for")
            if now_s - asked_s > self._p["command_timeout_s"]:
                timeout_s = self._p["command_timeout_s"]
                raise AbortedError(f"no answer on {' and '.join(missing)} within {timeout_s:g} s")
            if now_s - repeated_s > _REPEAT_S:
                repeated_s = now_s
                self._out.observation(self._stamp_ns, observation, tracker, r.id)
            yield False
        if r.executed == 0:
            self._check_commanders()
        return self._taken()

    def _taken(self) -> Command:
        linear = self._commands[COMMAND_TOPICS[0]][1].twist.linear
        joints = self._commands[COMMAND_TOPICS[1]][1]
        if GRIPPER_JOINT not in joints.name or len(joints.position) != len(joints.name):
            raise AbortedError(f"{COMMAND_TOPICS[1]} has no position of joint {GRIPPER_JOINT!r}")
        gripper = joints.position[list(joints.name).index(GRIPPER_JOINT)]
        return [linear.x, linear.y, linear.z], gripper

    def _check_commanders(self) -> None:
        infos = [i for t in COMMAND_TOPICS for i in self.get_publishers_info_by_topic(t)]
        owners = {(i.node_namespace, i.node_name) for i in infos}
        if len(owners) > 1 or len(infos) > len(COMMAND_TOPICS):
            names = ", ".join(sorted(name for _, name in owners))
            raise AbortedError(
                f"commands come from several publishers ({names}): stop all but one"
            )

    def _paced(self, r: _Running) -> Iterator[bool]:
        """Wait, when free, until the wall has come as far as the episode."""
        if self._p["sync"] == "free":
            step_s = self._env.control_period_ns / NS_PER_S / self._p["realtime_factor"]
            while (left_s := r.began_s + (r.executed + 1) * step_s - time.monotonic()) > 0:
                yield left_s < 0.001

    def _end(self, r: _Running, reason: str) -> None:
        """Say and log how an episode ended; only what was executed belongs to it."""
        self._running = None
        end_ns = r.start_ns + max(0, r.executed - 1) * self._env.control_period_ns
        self._stamp_ns = max(self._stamp_ns, end_ns)
        commands = sum(r.start_ns <= stamp <= end_ns for stamp in r.accepted)
        counts = dict.fromkeys(self._out.observation_topics, r.executed)
        counts |= dict.fromkeys(COMMAND_TOPICS, commands)
        event = EpisodeEvent(r.id, r.name, "ended", r.start_ns, end_ns, counts)
        if reason:
            aborted = f"aborted: {reason}"
            event = EpisodeEvent(
                r.id, r.name, "aborted", r.start_ns, end_ns, counts, reason=aborted
            )
            self.get_logger().error(f"{r.name} aborted: {reason}")
        self._out.event(event)
        succeeded = r.success_step is not None and not reason
        outcome = "succeeded" if succeeded else "failed"
        self._out.outcome(Status(OK if succeeded else ERROR, r.name, outcome, r.id), end_ns)
        if self._dataset is not None:
            truth = r.controller.truth() if r.controller is not None else {}
            self._dataset.append_truth(
                {
                    "episode": r.id,
                    "name": r.name,
                    "outcome": outcome,
                    "steps": r.executed,
                    "success_step": r.success_step,
                    "stage": r.tracker.name,
                    "aborted": reason,
                    "start": r.plan.start,
                    "repetition": r.plan.repetition,
                    "expert_seed": r.plan.expert_seed,
                    **truth,
                }
            )


def main() -> int:
    """Entry point of `ros2 run curation_ros sim_node`."""
    return run(SimNode)


if __name__ == "__main__":
    raise SystemExit(main())
