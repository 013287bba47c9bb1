"""Drives episodes of the sim node: sends what is observed, gets commands, and reports each end.

Collections run the same code without a graph, see `curation_ros.study.collect`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np

from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.messages import PlainMessage
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.errors import SimError
from curation_ros.core.types import NS_PER_S
from sim_node.defects import DefectiveController
from sim_node.environment import Command, Environment
from sim_node.episodes import Pilot, Run
from sim_node.messages import COMMAND_TOPICS, GRIPPER_JOINT, RobotMessages, command_messages
from sim_node.planning import EpisodePlan
from sim_node.settings import DriveSettings
from sim_node.starts import Start
from sim_node.tasks.task import Step, Task

#: Yields to the executor until its result is there; True asks to be resumed at once.
CommandScript = Generator[bool, None, Command]

_REPEAT_S = 0.5
_CHECK_S = 1.0
# Discovery between two nodes takes part of a second; on a busy machine, several seconds.
_CONFIRM_S = 10.0


class AbortedError(Exception):
    """The running episode cannot go on; the message says why."""


class Output(Protocol):
    """Takes what the sim node sends: publishers on a graph, a bag without one."""

    def send(self, message: PlainMessage) -> None:
        """Send a message of an observation or a command."""

    def event(self, event: EpisodeEvent) -> None:
        """Send an event of an episode."""


class Peers(Protocol):
    """The other nodes of the graph, as far as an episode depends on them."""

    def wait_for_recorder(self, episode_id: str) -> Iterator[bool]:
        """Yield until the recorder, if there is one to wait for, records a started episode."""

    def unconfirmed(self, episode_id: str) -> str:
        """The recorder and the topics of a started episode that it still lacks, or empty."""

    def several_commanders(self) -> str:
        """Names of the nodes that send commands if there are several, or empty."""


class NoPeers:
    """Where there is no graph, there is nothing to wait for."""

    def wait_for_recorder(self, episode_id: str) -> Iterator[bool]:
        """Nothing."""
        del episode_id
        yield from ()

    def unconfirmed(self, episode_id: str) -> str:
        """Empty."""
        del episode_id
        return ""

    def several_commanders(self) -> str:
        """Empty."""
        return ""


class Commands:
    """The newest message of each command topic, and the distinct stamps of all of them."""

    def __init__(self) -> None:
        """Start without any command."""
        self.clear()

    def clear(self) -> None:
        """Forget everything: another episode begins."""
        self._newest: dict[str, tuple[int, Any]] = {}
        self._arrived_s = 0.0
        self._stamps: dict[str, set[int]] = {topic: set() for topic in COMMAND_TOPICS}

    def take(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Keep a message."""
        self._newest[topic] = (stamp_ns, message)
        self._arrived_s = time.monotonic()
        self._stamps[topic].add(stamp_ns)

    def accept(self, stamp_ns: int) -> None:
        """Count a command that did not arrive as messages."""
        for stamps in self._stamps.values():
            stamps.add(stamp_ns)

    def missing(self, stamp_ns: int) -> list[str]:
        """Command topics that have not answered the observation of a stamp."""
        return [t for t in COMMAND_TOPICS if self._newest.get(t, (0,))[0] != stamp_ns]

    def is_fresh(self, timeout_s: float) -> bool:
        """Whether both topics have a message, and the last one is not older than this."""
        is_whole = len(self._newest) == len(COMMAND_TOPICS)
        return is_whole and time.monotonic() - self._arrived_s <= timeout_s

    def counts(self, start_ns: int, end_ns: int) -> dict[str, int]:
        """Number of distinct stamps in a window, by topic."""
        return {
            topic: sum(start_ns <= stamp <= end_ns for stamp in stamps)
            for topic, stamps in self._stamps.items()
        }

    @property
    def newest(self) -> Command:
        """The newest command.

        Raises:
            AbortedError: if a message lacks a value.
        """
        linear = self._newest[COMMAND_TOPICS[0]][1].twist.linear
        joints = self._newest[COMMAND_TOPICS[1]][1]
        if GRIPPER_JOINT not in joints.name or len(joints.position) != len(joints.name):
            raise AbortedError(f"{COMMAND_TOPICS[1]} has no position of joint {GRIPPER_JOINT!r}")
        gripper = joints.position[list(joints.name).index(GRIPPER_JOINT)]
        return Command(np.array([linear.x, linear.y, linear.z]), gripper)


