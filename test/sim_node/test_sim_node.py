"""The sim node on a graph: lockstep and free, its expert and a scripted commander."""

from __future__ import annotations

import importlib.util
import signal
from itertools import pairwise

import numpy as np
import pytest
from graph import MAPPED, DescribeParameters, JointState, PoseStamped, Trigger, TwistStamped
from robot import Robot, stamp_ns

from curation_ros.bags.reader import open_bag, read_episode
from curation_ros.dataset import Dataset

pytestmark = [pytest.mark.ros, pytest.mark.sim]

PERIOD_NS = 50_000_000
COMMANDS = ("command/twist", "command/gripper")
OBSERVATIONS = ("joint_states", "eef_pose", "phase")
MAX_STEPS = 12


@pytest.fixture(autouse=True)
def _simulator():
    if importlib.util.find_spec("libero") is None:
        pytest.skip("LIBERO is not installed")


def ended(graph, n):
    """Wait for the n-th end of an episode."""
    ends = graph.until(
        lambda: (found := [e for e in graph.events if e.event != "started"])[n:] and found,
        f"end of episode {n}",
    )
    return ends[n]


class Commander:
    """Answers each observation with what a script says; it sees the tool and nothing else."""

    def __init__(self, graph, name="commander"):
        import rclpy

        self.graph = graph
        self.node = rclpy.create_node(name, context=graph.context, enable_rosout=False)
        self.twist = self.node.create_publisher(TwistStamped, COMMANDS[0], MAPPED)
        self.gripper = self.node.create_publisher(JointState, COMMANDS[1], MAPPED)

    def close(self):
        self.node.destroy_node()

    def say(self, message, z=0.0, *, twist=True, gripper="gripper"):
        """Answer one observation."""
        if twist:
            command = TwistStamped(header=message.header)
            command.twist.linear.z = z
            self.twist.publish(command)
        if gripper:
            joints = JointState(header=message.header, name=[gripper], position=[-1.0])
            joints.velocity, joints.effort = [0.0], [0.0]
            self.gripper.publish(joints)


# --- the expert -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def expert(graph):
    """Two episodes of the expert, recorded."""
    dataset = graph.folder / "expert"
    graph.start(
        "sim_node",
        dataset=dataset,
        episodes=2,
        contamination=0.5,
        max_steps_defective=120,
        seed=3,
        wait_for=["recorder"],
    )
    problem = "topic episode has two owners: stop one of them"
    with Robot(graph, types={}, name="usurper"):
        assert graph.problem("sim_node", problem).level == 2
    graph.start("recorder", dataset=dataset)
    code, log = graph.expect_exit("sim_node")
    assert code == 0, log
    graph.stop("recorder")
    return dataset


def test_expert_episodes_are_recorded_whole(graph, expert):
    starts = [e for e in graph.events if e.event == "started"]
    ends = [e for e in graph.events if e.event == "ended"]
    assert [e.id for e in starts] == [e.id for e in ends]
    assert [e.name for e in starts] == ["bowl-0001", "bowl-0002"]
    for event in ends:
        episode = read_episode(expert / "episodes" / event.id)
        assert episode.findings == ()
        # The end is the last observation whose command was executed; counts are distinct stamps.
        n = len(episode)
        assert event.end_ns == event.start_ns + (n - 1) * PERIOD_NS
        assert episode.stamps_ns.tolist() == list(
            range(event.start_ns, event.end_ns + 1, PERIOD_NS)
        )
        bag = open_bag(expert / "episodes" / event.id)
        assert set(event.counts) >= {*OBSERVATIONS, *COMMANDS}
        assert set(event.counts.values()) == {n}
        assert {topic.count for topic in bag.topics.values()} == {n}


def test_stamps_never_go_back_over_a_reset(graph, expert):
    first, second = (e for e in graph.events if e.event == "ended")
    assert second.start_ns > first.end_ns


def test_outcome_and_truth_travel_apart_from_the_data(graph, expert):
    ids = [e.id for e in graph.events if e.event == "ended"]
    truth = Dataset(expert).truth()
    assert set(truth) == set(ids)
    assert sorted(t["defect"] for t in truth.values()) == ["early_release", "none"]
    for episode_id, line in truth.items():
        wanted = "failed" if line["defect"] == "early_release" else "succeeded"
        assert line["outcome"] == wanted
        said = [s.message for s in graph.outcomes if s.hardware_id == episode_id]
        assert said == [wanted]
        bag = open_bag(expert / "episodes" / episode_id)
        assert not [t for t in bag.topics if "outcome" in t or t in ("/episode", "/clock")]
        files = b"".join(p.read_bytes() for p in bag.path.iterdir())
        assert not [word for word in (b"early_release", b"succeeded", b"defect") if word in files]


