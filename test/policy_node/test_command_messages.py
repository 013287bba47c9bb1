"""Commands of any robot as messages: what is read back at the mapped paths is the command."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import TOPIC_MAP

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.messages import to_cdr
from curation_ros.core.episode.stream import header_stamp_ns
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import ConfigError, EpisodeError
from policy_node.command_messages import CommandMessages

STAMP_NS = 1_700_000_000_123_456_789
CLOCK = {
    "topic": "tool",
    "type": "geometry_msgs/msg/PoseStamped",
    "role": "clock",
    "values": ["pose.position.x"],
}


def robot(**fields):
    """A topic map with command fields: (topic, type, values)."""
    made = {"clock": CLOCK}
    for name, (topic, kind, values) in fields.items():
        stamp = "source" if "Multi" in kind or "Int8" in kind else "header"
        role = {"role": "action", "stamp": stamp}
        made[name] = {"topic": topic, "type": kind, "values": values, **role}
    return topic_map_from_json({"fields": made, "command": {"frame": "base"}})


def read_back(topic_map, command):
    """Field -> values at its paths in the messages, and the messages by topic."""
    made = CommandMessages(topic_map, tuple(command))
    messages = {
        topic: to_cdr(kind, content) for topic, kind, content in made.messages(command, STAMP_NS)
    }
    decoder = CdrDecoder()
    values = {
        name: [
            float(column[0])
            for column in decoder.decode(spec.type, spec.values, [messages[spec.topic]])
        ]
        for name, spec in topic_map.only(list(command)).fields.items()
    }
    plain = {
        topic: decoder.read_message(made.topics[topic], data) for topic, data in messages.items()
    }
    return values, plain, messages


def test_commands_of_libero_are_a_twist_and_a_joint():
    command = {"twist": np.array([0.1, -0.2, 0.05]), "gripper": np.array([-1.0])}
    values, plain, messages = read_back(TOPIC_MAP, command)
    assert values == {"twist": [0.1, -0.2, 0.05], "gripper": [-1.0]}
    assert plain["command/twist"]["header"]["frame_id"] == "world"
    assert plain["command/twist"]["twist"]["angular"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    joint = plain["command/gripper"]
    assert joint["name"] == ["gripper"]
    # Some readers fail on an empty tail.
    for member in ("position", "velocity", "effort"):
        assert joint[member].tolist() == [-1.0 if member == "position" else 0.0]
    for data in messages.values():
        assert header_stamp_ns(data) == STAMP_NS


JOINTS = [f"joint_{k}" for k in range(7)]
TWIST = "geometry_msgs/msg/TwistStamped"
STATE = "sensor_msgs/msg/JointState"
MULTI = "std_msgs/msg/Float64MultiArray"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"


@pytest.mark.parametrize(
    "fields",
    [
        {"move": ("cmd", TWIST, [f"twist.{a}.{b}" for a in ("linear", "angular") for b in "xyz"])},
        {"goal": ("cmd", STATE, [f"position.{name}" for name in JOINTS])},
        {"speed": ("cmd", STATE, [f"velocity.{name}" for name in JOINTS])},
        {"goal": ("cmd", MULTI, [f"data.{k}" for k in range(7)])},
        {"goal": ("cmd", TRAJECTORY, [f"points.0.positions.{k}" for k in range(7)])},
        {"some": ("cmd", MULTI, ["data.3", "data.1"])},
        {"wheel": ("cmd", "sensor_msgs/msg/Joy", ["axes.0", "axes.1"])},
        # Two fields of one message, and a third of another.
        {
            "turn": ("cmd", TWIST, ["twist.angular.z", "twist.angular.x"]),
            "go": ("cmd", TWIST, ["twist.linear.x"]),
            "hand": ("hand", STATE, ["position.left", "effort.right"]),
        },
    ],
)
def test_values_stand_where_the_topic_map_says(fields):
    topic_map = robot(**fields)
    rng = np.random.default_rng(0)
    command = {
        name: rng.normal(size=len(values)).astype(np.float32).astype(np.float64)
        for name, (_, _, values) in fields.items()
    }
    values, plain, _ = read_back(topic_map, command)
    assert values == {name: numbers.tolist() for name, numbers in command.items()}
    assert set(plain) == {topic for topic, _, _ in fields.values()}


def test_lists_beside_a_name_have_one_number_per_name():
    fields = {"a": ("cmd", STATE, ["position.x", "velocity.y"]), "b": ("cmd", STATE, ["effort.z"])}
    command = {"a": np.array([1.0, 2.0]), "b": np.array([3.0])}
    _, plain, _ = read_back(robot(**fields), command)
    joints = plain["cmd"]
    assert joints["name"] == ["x", "y", "z"]
    assert joints["position"].tolist() == [1.0, 0.0, 0.0]
    assert joints["velocity"].tolist() == [0.0, 2.0, 0.0]
    assert joints["effort"].tolist() == [0.0, 0.0, 3.0]


def test_message_without_header_needs_none():
    _, plain, _ = read_back(robot(goal=("cmd", MULTI, ["data.0"])), {"goal": np.array([0.5])})
    assert "header" not in plain["cmd"]


def test_integers_are_rounded_and_kept_in_their_range():
    topic_map = robot(grip=("cmd", "std_msgs/msg/Int8", ["data"]))
    values, _, _ = read_back(topic_map, {"grip": np.array([99.7])})
    assert values == {"grip": [100.0]}
    with pytest.raises(EpisodeError, match="command 'data': 300 is out of the range of int8"):
        read_back(topic_map, {"grip": np.array([300.0])})


@pytest.mark.parametrize(
    ("kind", "path", "words"),
    [
        (TWIST, "twist.linear.w", "'w' is no member"),
        (TWIST, "twist.linear", "is a message"),
        (TWIST, "header.frame_id", "has a text there"),
        ("diagnostic_msgs/msg/DiagnosticArray", "status.0.values.a", "has a text there"),
    ],
)
def test_path_that_leads_to_no_number_is_refused_at_once(kind, path, words):
    with pytest.raises(ConfigError, match=words):
        CommandMessages(robot(move=("cmd", kind, [path])), ("move",))


def test_unknown_field_is_refused():
    with pytest.raises(ConfigError, match="no field 'nose'"):
        CommandMessages(TOPIC_MAP, ("nose",))


def test_unknown_frame_is_empty():
    topic_map = replace(TOPIC_MAP, command={})
    _, plain, _ = read_back(topic_map, {"twist": np.zeros(3)})
    assert plain["command/twist"]["header"]["frame_id"] == ""