@dataclass
class DrivenEpisode:
    """An episode of the sim node, while it runs and afterwards.

    Attributes:
        id: uuid of the episode.
        name: short name.
        task: what was to be done.
        plan: what was planned.
        start_ns: stamp of the first observation.
        run: the loop.
        controller: the expert with its defect; None where commands arrive as messages.
        reset_s: seconds that the reset took.
        reason: why the episode was aborted; empty if it was not.
    """

    id: str
    name: str
    task: Task
    plan: EpisodePlan
    start_ns: int
    run: Run
    controller: DefectiveController | None
    reset_s: float
    reason: str = "the sim node was stopped"

    @property
    def outcome(self) -> str:
        """`succeeded` or `failed`, as topic `episode/outcome` has it."""
        return "failed" if self.run.success_step is None or self.reason else "succeeded"

    def truth(self) -> dict[str, Any]:
        """The line of truth.jsonl: outcome and what was injected, for evaluation only."""
        injected = self.controller.truth() if self.controller is not None else {}
        return {
            "episode": self.id,
            "name": self.name,
            "outcome": self.outcome,
            "steps": self.run.n_steps,
            "success_step": self.run.success_step,
            "stage": self.run.stage,
            "aborted": self.reason,
            "task": self.task.benchmark_id,
            "start": self.plan.start,
            "repetition": self.plan.repetition,
            "expert_seed": self.plan.expert_seed,
            **injected,
        }


