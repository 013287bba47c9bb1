"""The sim node in free mode: it owns no episodes, and a person gives commands."""

from __future__ import annotations

import json
import signal

import numpy as np
import pytest
from commander import COMMANDS, Commander
from graph import MAPPED, DescribeParameters, PoseStamped, Trigger
from robot import stamp_ns

from curation_ros.bags import open_bag
from curation_ros.dataset.episodes import read_episode

pytestmark = [pytest.mark.ros, pytest.mark.sim]
pytest.importorskip("libero", reason="LIBERO is not installed")


@pytest.fixture(scope="module")
def free(graph):
    """A sim node without end at five times real time, and a recorder operated by hand."""
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
        "recorder",
        "free_recorder",
        {"__node": "free_recorder"},
        dataset=dataset,
        auto=False,
        drain_timeout_s=1.0,  # commands stop arriving
    )
    seen = []
    graph.node.create_subscription(PoseStamped, "eef_pose", seen.append, MAPPED)
    commander = Commander(graph, "person")
    graph.until(lambda: commander.twist.get_subscription_count() >= 2 and seen, "sim and recorder")
    for node in ("sim_node", "free_recorder"):
        graph.counts_publishers(node, COMMANDS, 1)
    yield dataset, commander, seen
    commander.close()


def by_hand(graph, service):
    def press():
        return graph.call(Trigger, f"free_recorder/{service}", Trigger.Request())

    answer = press()
    if answer.message.startswith("nothing has arrived"):  # it has not discovered the sim yet
        answer = graph.until(
            lambda: (a := press()).success and a, "the recorder receives from the sim"
        )
    assert answer.success, answer.message
    return answer


def test_free_command_is_held_and_then_zeroed(graph, free):
    dataset, commander, seen = free
    episode_id = json.loads(by_hand(graph, "start").message)["episode"]
    started = graph.until(
        lambda: next((e for e in graph.events if e.id == episode_id), None), "its start"
    )
    graph.until(lambda: stamp_ns(seen[-1]) > started.start_ns, "an observation of the episode")

    def rises_and_rests():
        """A command is held, then zeroed, and the arm comes to rest."""
        commander.send(seen[-1], z=1.0)
        first = len(seen) - 1

        def rested():
            height = [message.pose.position.z for message in seen[first:]]
            return height[-1] - height[0] > 0.02 and np.ptp(height[-40:]) < 0.005

        graph.until(rested, "the arm has risen and rests")

    rises_and_rests()
    rises_and_rests()  # only the zero command had stopped it
    by_hand(graph, "stop")
    graph.recorded(episode_id)
    bag = open_bag(dataset / "episodes" / episode_id)
    assert bag.topics[f"/{COMMANDS[0]}"].count == 2


def test_sim_without_episodes_of_its_own_publishes_none(graph, free):
    owners = graph.node.get_publishers_info_by_topic("episode")
    assert [info.node_name for info in owners] == ["free_recorder"]


def test_reset_inside_an_episode_of_another_owner(graph, free):
    dataset, _, seen = free
    episode_id = json.loads(by_hand(graph, "start").message)["episode"]
    graph.call(Trigger, "sim_node/reset", Trigger.Request())
    n = len(seen)
    graph.until(lambda: len(seen) > n + 10, "the sim goes on")
    by_hand(graph, "stop")
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
