"""Two robots that are nothing like LIBERO's, recorded into bags as the recorder does.

The mill has names, units and a gripper of its own, and a 7-D action: a 6-D twist in mm/s and
deg/s, and the gripper. The arm has seven joints that are commanded to positions. It has neither
phases nor a gripper.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import bag_messages
import numpy as np
from streams import MIN_FREE_MB, recorded_topics

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.types import Floats
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.live.recorder import Recording

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 40_000_000
N_STEPS = 80
OPEN, CLOSED = 85.0, 0.0
SPEED_MM_S, TURN_DEG_S = 200.0, 20.0
AXES = tuple(f"axis_{k}" for k in range(1, 7))
JOINTS = tuple(f"j{k}" for k in range(7))
STAGES = ("APPROACH", "HOLD")
TWIST = "geometry_msgs/msg/TwistStamped"
POSE = "geometry_msgs/msg/PoseStamped"
STATE = "sensor_msgs/msg/JointState"

Message = tuple[str, Any]


def field(topic: str, kind: str, role: str, values: Any, unit: str, **more: Any) -> dict[str, Any]:
    return {"topic": topic, "type": kind, "role": role, "values": [*values], "unit": unit, **more}


def mill() -> TopicMap:
    position = [f"pose.position.{axis}" for axis in "xyz"]
    return topic_map_from_json(
        {
            "fields": {
                "spindle": field("mill/tool", POSE, "effector", position, "mm"),
                "axes": field(
                    "mill/axes", STATE, "observation", [f"position.{a}" for a in AXES], "deg"
                ),
                "blank": field("mill/blank", POSE, "object", position, "mm"),
                "stage": field(
                    "mill/stage",
                    "diagnostic_msgs/msg/DiagnosticArray",
                    "phase",
                    ["status.0.message"],
                    "",
                    labels=list(STAGES),
                ),
                "feed": field(
                    "mill/jog", TWIST, "action", [f"twist.linear.{a}" for a in "xyz"], "mm/s"
                ),
                "turn": field(
                    "mill/jog", TWIST, "action", [f"twist.angular.{a}" for a in "xyz"], "deg/s"
                ),
                "clamp": field("mill/clamp", STATE, "gripper", ["position.jaw"], "mm"),
            },
            "gripper": {
                "field": "clamp",
                "opens": 1,
                "kind": "continuous",
                "open_value": OPEN,
                "closed_value": CLOSED,
            },
            "command": {"frame": "bed"},
        }
    )


def arm() -> TopicMap:
    return topic_map_from_json(
        {
            "fields": {
                "angles": field(
                    "arm/now", STATE, "clock", [f"position.{j}" for j in JOINTS], "rad"
                ),
                "goal": field(
                    "arm/goal", STATE, "action", [f"position.{j}" for j in JOINTS], "rad"
                ),
            }
        }
    )


def mill_demonstration(seed: int) -> dict[str, Floats]:
    """The spindle goes to the blank, and the clamp closes when it is there."""
    rng = np.random.default_rng(seed)
    blank = rng.uniform([300.0, -100.0, 50.0], [400.0, 100.0, 60.0])
    spindle = rng.uniform([0.0, -50.0, 200.0], [60.0, 50.0, 260.0])
    axes = rng.uniform(-40.0, 40.0, 6)
    rows: dict[str, list[Any]] = {name: [] for name in mill().fields}
    for _ in range(N_STEPS):
        way = blank - spindle
        feed = np.clip(2.0 * way, -SPEED_MM_S, SPEED_MM_S)
        turn = np.clip(-0.5 * axes[3:], -TURN_DEG_S, TURN_DEG_S)
        is_there = bool(np.abs(way).max() < 15.0)
        step = {
            "spindle": spindle,
            "axes": axes,
            "blank": blank,
            "stage": [float(is_there)],
            "feed": feed,
            "turn": turn,
            "clamp": [CLOSED if is_there else OPEN],
        }
        for name, values in step.items():
            rows[name].append(values)
        spindle = spindle + 0.04 * feed
        axes = axes + 0.04 * np.concatenate([0.1 * feed, turn])
    return {name: np.array(values) for name, values in rows.items()}


def arm_demonstration(seed: int) -> dict[str, Floats]:
    """Seven joints go home step by step; home is far from zero."""
    rng = np.random.default_rng(seed)
    home = np.array([0.5, -1.2, 2.0, -2.2, 0.3, 1.6, -0.7])
    angles = home + rng.uniform(-0.4, 0.4, 7)
    rows: dict[str, list[Any]] = {"angles": [], "goal": []}
    for _ in range(N_STEPS):
        goal = angles + 0.02 * (home - angles)
        rows["angles"].append(angles)
        rows["goal"].append(goal)
        angles = goal
    return {name: np.array(values) for name, values in rows.items()}


def mill_messages(fields: dict[str, Floats], k: int, stamp_ns: int) -> Iterator[Message]:
    row = {name: values[k] for name, values in fields.items()}
    vector = "geometry_msgs/msg/Vector3"
    linear, angular = (
        bag_messages.make(vector, **dict(zip("xyz", row[name].tolist(), strict=True)))
        for name in ("feed", "turn")
    )
    yield (
        "mill/axes",
        bag_messages.joint_state(stamp_ns, dict(zip(AXES, row["axes"], strict=True))),
    )
    yield "mill/blank", bag_messages.pose(stamp_ns, row["blank"].tolist())
    yield "mill/stage", bag_messages.status(stamp_ns, STAGES[int(row["stage"][0])], {})
    yield "mill/tool", bag_messages.pose(stamp_ns, row["spindle"].tolist())
    yield (
        "mill/jog",
        bag_messages.make(
            TWIST,
            header=bag_messages.header(stamp_ns, "bed"),
            twist=bag_messages.make("geometry_msgs/msg/Twist", linear=linear, angular=angular),
        ),
    )
    yield "mill/clamp", bag_messages.joint_state(stamp_ns, {"jaw": row["clamp"][0]})


def arm_messages(fields: dict[str, Floats], k: int, stamp_ns: int) -> Iterator[Message]:
    for topic, name in (("arm/now", "angles"), ("arm/goal", "goal")):
        joints = dict(zip(JOINTS, fields[name][k], strict=True))
        yield topic, bag_messages.joint_state(stamp_ns, joints)


ROBOTS = {
    "mill": (mill, mill_demonstration, mill_messages),
    "arm": (arm, arm_demonstration, arm_messages),
}


def samples_of(robot: str, seed: int) -> list[Sample]:
    """Everything that a demonstration publishes."""
    _, demonstrate, messages = ROBOTS[robot]
    fields = demonstrate(seed)
    return [
        Sample(topic, stamp_ns, k + 1, bag_messages.to_cdr(message), stamp_ns + 1000, stamp_ns)
        for k in range(N_STEPS)
        for stamp_ns in [START_NS + k * PERIOD_NS]
        for topic, message in messages(fields, k, stamp_ns)
    ]


def started(robot: str, seed: int) -> EpisodeEvent:
    return EpisodeEvent(str(uuid.UUID(int=seed + 1)), f"{robot}-{seed}", "started", START_NS)


def record(folder: Path, robot: str, seeds: range) -> Dataset:
    """Record demonstrations into a dataset."""
    topic_map = ROBOTS[robot][0]()
    dataset = Dataset(folder, create=True)
    for seed in seeds:
        event = started(robot, seed)
        recording = Recording(
            dataset, topic_map, recorded_topics(topic_map), min_free_mb=MIN_FREE_MB
        )
        notices = recording.event(event, 0.0)
        for sample in samples_of(robot, seed):
            notices += recording.sample(sample, 0.0)
        counts = dict.fromkeys(topic_map.topics, N_STEPS)
        end_ns = START_NS + (N_STEPS - 1) * PERIOD_NS
        ended = EpisodeEvent(event.id, event.name, "ended", START_NS, end_ns, counts)
        notices += recording.event(ended, 0.0)
        notices += recording.tick(1e6)
        assert [notice.state for notice in notices] == ["recording", "closed"], notices
    return dataset


def read(dataset: Dataset) -> list[Episode]:
    """Episodes of a dataset, from its bags alone."""
    episodes = [read_episode(bag) for bag in dataset.bags()]
    for episode in episodes:
        assert (len(episode), episode.findings) == (N_STEPS, ())
    return episodes
