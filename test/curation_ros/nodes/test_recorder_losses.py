"""How a recorder reports lost messages, best effort, and several publishers."""

from __future__ import annotations

import json
import signal

import pytest
import yaml
from episodes import topic_map
from graph import MAPPED, QoSProfile, ReliabilityPolicy
from pausing import pausable
from robot import Robot, distinct, libero_take, without

from curation_ros.bags import open_bag
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.ros

#: Only three topics, so that many messages are sent quickly.
SMALL = ("eef_position", "joint_position", "bowl_position")


@pytest.fixture(scope="module")
def small(graph):
    """A recorder of three topics; the bowl's publisher offers best effort only."""
    path = graph.folder / "small.yaml"
    path.write_text(yaml.safe_dump(topic_map().only(SMALL).to_json()))
    dataset = graph.folder / "small"
    with pausable():
        graph.start("recorder", "small", dataset=dataset, topic_map=path)
    graph.ready("small")
    kept = topic_map().only(SMALL)
    best_effort = QoSProfile(depth=MAPPED.depth, reliability=ReliabilityPolicy.BEST_EFFORT)
    bowl = kept.fields["bowl_position"].topic
    with Robot(graph, kept, name="small_robot", qos={bowl: best_effort}) as robot:
        robot.until_found()
        yield dataset, robot


def small_take(seed, n_steps):
    take = libero_take(seed, n_steps, counts=False)
    for topic in set(topic_map().topics) - set(topic_map().only(SMALL).topics):
        take = without(take, topic)
    return take


def recorded(graph, dataset, take):
    status = graph.recorded(take.id)
    assert status.message.startswith("closed "), status
    bag = open_bag(dataset / "episodes" / take.id)
    return bag, json.loads(bag.custom_data["recording"])["topics"]


def bag_counts(bag):
    return {name.lstrip("/"): topic.count for name, topic in bag.topics.items()}


def test_best_effort_publisher_is_recorded(graph, small):
    dataset, robot = small
    take = robot.play(small_take(2, 100), rate_hz=200.0)
    bag, stats = recorded(graph, dataset, take)
    counts = bag_counts(bag)
    bowl = "objects/akita_black_bowl_1/pose"
    assert counts["eef_pose"] == counts["joint_states"] == 100
    assert counts[bowl] + stats[bowl]["lost"] == 100
    assert counts[bowl] > 0
    metadata = yaml.safe_load((bag.path / "metadata.yaml").read_text())
    offered = {
        t["topic_metadata"]["name"]: t["topic_metadata"]["offered_qos_profiles"][0]["reliability"]
        for t in metadata["rosbag2_bagfile_information"]["topics_with_message_count"]
    }
    assert offered[f"/{bowl}"] == "best_effort"
    assert offered["/eef_pose"] == "reliable"


def test_stopped_recorder_takes_pending_messages(graph, small):
    """It is behind when the signal comes."""
    _, robot = small
    dataset = graph.folder / "behind"
    path = graph.folder / "small.yaml"
    with pausable():
        graph.start("recorder", "behind", dataset=dataset, topic_map=path)
    robot.until_found(2)
    take = small_take(6, 120)
    robot.tell(take.started)
    graph.ready("behind", line=f"recording {take.name}")
    robot.send(take.messages[:60], rate_hz=100.0)
    graph.pause("behind")
    try:
        robot.send(take.messages[60:], rate_hz=100.0)
        graph.nodes.send("behind", signal.SIGINT)
    finally:
        graph.resume("behind")
    assert graph.expect_exit("behind")[0] == 0
    bag = open_bag(dataset / "episodes" / take.id)
    assert bag.event().event == "aborted"
    counts = bag_counts(bag)
    assert counts["eef_pose"] == counts["joint_states"] == 120
    robot.tell(take.ended)  # for the other recorder


def test_lost_messages_are_counted(graph, small):
    """A recorder is paused for longer than its queues hold, and then continues."""
    dataset, robot = small
    take = small_take(3, 1400)
    robot.tell(take.started)
    robot.send(take.messages[:300])
    graph.quiet(0.3)
    graph.pause("small")
    try:
        robot.send(take.messages[300:3900], rate_hz=1000.0)
    finally:
        graph.resume("small")
    robot.send(take.messages[3900:])
    robot.tell(take.ended)
    bag, stats = recorded(graph, dataset, take)
    counts = bag_counts(bag)
    assert counts["eef_pose"] < 1400
    for topic, n in distinct(take.messages).items():
        assert counts[topic] + stats[topic]["lost"] == n
        assert stats[topic]["publishers"] == 1
    assert "gap" in {f.id for f in read_episode(bag.path).findings}


def test_second_publisher_makes_loss_unknown(graph, small):
    dataset, robot = small
    kept = topic_map().only(["eef_position"])
    with Robot(graph, kept, name="intruder", owner=False) as intruder:
        intruder.until_found()
        take = robot.play(small_take(4, 50))
        bag, stats = recorded(graph, dataset, take)
    assert (stats["eef_pose"]["publishers"], stats["eef_pose"]["lost"]) == (2, None)
    assert stats["joint_states"]["lost"] == 0
    found = {f.id: f.message for f in read_episode(bag.path).findings}
    assert "'eef_pose' has 2 publishers" in found["unknown-loss"]


def test_publisher_that_changes_makes_loss_unknown(graph, small):
    """Another node takes over during the episode, and numbers its messages from the start."""
    dataset, robot = small
    take = small_take(5, 60)
    joints = take.until(0.5)
    robot.tell(take.started)
    robot.send(take.messages[:joints])
    graph.quiet(0.3)
    robot.node.destroy_publisher(robot.publishers["joint_states"])
    kept = topic_map().only(["joint_position"])
    with Robot(graph, kept, name="successor", owner=False) as successor:
        successor.until_found()
        robot.publishers["joint_states"] = successor.publishers["joint_states"]
        robot.send(take.messages[joints:])
        robot.tell(take.ended)
        bag, stats = recorded(graph, dataset, take)
    assert stats["joint_states"]["lost"] is None
    found = {f.id: f.message for f in read_episode(bag.path).findings}
    assert "'joint_states'" in found["unknown-loss"]
