from __future__ import annotations

from types import SimpleNamespace

from hand_made_observations import step_at

from curation_ros.configuration import topic_map_or_default
from sim_node.environment import Command
from sim_node.messages import CLOCK_TOPIC, COMMAND_TYPES, RobotMessages, command_messages
from sim_node.tasks.bowl_on_plate import BOWL, PLATE

ENV = SimpleNamespace(
    joint_names=[*(f"robot0_joint{k}" for k in range(1, 8)), "left", "right"],
    object_names=[BOWL, PLATE],
)


def test_an_observation_has_every_topic_once_and_the_clock_role_comes_last():
    sent = list(RobotMessages(ENV).observation(5, step_at([0.1, 0.2, 0.3], 3), "id"))
    assert [message.topic for message in sent] == [
        CLOCK_TOPIC,
        "joint_states",
        f"objects/{BOWL}/pose",
        f"objects/{PLATE}/pose",
        "phase",
        topic_map_or_default("").clock_topic,
    ]
    assert {message.topic: message.type for message in sent[1:]} == RobotMessages(ENV).types
    assert sent[-1].content["pose"]["position"] == {"x": 0.1, "y": 0.2, "z": 0.3}
    assert sent[-2].content["status"][0]["message"] == "LIFT"


def test_types_are_those_of_the_default_topic_map():
    known = {**RobotMessages(ENV).types, **COMMAND_TYPES}
    for topic, kind in topic_map_or_default("").topics.items():
        assert known[topic] == kind


def test_command_answers_with_the_stamp_of_the_observation():
    sent = list(command_messages(7, Command([0.1, 0.0, -0.1], 1.0)))
    assert {message.topic: message.type for message in sent} == COMMAND_TYPES
    for message in sent:
        assert message.content["header"]["stamp"] == {"sec": 0, "nanosec": 7}
    assert sent[1].content["position"] == [1.0]
