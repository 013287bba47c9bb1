"""A curator on the graph: services, latched decisions, overrides, a restart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from graph import DECISIONS, DiagnosticArray, KeyValue
from robot import Robot, libero_take
from std_srvs.srv import Trigger
from streams import scores_from_status

from curation_ros.dataset.dataset import Dataset

pytestmark = pytest.mark.ros

#: More episodes than the curator remembers.
N_EPISODES, N_KEPT = 204, 200


@pytest.fixture(scope="module")
def dataset(graph):
    path = graph.folder / "dataset"
    graph.start("recorder", dataset=path)
    graph.start("curator", dataset=path)
    graph.ready("recorder", "curator")
    return path


@pytest.fixture(scope="module")
def takes(graph, dataset):
    """Many short episodes, recorded and decided on."""
    with Robot(graph) as robot:
        robot.until_found(2)
        takes = []
        for k in range(N_EPISODES):
            takes.append(robot.play(libero_take(k, 3, name=f"pick-{k + 1:04d}")))
            graph.decided(takes[-1].id)
            graph.recorded(takes[-1].id)
        yield takes


def decisions(graph):
    from diagnostic_msgs.srv import SelfTest

    return graph.call(SelfTest, "curator/decisions", SelfTest.Request())


def override(graph, key, value):
    graph.until(graph.override_publisher.get_subscription_count, "the curator subscribes")
    graph.override_publisher.publish(KeyValue(key=key, value=value))


def test_service_returns_the_last_decisions(graph, takes):
    answer = decisions(graph)
    assert answer.passed == b"\x01"
    assert [s.hardware_id for s in answer.status] == [t.id for t in takes[-N_KEPT:]]
    assert {s.level for s in answer.status} == {b"\x01"}  # WARN: review
    values = {v.key: v.value for v in answer.status[0].values}
    assert values["verdict"] == answer.status[0].message == "review"
    assert values["reason"].startswith("too-short: 3 steps")
    assert values["score/knn"] == ""  # it abstained, without a reference
    assert float(values["score/length"]) == -3.0


def test_late_joiner_gets_the_latched_decisions(graph, takes):
    received = []
    late = graph.node.create_subscription(
        DiagnosticArray, "curator/decision", lambda m: received.extend(m.status), DECISIONS
    )
    graph.until(lambda: len(received) >= N_KEPT, "the latched decisions")
    graph.quiet(0.3)
    assert [s.hardware_id for s in received] == [t.id for t in takes[-N_KEPT:]]
    graph.node.destroy_subscription(late)


def test_published_scores_are_those_on_disk(graph, dataset, takes):
    status = graph.decided(takes[0].id)
    assert scores_from_status(status) == dict(Dataset(dataset).decisions(takes[0].id)[0].scores)


def test_override_by_name_and_by_the_beginning_of_an_id(graph, dataset, takes):
    override(graph, takes[3].name, "keep it looks fine")
    assert graph.decided(takes[3].id, revision=2).values["verdict"] == "keep"
    # Ids that are minted in the same millisecond share their first 13 digits.
    override(graph, takes[4].id[:30], "discard")
    status = graph.decided(takes[4].id, revision=2)
    assert (status.level, status.message) == (2, "discard")
    last = Dataset(dataset).decisions(takes[3].id)[-1]
    assert (last.by, last.reason, last.revision) == ("person", "person: it looks fine", 2)


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("0", "keep", "'0' means 204 episodes"),
        ("nobody", "keep", "no episode has the id or name 'nobody'"),
        ("pick-0001", "salvage", "override 'salvage' of 'pick-0001'"),
        ("", "", "override '' of ''"),
    ],
)
def test_override_that_makes_no_sense_is_a_line_in_the_log(graph, takes, key, value, complaint):
    override(graph, key, value)
    graph.ready("curator", line=complaint)
    assert "Traceback" not in graph.log("curator")


def test_curate_returns_the_path_of_its_manifest(graph, dataset, takes):
    answer = graph.call(Trigger, "curator/curate", Trigger.Request())
    assert answer.success, answer.message
    path = Path(answer.message)
    assert path.parent == dataset / "selections"
    manifest = json.loads(path.read_text())
    assert [e["episode"] for e in manifest["entries"]] == [takes[3].id]
    assert manifest["kept_of"] == N_EPISODES
    assert manifest["phases"]["shown"]["LIFT"] == {"demonstrations": 0, "steps": 0}
    graph.ready("curator", line="LIFT is shown by 0 of 1 demonstrations kept")


def test_restarted_curator_changes_no_decision(graph, dataset, takes):
    """It receives latched old events. Bags decide, and overrides stay in force."""
    logs = {log.name: log.read_text() for log in (dataset / "decisions").glob("*.jsonl")}
    graph.stop("curator")
    graph.decisions.clear()
    graph.start("curator", "curator-again", dataset=dataset, drain_timeout_s=1.0)
    graph.decided(takes[-1].id)
    graph.quiet(1.0)
    assert "[ERROR]" not in graph.log("curator-again")
    for name, text in logs.items():
        added = (dataset / "decisions" / name).read_text()[len(text) :].splitlines()
        # The same decision, now compared with its bag, and nothing else.
        assert all(json.loads(line)["revision"] == 1 for line in added), added
    assert {s.hardware_id for s in decisions(graph).status} >= {t.id for t in takes[-150:]}
    override(graph, takes[3].name, "review")
    assert graph.decided(takes[3].id, revision=3).values["verdict"] == "review"
