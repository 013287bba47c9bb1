"""Another robot: other names, joints in a changing order, no phases, a namespace, a remap."""

from __future__ import annotations

import contextlib
import io

import numpy as np
import pytest
import yaml
from graph import jsonl
from robot import N_STEPS, PERIOD_NS, Robot, make_take, new_start_ns, other_robot_messages

from curation_ros.bags import open_bag
from curation_ros.cli.main import main as curation
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.ros

ARM = ("shoulder", "elbow", "wrist")
NAMESPACE = "/left_arm"
#: Stamps per second; a step has four.
RATE_HZ = 1600.0
# The map says `joints`, but the driver of this robot uses another name.
DRIVER = "driver/joint_states"
MAP = {
    "max_gap_s": 0.25,
    "fields": {
        "tool": {
            "topic": "tool/pose",
            "type": "geometry_msgs/msg/PoseStamped",
            "role": "clock",
            "values": ["pose.position.x", "pose.position.y", "pose.position.z"],
            "unit": "m",
        },
        "arm": {
            "topic": "joints",
            "type": "sensor_msgs/msg/JointState",
            "role": "observation",
            "values": [f"position.{name}" for name in ARM],
            "unit": "rad",
        },
        "jaw": {
            "topic": "joints",
            "type": "sensor_msgs/msg/JointState",
            "role": "observation",
            "values": ["position.jaw"],
            "unit": "m",
        },
        "velocity": {
            "topic": "servo/command",
            "type": "geometry_msgs/msg/TwistStamped",
            "role": "action",
            "values": [f"twist.{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz"],
        },
        "jaw_command": {
            "topic": "hand/command",
            "type": "sensor_msgs/msg/JointState",
            "role": "gripper",
            "values": ["position.jaw"],
            "unit": "m",
        },
    },
    "gripper": {
        "field": "jaw_command",
        "opens": 1,
        "kind": "continuous",
        "open_value": 0.08,
        "closed_value": 0.0,
        "fingers": "jaw",
    },
    "state": ["tool", "jaw"],
    "action": ["velocity", "jaw_command"],
}


def take(seed, name, *, open_at=None):
    start = new_start_ns()
    rng = np.random.default_rng(seed)
    messages = other_robot_messages(rng, start, ARM, open_at=open_at)
    # As with a manual episode, it ends at a stamp of the clock, and the robot continues.
    end = start + N_STEPS * PERIOD_NS
    return make_take(messages, start, name, end_ns=end, counts=False)


@pytest.fixture(scope="module")
def recorded(graph):
    """Datasets of a reference and of two demonstrations, and the two."""
    map_file = graph.folder / "robot.yaml"
    map_file.write_text(yaml.safe_dump(MAP))
    reference, dataset = graph.folder / "reference", graph.folder / "dataset"
    remaps = {"__ns": NAMESPACE, "joints": DRIVER}
    types = topic_map_from_json(MAP).topics
    types[DRIVER] = types.pop("joints")
    graph.listen(NAMESPACE + "/")
    with Robot(graph, types=types, namespace=NAMESPACE) as robot:
        graph.start("recorder", "reference", remaps, dataset=reference, topic_map=map_file)
        robot.until_found()
        for k in range(3):
            played = robot.play(take(k, f"reference-{k}"), rate_hz=RATE_HZ)
            assert graph.recorded(played.id).message.startswith("closed ")
        graph.stop("reference")
        graph.start("recorder", "recorder", remaps, dataset=dataset, topic_map=map_file)
        graph.start(
            "curator", "curator", remaps, dataset=dataset, topic_map=map_file,
            reference=[reference],
        )  # fmt: skip
        robot.until_found(2)
        takes = [take(10, "good"), take(11, "early", open_at=45)]
        for one in takes:
            robot.play(one, rate_hz=RATE_HZ)
            graph.settled(dataset, one.id)
    return dataset, reference, takes


def test_bag_has_the_resolved_names_and_the_map(recorded):
    dataset, _, takes = recorded
    bag = open_bag(dataset / "episodes" / takes[0].id)
    assert set(bag.topics) == {
        f"{NAMESPACE}/{topic}" for topic in ("tool/pose", DRIVER, "servo/command", "hand/command")
    }
    assert bag.topic_map() == topic_map_from_json(MAP)


def test_joints_are_found_by_their_names(recorded):
    dataset, _, takes = recorded
    orders = set()
    for one in takes:
        episode = read_episode(dataset / "episodes" / one.id)
        # There are two per step. The episode has the last one that is not later than the tool.
        sent = one.of(DRIVER)[: 2 * len(episode) : 2]
        orders.add(tuple(sent[0].name))
        by_name = [dict(zip(m.name, m.position, strict=True)) for m in sent]
        expected = [[row[name] for name in ARM] for row in by_name]
        np.testing.assert_array_equal(episode.field("arm"), expected)
    assert len(orders) == 2


def test_live_equals_offline(recorded):
    dataset, reference, takes = recorded
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        curation(["score", str(dataset), "--reference", str(reference), "--json", "--write"])
    rows = {row["episode"]: row for row in jsonl(out.getvalue())}
    for one in takes:
        first, last = Dataset(dataset).decisions(one.id)
        assert (last.revision, last.evidence["bag"]) == (1, "equal")
        assert rows[one.id]["scores"] == first.scores == last.scores
        assert rows[one.id]["reason"] == last.reason
        assert rows[one.id]["findings"] == []
    assert [rows[one.id]["decision"] for one in takes] == ["keep", "discard"]


def test_scorers_abstain_with_a_reason(recorded, graph):
    """Without phases and objects, each scorer gives a score or a reason."""
    dataset, _, takes = recorded
    decision = Dataset(dataset).decisions(takes[0].id)[-1]
    for scorer, score in decision.scores.items():
        assert (score is None) == (scorer in decision.abstained)
        assert decision.abstained.get(scorer, "a score")
    published = graph.decided(takes[0].id)
    assert published.values["score/gripper_timing"] == repr(decision.scores["gripper_timing"])


def test_episode_runs_on_its_own_clock(recorded):
    dataset, _, takes = recorded
    episode = read_episode(dataset / "episodes" / takes[0].id)
    assert set(np.diff(episode.stamps_ns)) == {PERIOD_NS}
    assert episode.findings == ()
