"""The sim node with its expert: complete episodes, and labels apart from the data."""

from __future__ import annotations

import json

import pytest
from commander import COMMANDS
from robot import Robot

from curation_ros.bags import open_bag
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = [pytest.mark.ros, pytest.mark.sim]
pytest.importorskip("libero", reason="LIBERO is not installed")

PERIOD_NS = 50_000_000
OBSERVATIONS = ("joint_states", "eef_pose", "phase")


@pytest.fixture(scope="module")
def expert(graph):
    """Two episodes of the expert, recorded."""
    dataset = graph.folder / "expert"
    graph.start(
        "sim_node",
        dataset=dataset,
        episodes=2,
        contamination=0.5,
        max_steps_defective=120,
        seed=3,
        wait_for=["recorder"],
    )
    problem = "topic episode has two owners: stop one of them"
    with Robot(graph, types={}, name="usurper"):
        assert graph.problem("sim_node", problem).level == 2
    graph.start("recorder", dataset=dataset)
    code, log = graph.expect_exit("sim_node")
    assert code == 0, log
    graph.stop("recorder")
    return dataset


def test_expert_episodes_are_recorded_whole(graph, expert):
    starts = [e for e in graph.events if e.event == "started"]
    ends = [e for e in graph.events if e.event == "ended"]
    assert [e.id for e in starts] == [e.id for e in ends]
    assert [e.name for e in starts] == ["bowl-0001", "bowl-0002"]
    for event in ends:
        episode = read_episode(expert / "episodes" / event.id)
        assert episode.findings == ()
        # An episode ends with the last executed command; counts are distinct stamps.
        n = len(episode)
        assert event.end_ns == event.start_ns + (n - 1) * PERIOD_NS
        assert episode.stamps_ns.tolist() == list(
            range(event.start_ns, event.end_ns + 1, PERIOD_NS)
        )
        bag = open_bag(expert / "episodes" / event.id)
        assert set(event.counts) >= {*OBSERVATIONS, *COMMANDS}
        assert set(event.counts.values()) == {n}
        # The first step may be there twice, if discovery by the recorder took time.
        assert all(topic.count >= n for topic in bag.topics.values())
        recorded = json.loads(bag.custom_data["recording"])["topics"]
        assert {stats["count"] for stats in recorded.values()} == {n}


def test_stamps_never_go_back_over_a_reset(graph, expert):
    first, second = (e for e in graph.events if e.event == "ended")
    assert second.start_ns > first.end_ns


def test_outcome_and_truth_travel_apart_from_the_data(graph, expert):
    ids = [e.id for e in graph.events if e.event == "ended"]
    truth = Dataset(expert).truth()
    assert set(truth) == set(ids)
    assert sorted(t["defect"] for t in truth.values()) == ["early_release", "none"]
    for episode_id, line in truth.items():
        wanted = "failed" if line["defect"] == "early_release" else "succeeded"
        assert line["outcome"] == wanted
        graph.until(lambda i=episode_id: i in [s.hardware_id for s in graph.outcomes], "outcome")
        published = [s.message for s in graph.outcomes if s.hardware_id == episode_id]
        assert published == [wanted]
        bag = open_bag(expert / "episodes" / episode_id)
        assert not [t for t in bag.topics if "outcome" in t or t in ("/episode", "/clock")]
        files = b"".join(p.read_bytes() for p in bag.path.iterdir())
        assert not [word for word in (b"early_release", b"succeeded", b"defect") if word in files]


WRONG = {
    "contamination": (2.0, "parameter 'contamination': expected float in [0.0, 1.0]"),
    "mode": ("dance", "parameter 'mode': 'dance' is none of expert, command"),
    "starts": ("nonsense", "expected official:FIRST:END, generated:SEED:COUNT"),
}


@pytest.fixture(scope="module")
def refused(graph):
    """Parameter -> (exit code, output) of a node with a wrong value of it."""
    for name, (value, _) in WRONG.items():
        graph.start("sim_node", f"wrong_{name}", **{name: value})
    return {name: graph.expect_exit(f"wrong_{name}") for name in WRONG}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_parameter_is_one_line_and_code_2(refused, name):
    code, log = refused[name]
    assert code == 2
    assert [line for line in log.splitlines() if not line.startswith("[")] == [log.strip()]
    assert log.startswith("error: ")
    assert WRONG[name][1] in log