# --- commands in lockstep -------------------------------------------------------------------


@pytest.fixture(scope="module")
def lockstep(graph, expert):
    """A sim node that waits for commands; tests answer it, one episode after the other."""
    dataset = graph.folder / "lockstep"
    graph.events.clear()
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
        command_timeout_s=1.2,
        wait_for=["recorder", "commander"],
    )
    commander = Commander(graph)
    seen = []
    # Created last: it is there for the sim as soon as it hears something.
    commander.node.create_subscription(PoseStamped, "eef_pose", seen.append, MAPPED)
    graph._executor.add_node(commander.node)
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
        self.n = 0

    def observation(self):
        """The next observation."""
        self.graph.until(lambda: self.seen, "an observation")
        return self.seen.pop(0)

    def answer(self, steps, **how):
        """Answer so many observations; repeated ones as they come."""
        for _ in range(steps):
            self.commander.say(self.observation(), **how)

    def end(self):
        """The event that ends the running episode, and its bag."""
        event = ended(self.graph, self.n)
        self.n += 1
        status = self.graph.recorded(event.id)
        assert status.message.startswith("closed "), status
        return event, read_episode(self.dataset / "episodes" / event.id)


def test_late_answer_is_asked_for_again(graph, lockstep):
    lockstep.answer(4)
    first = lockstep.observation()
    again = lockstep.observation()  # after half a second
    assert (again.header, again.pose) == (first.header, first.pose)
    lockstep.commander.say(again)
    lockstep.commander.say(again)
    lockstep.answer(MAX_STEPS - 5)
    event, episode = lockstep.end()
    assert (event.event, len(episode)) == ("ended", MAX_STEPS)
    assert set(event.counts.values()) == {MAX_STEPS}
    assert episode.findings == ()
    # The bag may hold what was sent twice; the episode has one sample a stamp.
    assert np.unique(np.diff(episode.stamps_ns)).tolist() == [PERIOD_NS]


def test_command_that_never_comes_aborts_the_episode(graph, lockstep):
    lockstep.answer(4)
    event, episode = lockstep.end()
    lockstep.seen.clear()
    assert event.event == "aborted"
    assert event.reason == ("aborted: no answer on command/twist and command/gripper within 1.2 s")
    assert event.end_ns == event.start_ns + 3 * PERIOD_NS
    assert set(event.counts.values()) == {4}
    assert {f.id for f in episode.findings} == {"aborted"}
    assert len(episode) == 4
    assert Dataset(lockstep.dataset).truth()[event.id]["aborted"] == event.reason[9:]


def test_half_a_command_is_none(graph, lockstep):
    lockstep.answer(1)
    lockstep.answer(1, gripper="")
    event, episode = lockstep.end()
    lockstep.seen.clear()
    assert event.reason == "aborted: no answer on command/gripper within 1.2 s"
    assert (event.counts[COMMANDS[0]], event.counts[COMMANDS[1]]) == (1, 1)
    assert len(episode) == 1


def test_gripper_command_without_its_joint_aborts(graph, lockstep):
    lockstep.answer(2)
    lockstep.answer(1, gripper="thumb")
    event, _ = lockstep.end()
    assert event.reason == "aborted: command/gripper has no position of joint 'gripper'"


def test_second_commander_aborts_in_mid_episode(graph, lockstep):
    lockstep.answer(2)
    observation = lockstep.observation()
    rival = Commander(graph, "rival")
    graph.quiet(1.1)
    lockstep.seen.clear()
    lockstep.commander.say(observation)
    event, _ = lockstep.end()
    rival.close()
    assert event.reason == (
        "aborted: commands come from commander and rival (4 publishers): stop all but one"
    )
    lockstep.seen.clear()


def test_reset_gives_the_episode_up(graph, lockstep):
    lockstep.answer(3)
    answer = graph.call(Trigger, "sim_node/reset", Trigger.Request())
    assert answer.success
    event, _ = lockstep.end()
    assert event.reason == "aborted: reset was asked for"
    lockstep.seen.clear()


def test_next_episode_runs_after_all_that(graph, lockstep):
    assert graph.nodes.ended("lockstep_sim") is None
    lockstep.answer(MAX_STEPS)
    event, episode = lockstep.end()
    assert (event.event, event.name, len(episode)) == ("ended", "lockstep-0007", MAX_STEPS)
    starts = [e.start_ns for e in graph.events if e.event == "started"]
    assert all(a < b for a, b in pairwise(starts))


# --- free, driven by a person ---------------------------------------------------------------


