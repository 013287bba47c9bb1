"""Runs one episode: observe, get a command, step, until it has ended; the same without a graph."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.errors import SimError
from curation_ros.core.types import NS_PER_S
from sim_node.defects import DefectiveController
from sim_node.env import LiberoEnv, Observation
from sim_node.episodes import EpisodePlan
from sim_node.output import COMMAND_TOPICS, GRIPPER_JOINT, SimOutput
from sim_node.phases import PhaseTracker
from sim_node.starts import Start

Command = tuple[list[float], float]
#: Yields to the executor: True asks to be called again at once.
Script = Generator[bool, None, Command]

#: As LIBERO names it.
TASK = "libero_spatial/0"

_REPEAT_S = 0.5
_CHECK_S = 1.0
# Two nodes find each other in part of a second; on a machine that is busy, in several.
_HEARING_S = 10.0


class AbortedError(Exception):
    """The running episode cannot go on; the message says why."""


class Commands:
    """The newest message of each command topic, and the stamps that were seen."""

    def __init__(self) -> None:
        """Nothing has been commanded yet."""
        self.clear()

    def clear(self) -> None:
        """Forget everything: another episode begins."""
        self._newest: dict[str, tuple[int, Any]] = {}
        self._arrived_s = 0.0
        self._stamps: dict[str, set[int]] = {topic: set() for topic in COMMAND_TOPICS}

    def take(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Note a message."""
        self._newest[topic] = (stamp_ns, message)
        self._arrived_s = time.monotonic()
        self._stamps[topic].add(stamp_ns)

    def accept(self, stamp_ns: int) -> None:
        """Note a command that did not come as messages."""
        for stamps in self._stamps.values():
            stamps.add(stamp_ns)

    def missing(self, stamp_ns: int) -> list[str]:
        """Command topics that have not answered the observation of a stamp."""
        return [t for t in COMMAND_TOPICS if self._newest.get(t, (0,))[0] != stamp_ns]

    def is_fresh(self, timeout_s: float) -> bool:
        """Whether both topics have spoken, and the last word is not older than this."""
        whole = len(self._newest) == len(COMMAND_TOPICS)
        return whole and time.monotonic() - self._arrived_s <= timeout_s

    def counts(self, start_ns: int, end_ns: int) -> dict[str, int]:
        """Number of stamps in a window, by topic."""
        return {
            topic: sum(start_ns <= stamp <= end_ns for stamp in stamps)
            for topic, stamps in self._stamps.items()
        }

    @property
    def newest(self) -> Command:
        """Action and gripper command.

        Raises:
            AbortedError: if a message does not have what it should.
        """
        linear = self._newest[COMMAND_TOPICS[0]][1].twist.linear
        joints = self._newest[COMMAND_TOPICS[1]][1]
        if GRIPPER_JOINT not in joints.name or len(joints.position) != len(joints.name):
            raise AbortedError(f"{COMMAND_TOPICS[1]} has no position of joint {GRIPPER_JOINT!r}")
        gripper = joints.position[list(joints.name).index(GRIPPER_JOINT)]
        return [linear.x, linear.y, linear.z], gripper


@dataclass
class Run:
    """An episode, while it runs and afterwards.

    Attributes:
        id, name, plan: what it is.
        start_ns: stamp of the first observation.
        controller: the expert with its defect; None where commands come as messages.
        executed: commands executed.
        success_step: index of the one after which the goal held for the first time.
        stage: name of the phase reached.
        reason: why it was aborted, empty if it was not.
    """

    id: str
    name: str
    plan: EpisodePlan
    start_ns: int
    controller: DefectiveController | None
    executed: int = 0
    success_step: int | None = None
    stage: str = ""
    reason: str = "the sim node was stopped"
    began_s: float = field(default_factory=time.monotonic)

    @property
    def outcome(self) -> str:
        """As `episode/outcome` has it."""
        return "failed" if self.success_step is None or self.reason else "succeeded"

    def truth(self) -> dict[str, Any]:
        """A line of truth.jsonl: outcome and what was injected, for evaluation only."""
        injected = self.controller.truth() if self.controller is not None else {}
        return {
            "episode": self.id,
            "name": self.name,
            "outcome": self.outcome,
            "steps": self.executed,
            "success_step": self.success_step,
            "stage": self.stage,
            "aborted": self.reason,
            "task": TASK,
            "start": self.plan.start,
            "repetition": self.plan.repetition,
            "expert_seed": self.plan.expert_seed,
            **injected,
        }


