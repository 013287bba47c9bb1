"""curator/alert over DDS: told while the episode runs, and the decision says the same."""

from __future__ import annotations

import pytest
from graph import DiagnosticArray
from robot import Robot, libero_take

from curation_ros.core.status import Status
from curation_ros.dataset import Dataset
from curation_ros.nodes.messages import single_from_ros
from curation_ros.nodes.qos import EVENTS

pytestmark = pytest.mark.ros


def test_a_lost_object_is_told_with_its_phase_and_time(graph):
    dataset = graph.folder / "dataset"
    alerts: list[tuple[int, Status]] = []

    def hear(message: DiagnosticArray) -> None:
        stamp = message.header.stamp
        alerts.append((stamp.sec * 10**9 + stamp.nanosec, single_from_ros(message)))

    heard = graph.node.create_subscription(DiagnosticArray, "curator/alert", hear, EVENTS)
    graph.start("curator", dataset=dataset)
    graph.ready("curator")
    graph.until(lambda: graph.node.count_publishers("curator/alert"), "the curator can alert")
    with Robot(graph) as robot:
        robot.until_heard(1)
        clean = robot.play(libero_take(1))
        graph.decided(clean.id)
        assert alerts == []
        early = robot.play(libero_take(2, open_at=70))
        graph.decided(early.id)
    graph.until(lambda: alerts, "the alert")
    [(stamp_ns, status)] = alerts
    assert (status.hardware_id, status.name) == (early.id, early.name)
    assert (status.level, status.message) == (2, "object-lost")
    assert "in LIFT" in status.values["reason"]
    span = (int(status.values["span_start"]), int(status.values["span_end"]))
    assert 0 < stamp_ns - (early.started.start_ns + span[0]) <= 0.3e9
    [decision] = Dataset(dataset).decisions(early.id)
    [found] = [f for f in decision.findings if f.id == "object-lost"]
    assert (found.message, found.span) == (status.values["reason"], span)
    assert "object-lost" in graph.log("curator")
    graph.node.destroy_subscription(heard)