@pytest.fixture(scope="module")
def free(graph, lockstep):
    """Nobody's episodes, on and on at five times real time, and a recorder driven by hand."""
    dataset = graph.folder / "free"
    graph.start(
        "sim_node",
        "free_sim",
        mode="command",
        sync="free",
        episodes=0,
        starts="generated:0:1",
        max_steps=100_000,
        realtime_factor=5.0,
        hold_timeout_s=0.4,
    )
    graph.start(
        "recorder", "free_recorder", {"__node": "free_recorder"}, dataset=dataset, auto=False
    )
    seen = []
    graph.node.create_subscription(PoseStamped, "eef_pose", seen.append, MAPPED)
    commander = Commander(graph, "person")
    graph.until(lambda: commander.twist.get_subscription_count() >= 2 and seen, "sim and recorder")
    graph.quiet(0.5)
    yield dataset, commander, seen
    commander.close()


def by_hand(graph, service):
    answer = graph.call(Trigger, f"free_recorder/{service}", Trigger.Request())
    assert answer.success, answer.message
    return answer


def test_free_command_is_held_and_then_zeroed(graph, free):
    dataset, commander, seen = free
    by_hand(graph, "start")
    graph.quiet(0.2)
    commander.say(seen[-1], z=1.0)
    commanded_ns = stamp_ns(seen[-1])
    graph.quiet(1.2)
    end_ns = stamp_ns(seen[-1])
    by_hand(graph, "stop")
    episode_id = next(reversed(graph.events)).id
    graph.recorded(episode_id)
    episode = read_episode(dataset / "episodes" / episode_id)
    assert len(episode) > 60
    height, stamps = episode.field("eef_position")[:, 2], episode.stamps_ns
    # Five times real time: held for 0.4 s, which are 2 s of the arm.
    rising = height[np.searchsorted(stamps, commanded_ns + int(1.5e9))] - height[0]
    after = height[np.searchsorted(stamps, commanded_ns + int(4e9)) :]
    assert rising > 0.05
    assert end_ns - commanded_ns > int(4.5e9)
    assert np.ptp(after) < 0.005
    bag = open_bag(dataset / "episodes" / episode_id)
    assert bag.topics[f"/{COMMANDS[0]}"].count == 1


def test_sim_that_owns_no_episode_does_not_say_so(graph, free):
    owners = graph.node.get_publishers_info_by_topic("episode")
    assert [info.node_name for info in owners] == ["free_recorder"]


def test_reset_inside_an_episode_of_somebody_else(graph, free):
    dataset, _, seen = free
    by_hand(graph, "start")
    graph.quiet(0.2)
    graph.call(Trigger, "sim_node/reset", Trigger.Request())
    n = len(seen)
    graph.until(lambda: len(seen) > n + 10, "the sim goes on")
    by_hand(graph, "stop")
    episode_id = next(reversed(graph.events)).id
    graph.recorded(episode_id)
    episode = read_episode(dataset / "episodes" / episode_id)
    assert "clock-back" not in {f.id for f in episode.findings}
    assert (np.diff(episode.stamps_ns) > 0).all()


def test_parameters_are_described_and_read_only(graph, free):
    from sim_node.node import PARAMETERS

    names = [p.name for p in PARAMETERS]
    request = DescribeParameters.Request(names=names)
    described = graph.call(DescribeParameters, "sim_node/describe_parameters", request)
    assert [d.name for d in described.descriptors] == names
    assert all(d.description and d.read_only for d in described.descriptors)
    ranges = {d.name: d.floating_point_range for d in described.descriptors}
    assert ranges["contamination"][0].to_value == 1.0


def test_stopped_free_sim_ends_cleanly(graph, free):
    graph.nodes.send("free_sim", signal.SIGTERM)
    code, log = graph.expect_exit("free_sim")
    assert code == 0
    assert "Traceback" not in log


# --- errors ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parameter", "value", "complaint"),
    [
        ("contamination", 2.0, "parameter 'contamination': expected float in [0.0, 1.0]"),
        ("mode", "dance", "parameter 'mode': 'dance' is none of expert, command"),
        ("starts", "nonsense", "expected official:FIRST:END, generated:SEED:COUNT"),
    ],
)
def test_wrong_parameter_is_one_line_and_code_2(graph, parameter, value, complaint):
    graph.start("sim_node", f"wrong_{parameter}", **{parameter: value})
    code, log = graph.expect_exit(f"wrong_{parameter}")
    assert code == 2
    assert [line for line in log.splitlines() if line.startswith("error: ")]
    assert complaint in log
    assert "Traceback" not in log
