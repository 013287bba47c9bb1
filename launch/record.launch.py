"""Records and curates demonstrations, of the simulated expert or of your robot.

ros2 launch curation_ros record.launch.py episodes:=10 contamination:=0.5
ros2 launch curation_ros record.launch.py sim:=false topic_map:=my_robot.yaml
"""

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    LogInfo,
    RegisterEventHandler,
    Shutdown,
    TimerAction,
)
from launch.conditions import IfCondition
from launch.event_handlers import OnProcessExit
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

# The curator may wait this long for late samples (its drain_timeout_s) before it decides.
_LAST_DECISION_S = 5.0

ARGUMENTS = (
    ("dataset", "dataset", "folder of the dataset; created if missing"),
    ("reference", "", "dataset or bag of trusted demonstrations; empty: none"),
    ("config", "", "YAML file of scorers and rule; empty: config/curation.yaml"),
    ("topic_map", "", "YAML file of the topic map; empty: the LIBERO robot of sim_node"),
    ("sim", "true", "false: your robot publishes; start episodes with curation record"),
    ("episodes", "10", "number of demonstrations by the expert"),
    ("contamination", "0.0", "fraction of defective demonstrations"),
    ("defect", "early_release", "the defect that is injected into them"),
    ("seed", "0", "seed of start states, order and defects"),
)


def generate_launch_description() -> LaunchDescription:
    common = {"dataset": _text("dataset")}
    mapped = {**common, "topic_map": _text("topic_map")}
    recorder = _node("recorder", {**mapped, "auto": _number("sim", bool)}, on_exit=_others_follow)
    reference = ParameterValue(["[", LaunchConfiguration("reference"), "]"])
    curator = _node(
        "curator",
        {**mapped, "config": _text("config"), "reference": reference},
        on_exit=_others_follow,
    )
    sim = _node(
        "sim_node",
        {
            **common,
            "episodes": _number("episodes", int),
            "contamination": _number("contamination", float),
            "defect": _text("defect"),
            "seed": _number("seed", int),
            "wait_for": ["recorder", "curator"],
        },
        condition=IfCondition(LaunchConfiguration("sim")),
    )
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=description)
                for name, default, description in ARGUMENTS
            ),
            # Registered before the sim node starts: one that refuses its parameters ends at once.
            RegisterEventHandler(OnProcessExit(target_action=sim, on_exit=_sim_has_ended)),
            # First, because launch gives up at a node with an argument that is no number, and
            # leaves the nodes running that it has already started.
            sim,
            recorder,
            curator,
        ]
    )


def _text(name):
    return ParameterValue(LaunchConfiguration(name), value_type=str)


def _number(name, kind):
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def _node(executable, parameters, **settings):
    return Node(
        package="curation_ros",
        executable=executable,
        output="screen",
        parameters=[parameters],
        **settings,
    )


def _others_follow(event, context):
    if context.is_shutdown:  # Ctrl-C has reached every node
        return []
    return [Shutdown(reason=f"{event.process_name} has ended with code {event.returncode}")]


def _sim_has_ended(event, context):
    if context.is_shutdown or event.returncode:
        return _others_follow(event, context)
    return [
        LogInfo(msg="sim_node has ended; recorder and curator follow"),
        TimerAction(
            period=_LAST_DECISION_S,
            actions=[Shutdown(reason="all demonstrations are recorded")],
        ),
    ]
