"""The policy node: how it answers, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from episodes import topic_map
from graph import LATCHED, MAPPED, DiagnosticArray, JointState, TwistStamped
from mlps import mlp
from other_robots import (
    CLOSED,
    OPEN,
    PERIOD_NS,
    START_NS,
    mill,
    mill_demonstration,
    samples_of,
    started,
)
from robot import BOWL, PLATE, Robot, libero_take, plain, stamp_ns

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import event_to_status
from curation_ros.nodes.messages import array_to_ros, message_type
from policy_node.settings import TrainingSettings
from policy_node.variants import draft_variant

pytest.importorskip("torch")

from policy_node.train import train

pytestmark = [pytest.mark.ros, pytest.mark.policy]

COMMANDS = ("command/twist", "command/gripper")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy with random weights: it moves, and every wrong number shows."""
    return mlp().save(tmp_path_factory.mktemp("policies") / "p")


# --- answering ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def answers(graph, folder):
    """A robot without commands of its own, and what the policy node has answered."""
    # First, so that the policy node has found them when its first command is received.
    received = {topic: [] for topic in COMMANDS}
    for topic, kind in zip(COMMANDS, (TwistStamped, JointState), strict=True):
        graph.node.create_subscription(kind, topic, received[topic].append, MAPPED)
    graph.start("policy_node", policy=folder)
    types = {t: kind for t, kind in topic_map().topics.items() if t not in COMMANDS}
    with Robot(graph, types=types) as robot:
        robot.until_found(topics=["eef_pose", "phase", BOWL, PLATE])
        yield Answers(graph, robot, received)
    graph.stop("policy_node")


class Answers:
    def __init__(self, graph, robot, received):
        self.graph = graph
        self.robot = robot
        self.received = received

    def begin(self):
        """Start an episode; returns the messages of its steps."""
        take = libero_take(0, 6)
        observations = [s for s in take.messages if s[0] not in COMMANDS]
        n = len(observations) // 6
        steps = [observations[k : k + n] for k in range(0, len(observations), n)]
        # The first observation is at the start stamp, as the sim has it.
        started = type(take.started)(take.id, take.name, "started", stamp_ns(observations[0][1]))
        for commands in self.received.values():
            commands.clear()
        self.robot.tell(started)
        return steps

    def until(self, n):
        self.graph.until(lambda: all(len(c) >= n for c in self.received.values()), f"{n} answers")
        return [plain(self.received[topic][n - 1]) for topic in COMMANDS]


def test_answers_carry_the_stamp_of_their_observation(answers):
    for n, step in enumerate(answers.begin(), 1):
        answers.robot.send(step)
        twist, gripper = answers.until(n)
        assert twist["header"]["stamp"] == gripper["header"]["stamp"]
        assert stamp_ns(answers.received[COMMANDS[0]][-1]) == stamp_ns(step[0][1])
        assert gripper["name"] == ["gripper"]
        assert gripper["position"][0] in (-1.0, 0.0, 1.0)
        assert all(abs(v) <= 1.0 for v in twist["twist"]["linear"].values())


def test_repeated_observation_gets_the_same_command(answers):
    steps = answers.begin()
    answers.robot.send(steps[0])
    first = answers.until(1)
    answers.robot.send(steps[1])
    second = answers.until(2)
    answers.robot.send(steps[1])
    assert answers.until(3) == second
    answers.robot.send(steps[2])
    assert answers.until(4) != second != first


def test_incomplete_observation_waits_for_its_last_topic(answers):
    first, second, *_ = answers.begin()
    *others, tool = first
    answers.robot.send([*others, *second[:-1]])  # of the next one something is there already
    answers.graph.quiet(0.3)
    assert not answers.received[COMMANDS[0]]
    answers.robot.send([tool])
    answers.until(1)
    assert stamp_ns(answers.received[COMMANDS[0]][0]) == stamp_ns(first[0][1])


def test_episode_joined_in_its_middle_is_not_driven(answers):
    steps = answers.begin()
    answers.robot.send(steps[3])
    answers.graph.problem("policy_node", "its first observation was not received: not driving it")
    assert not answers.received[COMMANDS[0]]


