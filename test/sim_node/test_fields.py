"""Fields of a topic map in this process: those that nodes decode from the messages."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hand_made_observations import BOWL_START_M, step_at

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.messages import to_cdr
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.errors import ConfigError
from sim_node.environment import Command
from sim_node.fields import CommandedFields, ObservedFields
from sim_node.messages import RobotMessages, command_messages
from sim_node.tasks.bowl_on_plate import BOWL, PLATE

ENV = SimpleNamespace(
    joint_names=[
        *(f"robot0_joint{k}" for k in range(1, 8)),
        "gripper0_finger_joint1",
        "gripper0_finger_joint2",
    ],
    object_names=[BOWL, PLATE],
)
MAP = topic_map_or_default("")
OBSERVED = [name for name, spec in MAP.fields.items() if spec.topic not in MAP.command_topics]
STEP = step_at([0.1, -0.2, 0.3], 3, 0.25, width_m=0.05)


def with_values(name, *paths):
    fields = {**MAP.fields, name: replace(MAP.fields[name], values=paths)}
    return replace(MAP, fields=fields)


def test_values_are_those_that_a_node_decodes():
    found = ObservedFields(ENV, MAP, OBSERVED).values(STEP)
    contents = {m.topic: m.content for m in RobotMessages(ENV).observation(0, STEP, "")}
    for name in OBSERVED:
        spec = MAP.fields[name]
        data = to_cdr(spec.type, contents[spec.topic])
        columns = CdrDecoder().decode(spec.type, spec.values, [data])
        if spec.labels:
            assert found[name].tolist() == [spec.labels.index(str(columns[0][0]))] == [3]
        else:
            assert found[name].tolist() == [float(column[0]) for column in columns]
    assert found["bowl_position"].tolist() == BOWL_START_M.tolist()
    assert found["finger_position"].tolist() == [0.025, -0.025]


def test_paths_may_go_by_index_and_by_key():
    robot = with_values("joint_position", "position.7", "effort.gripper0_finger_joint2")
    found = ObservedFields(ENV, robot, ["joint_position"]).values(STEP)
    assert found["joint_position"].tolist() == [0.025, 0.0]
    spec = replace(MAP.fields["phase"], labels=(), values=("status.0.values.progress",))
    robot = replace(MAP, fields={**MAP.fields, "phase": spec})
    assert ObservedFields(ENV, robot, ["phase"]).values(STEP)["phase"].tolist() == [0.25]


@pytest.mark.parametrize(
    ("robot", "name", "message"),
    [
        (MAP, "cup_position", "no field 'cup_position' in the topic map"),
        (MAP, "twist", "does not send geometry_msgs/msg/TwistStamped on topic 'command/twist'"),
    ],
)
def test_what_the_robot_does_not_send_is_refused(robot, name, message):
    with pytest.raises(ConfigError, match=message):
        ObservedFields(ENV, robot, [name])


@pytest.mark.parametrize("path", ["pose.colour.x", "pose.position", "pose.position.x.y"])
def test_path_that_leads_nowhere_is_named(path):
    fields = ObservedFields(ENV, with_values("eef_position", path), ["eef_position"])
    with pytest.raises(ConfigError, match=f"field 'eef_position': no value at '{path}'"):
        fields.values(STEP)


def test_phase_that_the_map_does_not_know_is_named():
    spec = replace(MAP.fields["phase"], labels=("PREGRASP", "GRASP"))
    robot = replace(MAP, fields={**MAP.fields, "phase": spec})
    with pytest.raises(ConfigError, match="phase 'LIFT' is none of PREGRASP, GRASP"):
        ObservedFields(ENV, robot, ["phase"]).values(STEP)


def test_command_is_what_the_messages_of_its_fields_would_say():
    commanded = CommandedFields(MAP, ["gripper", "twist"])
    command = commanded.command({"twist": np.array([0.1, 0.2, -0.3]), "gripper": np.array([-1.0])})
    twist, gripper = (message.content for message in command_messages(0, command))
    assert twist["twist"]["linear"] == {"x": 0.1, "y": 0.2, "z": -0.3}
    assert gripper["position"] == [-1.0]


def test_command_that_lacks_a_field_rests():
    command = CommandedFields(MAP, ["twist"]).command({"twist": np.array([0.0, 1.0, 0.0])})
    assert command.gripper == 0.0
    command = CommandedFields(MAP, ["gripper"]).command({"gripper": np.array([1.0])})
    assert (command.action_xyz.tolist(), command.gripper) == ([0.0, 0.0, 0.0], 1.0)
    assert isinstance(command, Command)


def test_command_that_the_robot_does_not_take_is_refused():
    turning = with_values("twist", "twist.linear.x", "twist.angular.z")
    with pytest.raises(ConfigError, match=r"takes no command 'twist.angular.z' on topic"):
        CommandedFields(turning, ["twist"])
