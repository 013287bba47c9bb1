"""Faults of the graph are named: on /diagnostics, in the log, and as findings."""

from __future__ import annotations

import shutil
import signal
from dataclasses import replace

import pytest
from episodes import topic_map
from robot import PLATE, Robot, libero_take, without

from curation_ros.dataset.dataset import Dataset

pytestmark = pytest.mark.ros

NODES = ("recorder", "curator")


@pytest.fixture(scope="module")
def dataset(graph):
    path = graph.folder / "dataset"
    for node in NODES:
        graph.start(node, dataset=path)
    graph.ready(*NODES)
    return path


def two_rounds(graph):
    """Wait for a report of each node whose check of the graph began after this call."""
    for _ in range(2):
        graph.health.clear()
        graph.until(lambda: {s.name for s in graph.health} >= set(NODES), "they report again")


def test_topic_of_the_wrong_type_is_named(graph, dataset):
    types = {**topic_map().topics, PLATE: "geometry_msgs/msg/TwistStamped"}
    take = without(libero_take(1), PLATE)
    problem = (
        f"topic /{PLATE}: published as geometry_msgs/msg/TwistStamped by robot, "
        "the topic map expects geometry_msgs/msg/PoseStamped"
    )
    with Robot(graph, types=types) as robot:
        robot.until_found(2, topics=[t for t in types if t != PLATE])
        for node in NODES:  # before an episode begins
            graph.problem(node, problem)
            assert graph.log(node).count(problem) == 1
        robot.play(take)
        decision = graph.settled(dataset, take.id)
    assert (decision.verdict, decision.evidence["bag"]) == ("review", "equal")
    assert {f.id: f.message for f in decision.findings} == {
        "missing-topic": f"topic {PLATE!r} has no sample in the episode"
    }


def test_missing_publisher_is_named_while_an_episode_runs(graph, dataset):
    """Between episodes, a missing publisher is no problem."""
    types = {t: kind for t, kind in topic_map().topics.items() if t != PLATE}
    take = without(libero_take(2), PLATE)
    with Robot(graph, types=types) as robot:
        robot.until_found(2)
        two_rounds(graph)
        assert {s.message for s in graph.health} == {"ok"}
        robot.tell(take.started)
        robot.send(take.messages)
        for node in NODES:
            graph.problem(node, f"topic /{PLATE}: no publisher")
        robot.tell(take.ended)
        decision = graph.settled(dataset, take.id)
    assert decision.reason.startswith("missing-topic: ")


def test_two_owners_of_the_episode_are_an_error(graph, dataset):
    problem = "topic episode has two owners: stop one of them"
    with Robot(graph), Robot(graph, name="usurper"):
        graph.health.clear()
        for node in NODES:
            assert graph.problem(node, problem).level == 2
    two_rounds(graph)
    assert {s.message for s in graph.health} == {"ok"}


def test_spoilt_event_is_a_line_in_the_log(graph, dataset):
    with Robot(graph) as robot:
        robot.until_found(2)
        started = libero_take(3).started
        robot.tell(type(started)(started.id, started.name, "paused", started.start_ns))
        for node in NODES:
            graph.ready(node, line="topic episode: episode event 'paused'")
            assert graph.nodes.ended(node) is None


def test_truncated_bag_is_named_and_the_others_are_played(graph, dataset):
    ids = []
    with Robot(graph) as robot:
        robot.until_found(2)
        for seed in (4, 5, 6):
            ids.append(robot.play(libero_take(seed)).id)
            graph.settled(dataset, ids[-1])
            graph.decided(ids[-1])
    copy = graph.folder / "copy"
    for episode_id in ids:
        shutil.copytree(dataset / "episodes" / episode_id, copy / episode_id)
    torn = copy / ids[1] / f"{ids[1]}_0.mcap"
    torn.write_bytes(torn.read_bytes()[:-2000])
    graph.decisions.clear()
    # So slowly that this process discovers the replay before it is over.
    graph.start("replay", bags=[copy], rate=1.0)
    graph.until(
        lambda: any(e.source == "replay" for e in graph.events), "the replay is discovered"
    )
    code, log = graph.expect_exit("replay")
    assert code == 0
    # Its last messages may still be on their way.
    graph.until(lambda: ids[2] in [s.hardware_id for s in graph.decisions], "the last decision")
    graph.until(lambda: (graph.events[-1].id, graph.events[-1].event) == (ids[2], "ended"), "end")
    assert [line for line in log.splitlines() if "[ERROR]" in line and str(torn) in line]
    assert "Traceback" not in log
    assert [s.hardware_id for s in graph.decisions] == [ids[0], ids[2]]
    # Replayed episodes are decided on but not recorded. Equal data give equal decisions.
    assert len(list(Dataset(dataset).bags())) == 5
    for episode_id in (ids[0], ids[2]):
        assert {d.revision for d in Dataset(dataset).decisions(episode_id)} == {1}
    replayed = [e for e in graph.events if e.source == "replay"]
    assert [(e.id, e.event) for e in replayed] == [
        (ids[0], "started"),
        (ids[0], "ended"),
        (ids[2], "started"),
        (ids[2], "ended"),
    ]


def test_bag_of_a_stopped_recorder_outranks_later_samples(graph, dataset):
    """Training reads bags, so a decision leaves out what the recorder has missed."""
    take = libero_take(7)
    half = take.until(0.5)
    with Robot(graph) as robot:
        robot.until_found(2)
        robot.tell(take.started)
        robot.send(take.messages[:half])
        graph.quiet(0.3)
        graph.nodes.send("recorder", signal.SIGTERM)
        code, _ = graph.expect_exit("recorder")
        assert code == 0
        first = graph.settled(dataset, take.id)
        assert first.reason == "aborted: the recorder was stopped"
        robot.send(take.messages[half:])
        robot.tell(take.ended)
        graph.until(
            lambda: [s for s in graph.health if s.name == "curator"][-1].hardware_id == "",
            "the curator has closed the episode",
        )
    assert [d.evidence["bag"] for d in Dataset(dataset).decisions(take.id)] == ["alone"]


def test_curator_that_is_stopped_in_mid_episode_waits_for_its_end(graph, dataset):
    """Ctrl-C reaches all nodes at once, and the owner needs a moment to publish the end."""
    take = libero_take(8)
    aborted = replace(take.ended, event="aborted", counts={}, reason="aborted: the robot stopped")
    with Robot(graph) as robot:
        robot.until_found(1)
        robot.tell(take.started)
        robot.send(take.messages[: take.until(0.5)])
        graph.until(
            lambda: [s for s in graph.health if s.name == "curator"][-1].hardware_id == take.id,
            "the curator has the episode",
        )
        graph.nodes.send("curator", signal.SIGINT)
        graph.quiet(0.3)  # without the wait it would have gone by now
        robot.tell(aborted)
        code, log = graph.expect_exit("curator")
    assert code == 0, log
    [decision] = Dataset(dataset).decisions(take.id)
    assert decision.verdict == "review"
    assert decision.reason.startswith(aborted.reason)
