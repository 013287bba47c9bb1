"""A rule over the whole dataset: provisional during recording, final by ~/curate."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from robot import Robot, libero_take
from std_srvs.srv import Trigger

from curation_ros.dataset.dataset import Dataset

pytestmark = pytest.mark.ros

#: Shorter is better, and each episode is shorter than all before it.
LENGTHS = (90, 80, 70, 60, 50, 40)
CONFIG = """
scorers: [length, gripper_timing]
rule: top-fraction
rule_scorer: length
rule_params: {value: 0.5}
"""


@pytest.fixture(scope="module")
def dataset(graph):
    path = graph.folder / "dataset"
    config = graph.folder / "curation.yaml"
    config.write_text(CONFIG)
    graph.start("recorder", dataset=path)
    graph.start("curator", dataset=path, config=str(config))
    graph.ready("recorder", "curator")
    return path


@pytest.fixture(scope="module")
def takes(graph, dataset):
    with Robot(graph) as robot:
        robot.until_found(2)
        takes = []
        for k, n_steps in enumerate(LENGTHS):
            takes.append(robot.play(libero_take(k, n_steps, name=f"pick-{k + 1}")))
            graph.decided(takes[-1].id)
            graph.recorded(takes[-1].id)
        yield takes


def test_live_decisions_are_provisional_and_count_the_episodes_so_far(graph, dataset, takes):
    first = [Dataset(dataset).decisions(t.id)[0] for t in takes]
    assert {d.evidence["basis"] for d in first} == {"provisional"}
    assert [d.evidence["fitted_on"]["episodes"] for d in first] == [1, 2, 3, 4, 5, 6]
    reasons = [d.reason for d in first]
    assert reasons[0] == "the rule needs 4 scored episodes; there are 1"
    assert reasons[5] == "length -40.00 is among the best 3 of 6"
    assert [d.verdict for d in first] == ["review"] * 3 + ["keep"] * 3
    assert graph.decided(takes[5].id).message == "keep"


def test_curate_decides_finally_and_publishes_new_decisions(graph, dataset, takes):
    answer = graph.call(Trigger, "curator/curate", Trigger.Request())
    assert answer.success, answer.message
    for take, verdict in zip(takes, ["discard"] * 3 + ["keep"] * 3, strict=True):
        last = Dataset(dataset).decisions(take.id)[-1]
        assert (last.verdict, last.evidence["basis"]) == (verdict, "final")
        assert last.evidence["fitted_on"]["episodes"] == len(LENGTHS)
        assert graph.decided(take.id, revision=last.revision).message == verdict
    manifest = json.loads(Path(answer.message).read_text())
    assert {e["episode"] for e in manifest["entries"]} == {t.id for t in takes[3:]}
    log = graph.log("curator")
    assert "Traceback" not in log
