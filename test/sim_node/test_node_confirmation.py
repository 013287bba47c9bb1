"""The sim node with a recorder that lacks gripper commands: no step stays unrecorded."""

from __future__ import annotations

import pytest
from commander import Commander
from graph import LATCHED, MAPPED, DiagnosticArray, JointState, PoseStamped
from robot import stamp_ns

from curation_ros.dataset.episodes import read_episode

pytestmark = [pytest.mark.ros, pytest.mark.sim]
pytest.importorskip("libero", reason="LIBERO is not installed")

PERIOD_NS = 50_000_000
MAX_STEPS = 3


@pytest.fixture(scope="module")
def lossy(graph):
    """The recorder only receives the gripper commands that a test passes on."""
    graph.start("recorder", dataset=graph.folder / "data", remaps={"command/gripper": "passed_on"})
    graph.start(
        "sim_node",
        mode="command",
        episodes=2,
        starts="generated:0:1",
        max_steps=MAX_STEPS,
        wait_for=["recorder", "commander"],
    )
    commander = Commander(graph)
    seen = []
    commander.node.create_subscription(PoseStamped, "eef_pose", seen.append, MAPPED)
    commander.node.create_subscription(DiagnosticArray, "episode", lambda _: None, LATCHED)
    passed_on = commander.node.create_publisher(JointState, "passed_on", MAPPED)
    graph._executor.add_node(commander.node)
    yield Lossy(graph, commander, seen, passed_on)
    graph._executor.remove_node(commander.node)
    commander.close()
    graph.stop("recorder")


class Lossy:
    def __init__(self, graph, commander, seen, passed_on):
        self.graph = graph
        self.commander = commander
        self.seen = seen
        self.passed_on = passed_on

    def observation(self, after_ns=0):
        """The next observation that is later than a stamp."""
        while True:
            self.graph.until(lambda: self.seen, "an observation")
            found = self.seen.pop(0)
            if stamp_ns(found) > after_ns:
                return found

    def after(self, observation):
        """The next observation; until it comes, this one is answered each time it is repeated."""
        while True:
            self.commander.send(observation)
            self.pass_on(observation)
            found = self.observation()
            if found != observation:
                return found

    def pass_on(self, observation):
        joints = JointState(header=observation.header, name=["gripper"], position=[-1.0])
        joints.velocity, joints.effort = [0.0], [0.0]
        self.passed_on.publish(joints)

    def end(self, n):
        return self.graph.until(
            lambda: [e for e in self.graph.events if e.event != "started"][n:], f"end {n}"
        )[0]


def test_first_observation_is_repeated_until_the_recorder_has_its_answer(graph, lossy):
    first = lossy.observation()
    for _ in range(3):
        lossy.commander.send(first)
        again = lossy.observation()
        assert again == first
    second = lossy.after(first)
    third = lossy.after(second)
    assert [stamp_ns(m) - stamp_ns(first) for m in (second, third)] == [PERIOD_NS, 2 * PERIOD_NS]
    lossy.commander.send(third)
    lossy.pass_on(third)
    event = lossy.end(0)
    assert event.event == "ended"
    assert graph.recorded(event.id).message == f"closed {event.id}"
    episode = read_episode(graph.folder / "data" / "episodes" / event.id)
    assert episode.findings == ()
    assert len(episode) == MAX_STEPS
    statuses = [s for s in graph.recorders if s.hardware_id == event.id]
    states = [s.message.partition(" ")[0] for s in statuses]
    # One more status for each topic that arrives after the gripper's.
    assert (set(states[:-1]), states[-1]) == ({"recording"}, "closed")
    assert not any(key.startswith("count/") for key in statuses[0].values)
    assert "1" in [s.values.get("count/command/gripper") for s in statuses[1:-1]]


def test_recorder_that_never_has_it_aborts_the_episode(graph, lossy):
    observation = lossy.observation(lossy.end(0).end_ns)
    lossy.commander.send(observation)
    event = lossy.end(1)
    assert event.reason == "aborted: the first step does not reach recorder"
    assert event.end_ns == event.start_ns
    code, log = graph.expect_exit("sim_node")
    assert code == 0, log