class Driver:
    """Steps the simulator and says on the graph what is seen and done.

    Attributes:
        reset_wanted: set by the node's service; the running episode is then given up.
    """

    def __init__(
        self,
        env: LiberoEnv,
        out: SimOutput,
        commands: Commands,
        settings: Mapping[str, Any],
        announced: Callable[[str], Iterator[bool]] = lambda _id: iter(()),
        deaf: Callable[[str], str] = lambda _id: "",
        stamp_ns: int | None = None,
    ) -> None:
        """Make a driver.

        Args:
            env: the simulator.
            out: the node's publishers, or what takes their place.
            commands: filled by the node's subscriptions.
            settings: the node's parameters.
            announced: yields until who is waited for has taken notice of a started episode.
            deaf: name of who is waited for and lacks a topic of a started episode, or empty.
            stamp_ns: before the first stamp; default: the wall's time.
        """
        self._env = env
        self._out = out
        self._commands = commands
        self._p = settings
        self._announced = announced
        self._deaf = deaf
        self._checked_s = 0.0
        self.reset_wanted = False
        # Stamps begin at the wall's time and never go back, not at a reset either.
        self._stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns

    def run(
        self, plan: EpisodePlan, start: Start, name: str, episode_id: str = ""
    ) -> Generator[bool, None, Run]:
        """One episode; if the generator is closed early, the episode is aborted and said so.

        Args:
            plan: what it is.
            start: the one that the plan names.
            name: short name of the episode.
            episode_id: minted before; empty: minted now.
        """
        period_ns = self._env.control_period_ns
        observation = self._env.reset(start.state)
        tracker = PhaseTracker.from_observation(observation)
        controller = plan.controller() if self._p["mode"] == "expert" else None
        limit = self._p["max_steps"]
        if plan.defect != "none":
            limit = self._p["max_steps_defective"] or limit
        self.reset_wanted = False
        self._commands.clear()
        self._stamp_ns += period_ns
        run = Run(episode_id or new_episode_id(), name, plan, self._stamp_ns, controller)
        try:
            self._out.event(EpisodeEvent(run.id, name, "started", run.start_ns))
            yield from self._announced(run.id)
            run.began_s = time.monotonic()
            while run.executed < limit:
                self._stamp_ns = run.start_ns + run.executed * period_ns
                phase = tracker.update(observation)
                run.stage = tracker.name
                self._out.observation(self._stamp_ns, observation, tracker, run.id)
                command = yield from self._command(run, observation, tracker, phase)
                observation = self._env.step(*command)
                if run.success_step is None and self._env.is_success():
                    run.success_step = run.executed
                run.executed += 1
                after = self._p["steps_after_success"]
                if run.success_step is not None and run.executed > run.success_step + after:
                    break
                if run.controller is not None or self._p["sync"] == "free":
                    yield True  # who waits for commands yields there
            run.reason = ""
        except (AbortedError, SimError) as err:
            run.reason = str(err)
        finally:
            self._out.event(self._end(run))
        return run

    def _command(
        self, run: Run, observation: Observation, tracker: PhaseTracker, phase: int
    ) -> Script:
        """The command of this step, once it is there."""
        if self.reset_wanted:
            raise AbortedError("reset was asked for")

        def observe() -> None:
            self._out.observation(self._stamp_ns, observation, tracker, run.id)

        if run.controller is not None:
            xyz, gripper = run.controller.act(observation, phase)

            def act() -> None:
                self._out.command(self._stamp_ns, xyz, gripper)

            self._commands.accept(self._stamp_ns)
            act()
            yield from self._until_heard(run, lambda: [], observe, act)
            if run.executed == 0:  # who is free does not make up for the time that took
                run.began_s = time.monotonic()
            yield from self._paced(run)
            return list(xyz), gripper
        if self._p["sync"] == "free":
            yield from self._paced(run)
            if self._commands.is_fresh(self._p["hold_timeout_s"]):
                return self._commands.newest
            return [0.0, 0.0, 0.0], 0.0
        yield from self._until_heard(run, lambda: self._commands.missing(self._stamp_ns), observe)
        now_s = time.monotonic()
        if run.executed == 0 or now_s - self._checked_s > _CHECK_S:
            self._checked_s = now_s
            if strangers := self._out.several_commanders():
                raise AbortedError(f"commands come from {strangers}: stop all but one")
        return self._commands.newest

    def _until_heard(
        self, run: Run, missing: Callable[[], list[str]], *again: Callable[[], None]
    ) -> Iterator[bool]:
        """Wait until the command is here, and the first one where it is waited for.

        Args:
            run: the episode.
            missing: topics without an answer to this step's observation.
            again: what is said anew every half second.
        """
        asked_s = repeated_s = time.monotonic()
        while (absent := missing()) or self._unheard(run):
            now_s, timeout_s = time.monotonic(), self._p["command_timeout_s"]
            if self.reset_wanted:
                raise AbortedError("reset was asked for")
            if absent and now_s - asked_s > timeout_s:
                raise AbortedError(f"no answer on {' and '.join(absent)} within {timeout_s:g} s")
            if now_s - asked_s > timeout_s + _HEARING_S:
                raise AbortedError(f"the first step does not reach {self._unheard(run)}")
            if now_s - repeated_s > _REPEAT_S:
                repeated_s = now_s
                for say in again:
                    say()
            yield False

    def _unheard(self, run: Run) -> str:
        """Who has not got all of the first step yet.

        That we see a recorder's subscriptions, or hear a commander, does not say that the recorder
        has found our publishers, or the commander's. What follows the first step follows it
        everywhere, for the transport is reliable; until then the step is said again.
        """
        return "" if run.executed else self._deaf(run.id)

    def _paced(self, run: Run) -> Iterator[bool]:
        """Wait, when free, until the wall has come as far as the episode."""
        if self._p["sync"] == "free":
            step_s = self._env.control_period_ns / NS_PER_S / self._p["realtime_factor"]
            while (left_s := run.began_s + (run.executed + 1) * step_s - time.monotonic()) > 0:
                yield left_s < 0.001

    def _end(self, run: Run) -> EpisodeEvent:
        """How an episode ended; only what was executed belongs to it."""
        end_ns = run.start_ns + max(0, run.executed - 1) * self._env.control_period_ns
        # The first observation is in the window even if no command for it was executed.
        observed = run.executed or int(bool(run.stage))
        counts = dict.fromkeys(self._out.observation_topics, observed)
        counts |= self._commands.counts(run.start_ns, end_ns)
        kind, reason = ("aborted", f"aborted: {run.reason}") if run.reason else ("ended", "")
        return EpisodeEvent(
            run.id,
            run.name,
            kind,  # type: ignore[arg-type]  # one of the two
            run.start_ns,
            end_ns,
            counts,
            reason=reason,
        )