class Driver:
    """Plays episodes: the commands come from the expert or from messages.

    Args:
        env: the simulator.
        task: what is to be done in it.
        out: where observations, commands and events go.
        commands: filled by the node's subscriptions.
        settings: how to drive.
        peers: the other nodes.
        stamp_ns: before the first stamp; default: the time of the wall clock.

    Attributes:
        reset_wanted: set by the node's service; the running episode is then given up.
    """

    def __init__(
        self,
        env: Environment,
        task: Task,
        out: Output,
        commands: Commands,
        settings: DriveSettings,
        peers: Peers | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        self._env = env
        self._task = task
        self._out = out
        self._messages = RobotMessages(env)
        self._commands = commands
        self._settings = settings
        self._peers = peers if peers is not None else NoPeers()
        self._checked_s = 0.0
        self._began_s = 0.0
        self.reset_wanted = False
        # Stamps begin at the wall clock's time and never go back, not even at a reset.
        self._stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns

    def drive(
        self, plan: EpisodePlan, start: Start, name: str, episode_id: str = ""
    ) -> Generator[bool, None, DrivenEpisode]:
        """Play one episode; closing the generator early aborts it and reports that.

        Args:
            plan: what to do.
            start: the start that the plan names.
            name: short name of the episode.
            episode_id: its uuid; empty: a new one.

        Raises:
            ConfigError: if the limits of the settings are out of range.
            SimError: if the simulation diverges before the episode has started.
        """
        began_s = time.monotonic()
        limits = self._settings.limits(is_defective=plan.defect != "none")
        run = Run(self._env, self._task, start, limits)
        reset_s = time.monotonic() - began_s
        controller = plan.controller(self._task) if self._settings.mode == "expert" else None
        self.reset_wanted = False
        self._commands.clear()
        self._stamp_ns += self._env.control_period_ns
        episode = DrivenEpisode(
            id=episode_id or new_episode_id(),
            name=name,
            task=self._task,
            plan=plan,
            start_ns=self._stamp_ns,
            run=run,
            controller=controller,
            reset_s=reset_s,
        )
        pilot: Pilot = partial(self._answer_by_messages, episode)
        if controller is not None:
            pilot = partial(self._answer_by_expert, episode, controller)
        try:
            self._out.event(EpisodeEvent(episode.id, name, "started", episode.start_ns))
            yield from self._peers.wait_for_recorder(episode.id)
            self._began_s = time.monotonic()
            yield from run.play(pilot)
            episode.reason = ""
        except (AbortedError, SimError) as err:
            episode.reason = str(err)
        finally:
            self._out.event(self._end(episode))
        return episode

    def _answer_by_expert(
        self, episode: DrivenEpisode, controller: DefectiveController, step: Step
    ) -> CommandScript:
        """The expert's command, once the first one has reached the recorder."""
        if step.index > 0:
            yield True  # nothing else here lets the executor work
        observe = self._observe(episode, step)
        command = Command(*controller.act(step))

        def act() -> None:
            for message in command_messages(self._stamp_ns, command):
                self._out.send(message)

        self._commands.accept(self._stamp_ns)
        act()
        yield from self._until_confirmed(episode, lambda: [], observe, act)
        if step.index == 0:  # the pace does not make up for the time that this took
            self._began_s = time.monotonic()
        yield from self._paced(step)
        return command

    def _answer_by_messages(self, episode: DrivenEpisode, step: Step) -> CommandScript:
        """The command that arrives as messages."""
        settings = self._settings
        if settings.sync == "free":
            if step.index > 0:
                yield True
            self._observe(episode, step)
            yield from self._paced(step)
            if self._commands.is_fresh(settings.hold_timeout_s):
                return self._commands.newest
            return Command(np.zeros(3), 0.0)
        observe = self._observe(episode, step)
        yield from self._until_confirmed(
            episode, lambda: self._commands.missing(self._stamp_ns), observe
        )
        now_s = time.monotonic()
        if step.index == 0 or now_s - self._checked_s > _CHECK_S:
            self._checked_s = now_s
            if commanders := self._peers.several_commanders():
                raise AbortedError(f"commands come from {commanders}: stop all but one")
        return self._commands.newest

    def _observe(self, episode: DrivenEpisode, step: Step) -> Callable[[], None]:
        """Send the observation of a step; what is returned sends it again."""
        self._stamp_ns = episode.start_ns + step.index * self._env.control_period_ns

        def send() -> None:
            for message in self._messages.observation(self._stamp_ns, step, episode.id):
                self._out.send(message)

        send()
        if self.reset_wanted:
            raise AbortedError("reset was asked for")
        return send

    def _until_confirmed(
        self, episode: DrivenEpisode, missing: Callable[[], list[str]], *again: Callable[[], None]
    ) -> Iterator[bool]:
        """Wait for the command; in the first step also until the recorder has all of the step.

        That we have discovered the recorder's subscriptions does not mean that the recorder has
        discovered our publishers, or the commander's: the first step is repeated until the
        recorder has it. All later steps follow on the same reliable connections.

        Args:
            episode: the episode.
            missing: gives the topics without an answer to this step's observation.
            again: called every half second.
        """
        timeout_s = self._settings.command_timeout_s
        asked_s = repeated_s = time.monotonic()
        while (absent := missing()) or self._unconfirmed(episode):
            now_s = time.monotonic()
            if self.reset_wanted:
                raise AbortedError("reset was asked for")
            if absent and now_s - asked_s > timeout_s:
                raise AbortedError(f"no answer on {' and '.join(absent)} within {timeout_s:g} s")
            if now_s - asked_s > timeout_s + _CONFIRM_S:
                lacking = self._unconfirmed(episode)
                raise AbortedError(f"the first step does not reach {lacking}")
            if now_s - repeated_s > _REPEAT_S:
                repeated_s = now_s
                for send in again:
                    send()
            yield False

    def _unconfirmed(self, episode: DrivenEpisode) -> str:
        return "" if episode.run.n_steps else self._peers.unconfirmed(episode.id)

    def _paced(self, step: Step) -> Iterator[bool]:
        """In `free`, wait until the wall clock has come as far as the episode."""
        if self._settings.sync == "free":
            step_s = self._env.control_period_ns / NS_PER_S / self._settings.realtime_factor
            while (left_s := self._began_s + (step.index + 1) * step_s - time.monotonic()) > 0:
                yield left_s < 0.001

    def _end(self, episode: DrivenEpisode) -> EpisodeEvent:
        """The event that ends an episode; only what was executed belongs to it."""
        run = episode.run
        end_ns = episode.start_ns + max(0, run.n_steps - 1) * self._env.control_period_ns
        # The first observation is in the window even if no command for it was executed.
        n_observed = run.n_steps or int(bool(run.stage))
        counts = dict.fromkeys(self._messages.types, n_observed)
        counts |= self._commands.counts(episode.start_ns, end_ns)
        return EpisodeEvent(
            episode.id,
            episode.name,
            "aborted" if episode.reason else "ended",
            episode.start_ns,
            end_ns,
            counts,
            reason=f"aborted: {episode.reason}" if episode.reason else "",
        )
