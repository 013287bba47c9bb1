"""The policy node: how it answers, and what it refuses."""

from __future__ import annotations

import pytest
import yaml
from episodes import topic_map
from graph import MAPPED, JointState, TwistStamped
from mlps import mlp
from robot import BOWL, PLATE, Robot, libero_take, plain, stamp_ns

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
    # First, so that the policy node knows of them when it is heard.
    heard = {topic: [] for topic in COMMANDS}
    for topic, kind in zip(COMMANDS, (TwistStamped, JointState), strict=True):
        graph.node.create_subscription(kind, topic, heard[topic].append, MAPPED)
    graph.start("policy_node", policy=folder)
    types = {t: kind for t, kind in topic_map().topics.items() if t not in COMMANDS}
    with Robot(graph, types=types) as robot:
        robot.until_found(topics=["eef_pose", "phase", BOWL, PLATE])
        yield Answers(graph, robot, heard)
    graph.stop("policy_node")


class Answers:
    def __init__(self, graph, robot, heard):
        self.graph = graph
        self.robot = robot
        self.heard = heard

    def begin(self):
        """Start an episode; returns the messages of its steps."""
        take = libero_take(0, 6)
        observations = [s for s in take.messages if s[0] not in COMMANDS]
        n = len(observations) // 6
        steps = [observations[k : k + n] for k in range(0, len(observations), n)]
        # The first observation is at the start stamp, as the sim has it.
        started = type(take.started)(take.id, take.name, "started", stamp_ns(observations[0][1]))
        for commands in self.heard.values():
            commands.clear()
        self.robot.tell(started)
        return steps

    def until(self, n):
        self.graph.until(lambda: all(len(c) >= n for c in self.heard.values()), f"{n} answers")
        return [plain(self.heard[topic][n - 1]) for topic in COMMANDS]


def test_answers_carry_the_stamp_of_their_observation(answers):
    for n, step in enumerate(answers.begin(), 1):
        answers.robot.send(step)
        twist, gripper = answers.until(n)
        assert twist["header"]["stamp"] == gripper["header"]["stamp"]
        assert stamp_ns(answers.heard[COMMANDS[0]][-1]) == stamp_ns(step[0][1])
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
    assert not answers.heard[COMMANDS[0]]
    answers.robot.send([tool])
    answers.until(1)
    assert stamp_ns(answers.heard[COMMANDS[0]][0]) == stamp_ns(first[0][1])


def test_episode_joined_in_its_middle_is_not_driven(answers):
    steps = answers.begin()
    answers.robot.send(steps[3])
    answers.graph.problem("policy_node", "its first observation was not received: not driving it")
    assert not answers.heard[COMMANDS[0]]


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