# --- errors ---------------------------------------------------------------------------------


def without_bowl():
    raw = topic_map().to_json()
    del raw["fields"]["bowl_position"]
    raw["state"] = [c for c in raw["state"] if not c.startswith("bowl_position")]
    return raw


def in_millimetres():
    raw = topic_map().to_json()
    raw["fields"]["eef_position"]["unit"] = "mm"
    return raw


@pytest.fixture(scope="module")
def refused(graph, folder):
    """Name -> (exit code, output) of nodes that ought to refuse."""
    empty = graph.folder / "empty"
    empty.mkdir()
    parameters = {"empty_folder": {"policy": empty}}
    for change in (without_bowl, in_millimetres):
        path = graph.folder / f"{change.__name__}.yaml"
        path.write_text(yaml.safe_dump(change()))
        parameters[change.__name__] = {"policy": folder, "topic_map": path}
    for name, given in parameters.items():
        graph.start("policy_node", name, **given)
    return {name: graph.expect_exit(name) for name in parameters}


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("without_bowl", "'bowl_position'"),
        ("in_millimetres", "'eef_position'"),
        ("empty_folder", "empty"),
    ],
)
def test_policy_that_does_not_fit_is_one_line_and_code_2(refused, name, complaint):
    code, log = refused[name]
    assert (code, len(log.splitlines())) == (2, 1)
    assert log.startswith("error: ")
    assert complaint in log


# --- another robot --------------------------------------------------------------------------


def test_commands_go_out_on_the_topics_and_types_of_the_robot(other_graph, tmp_path):
    """A 6-D twist and a gripper with names, units and ends of its own."""
    graph, mapped = other_graph, mill()
    fields = mill_demonstration(0)
    episode = Episode(
        id="0",
        name="mill",
        start_ns=START_NS,
        end_ns=START_NS + 79 * PERIOD_NS,
        stamps_ns=START_NS + PERIOD_NS * np.arange(80),
        fields=fields,
        topic_map=mapped,
    )
    settings = TrainingSettings(steps=5, hidden=(8,))
    variant = draft_variant(mapped)
    policy = train([(episode, None)], variant, seed=0, settings=settings).policy
    path = tmp_path / "mill.yaml"
    path.write_text(yaml.safe_dump(mapped.to_json()))

    received = {"mill/jog": [], "mill/clamp": []}
    for topic, kind in zip(received, (TwistStamped, JointState), strict=True):
        graph.node.create_subscription(kind, topic, received[topic].append, MAPPED)
    owner = graph.node.create_publisher(DiagnosticArray, "episode", LATCHED)
    outputs = {
        topic: graph.node.create_publisher(message_type(kind), topic, MAPPED)
        for topic, kind in mapped.topics.items()
        if topic not in received
    }
    graph.start("policy_node", policy=policy.save(tmp_path / "policy"), topic_map=path)
    owner.publish(array_to_ros([event_to_status(started("mill", 0))], START_NS))
    first = [s for s in samples_of("mill", 0) if s.stamp_ns == START_NS and s.topic in outputs]

    def answered():
        # Until it is answered, the first observation is repeated, as the simulator does.
        for sample in first:
            outputs[sample.topic].publish(sample.data)
        graph.quiet(0.1)
        return all(received.values())

    graph.until(answered, "the first observation is answered")
    policy.observe({name: values[0] for name, values in fields.items()})
    command = policy.act()
    twist, clamp = received["mill/jog"][0], received["mill/clamp"][0]
    assert stamp_ns(twist) == stamp_ns(clamp) == START_NS
    assert twist.header.frame_id == "bed"
    values = plain(twist.twist)
    assert list(values["linear"].values()) == command["feed"].tolist()
    assert list(values["angular"].values()) == command["turn"].tolist()
    assert (list(clamp.name), list(clamp.position)) == (["jaw"], command["clamp"].tolist())
    assert command["clamp"][0] in (OPEN, CLOSED)
