"""The sim node in lockstep, with a commander that also makes mistakes."""

from __future__ import annotations

import re
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from commander import COMMANDS, Commander
from graph import LATCHED, MAPPED, DiagnosticArray, PoseStamped, Trigger
from robot import stamp_ns

from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = [pytest.mark.ros, pytest.mark.sim]
pytest.importorskip("libero", reason="LIBERO is not installed")

from sim_node.node import several_commanders  # noqa: E402 - needs LIBERO

PERIOD_NS = 50_000_000
MAX_STEPS = 12


@pytest.fixture(scope="module")
def lockstep(graph):
    """A sim node that waits for commands; each test answers one episode."""
    dataset = graph.folder / "lockstep"
    graph.start("recorder", "lockstep_recorder", dataset=dataset)
    graph.start(
        "sim_node",
        "lockstep_sim",
        dataset=dataset,
        mode="command",
        task="lockstep",
        episodes=7,
        starts="generated:0:1",
        max_steps=MAX_STEPS,
        command_timeout_s=5.0,
        wait_for=["recorder", "commander"],
    )
    commander = Commander(graph)
    seen = []
    commander.node.create_subscription(PoseStamped, "eef_pose", seen.append, MAPPED)
    # A node in `wait_for` must subscribe to the episodes.
    commander.node.create_subscription(DiagnosticArray, "episode", lambda _: None, LATCHED)
    graph._executor.add_node(commander.node)
    graph.until(
        lambda: (
            min(
                commander.twist.get_subscription_count(),
                commander.gripper.get_subscription_count(),
            )
            == 2
        ),
        "sim and recorder have discovered the commander",
    )
    yield Lockstep(graph, dataset, commander, seen)
    graph._executor.remove_node(commander.node)
    commander.close()
    code, log = graph.expect_exit("lockstep_sim")
    assert code == 0, log
    graph.stop("lockstep_recorder")


class Lockstep:
    def __init__(self, graph, dataset, commander, seen):
        self.graph = graph
        self.dataset = dataset
        self.commander = commander
        self.seen = seen
        self.last_ns = 0
        self.how = None
        self.n = 0

    def observation(self):
        """The next observation; a repeated one was not answered in time, and is again."""
        while True:
            self.graph.until(lambda: self.seen, "an observation")
            found = self.seen.pop(0)
            if stamp_ns(found) > self.last_ns:
                self.last_ns = stamp_ns(found)
                return found
            if self.how is not None and stamp_ns(found) == self.last_ns:
                self.commander.send(found, **self.how)

    def answer(self, steps, **how):
        """Answer this many observations."""
        for _ in range(steps):
            found = self.observation()
            self.how = how
            self.commander.send(found, **how)

    def answer_slowly(self, pause_s):
        """Answer the newest observation after a pause, until the episode has ended."""
        while not self._ends():
            if self.seen:
                found = self.seen[-1]
                self.seen.clear()
                self.graph.quiet(pause_s)
                self.commander.send(found)
            self.graph.spin()

    def _ends(self):
        return [e for e in self.graph.events if e.event != "started"][self.n :]

    def end(self):
        """The event that ends the running episode, and its bag."""
        event = self.graph.until(self._ends, f"end of episode {self.n}")[0]
        self.n += 1
        # Of an aborted one there is another observation, whose command was not executed.
        self.last_ns = event.end_ns + (PERIOD_NS if event.event == "aborted" else 0)
        status = self.graph.recorded(event.id)
        assert status.message.startswith("closed "), status
        return event, read_episode(self.dataset / "episodes" / event.id)


def test_late_answer_is_asked_for_again(graph, lockstep):
    lockstep.answer(4)
    first = lockstep.observation()
    graph.until(lambda: lockstep.seen, "the same observation, after half a second")
    again = lockstep.seen.pop()
    assert (again.header, again.pose) == (first.header, first.pose)
    lockstep.commander.send(again)
    lockstep.commander.send(again)
    lockstep.answer(MAX_STEPS - 5)
    event, episode = lockstep.end()
    assert (event.event, len(episode)) == ("ended", MAX_STEPS)
    assert set(event.counts.values()) == {MAX_STEPS}
    assert episode.findings == ()
    # The bag may contain repeated messages; the episode has one sample per stamp.
    assert np.unique(np.diff(episode.stamps_ns)).tolist() == [PERIOD_NS]


def test_command_that_never_comes_aborts_the_episode(graph, lockstep):
    lockstep.answer(4)
    event, episode = lockstep.end()
    assert event.event == "aborted"
    assert event.reason == ("aborted: no answer on command/twist and command/gripper within 5 s")
    assert event.end_ns == event.start_ns + 3 * PERIOD_NS
    assert set(event.counts.values()) == {4}
    assert {f.id for f in episode.findings} == {"aborted"}
    assert len(episode) == 4
    truth = graph.until(lambda: Dataset(lockstep.dataset).truth().get(event.id), "its truth")
    assert truth["aborted"] == event.reason[9:]


def test_half_a_command_does_not_count(graph, lockstep):
    lockstep.answer(1)
    lockstep.answer(1, gripper="")
    event, episode = lockstep.end()
    assert event.reason == "aborted: no answer on command/gripper within 5 s"
    assert (event.counts[COMMANDS[0]], event.counts[COMMANDS[1]]) == (1, 1)
    assert len(episode) == 1


def test_gripper_command_without_its_joint_aborts(graph, lockstep):
    lockstep.answer(2)
    lockstep.answer(1, gripper="thumb")
    event, _ = lockstep.end()
    assert event.reason == "aborted: command/gripper has no position of joint 'gripper'"


def test_second_commander_aborts_in_mid_episode(graph, lockstep):
    lockstep.answer(2)
    rival = Commander(graph, "rival")
    lockstep.answer_slowly(1.1)
    event, _ = lockstep.end()
    rival.close()
    graph.counts_publishers("sim_node", COMMANDS, 1)  # gone before the next episode
    # One of them may not have been discovered yet.
    said = r"aborted: commands come from commander and rival \([34] publishers\): stop all but one"
    assert re.fullmatch(said, event.reason)


def test_publisher_that_has_no_name_yet_is_no_second_commander():
    """The graph shows a publisher a moment before the name of its node."""

    def commanders(*names):
        seen = [SimpleNamespace(node_namespace="/", node_name=name) for name in names]
        return several_commanders(SimpleNamespace(get_publishers_info_by_topic=lambda _: seen))

    assert commanders("policy_node") == ""
    assert commanders("_NODE_NAME_UNKNOWN_") == ""
    assert commanders("policy_node", "rival") == "policy_node and rival (4 publishers)"


def test_reset_gives_the_episode_up(graph, lockstep):
    graph.client(Trigger, "sim_node/reset")
    lockstep.answer(3)
    answer = graph.call(Trigger, "sim_node/reset", Trigger.Request())
    assert answer.success
    event, _ = lockstep.end()
    assert event.reason == "aborted: reset was asked for"


def test_next_episode_runs_after_all_that(graph, lockstep):
    assert graph.nodes.ended("lockstep_sim") is None
    lockstep.answer(MAX_STEPS)
    event, episode = lockstep.end()
    assert (event.event, event.name, len(episode)) == ("ended", "lockstep-0007", MAX_STEPS)
    starts = [e.start_ns for e in graph.events if e.event == "started"]
    assert all(a < b for a, b in pairwise(starts))
