"""curator/alert over DDS: published during the episode, and confirmed by the decision."""

from __future__ import annotations

from dataclasses import replace

import pytest
import yaml
from episodes import topic_map
from graph import DiagnosticArray
from robot import BOWL, PLATE, Robot, libero_take, without

from curation_ros.core.episode.status import Status
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.messages import single_from_ros
from curation_ros.nodes.qos import EVENTS

pytestmark = pytest.mark.ros

#: A graph that does not publish objects.
NO_OBJECT = replace(
    topic_map(),
    fields={name: spec for name, spec in topic_map().fields.items() if spec.role != "object"},
    state=(),
)


def no_object(take):
    return without(without(take, BOWL), PLATE)


@pytest.mark.parametrize(
    ("objects", "found_by"), [(True, "object-lost"), (False, "grip-lost")], ids=str
)
def test_loss_is_published_with_phase_and_time(graph, objects, found_by):
    dataset = graph.folder / f"dataset-{found_by}"
    map_ = topic_map() if objects else NO_OBJECT
    path = graph.folder / f"{found_by}.yaml"
    path.write_text(yaml.safe_dump(map_.to_json()))
    alerts: list[tuple[int, Status]] = []

    def receive(message: DiagnosticArray) -> None:
        stamp = message.header.stamp
        alerts.append((stamp.sec * 10**9 + stamp.nanosec, single_from_ros(message)))

    subscription = graph.node.create_subscription(
        DiagnosticArray, "curator/alert", receive, EVENTS
    )
    graph.start("curator", found_by, dataset=dataset, topic_map=path)
    graph.ready(found_by)
    graph.until(lambda: graph.node.count_publishers("curator/alert"), "the curator can alert")
    with Robot(graph, map_, name=f"robot_{len(found_by)}") as robot:
        robot.until_found(1)
        clean, early = libero_take(1), libero_take(2, open_at=70)
        if not objects:
            clean, early = no_object(clean), no_object(early)
        robot.play(clean)
        graph.decided(clean.id)
        assert alerts == []
        robot.play(early)
        graph.decided(early.id)
    graph.until(lambda: alerts, "the alert")
    [(stamp_ns, status)] = alerts
    assert (status.hardware_id, status.name) == (early.id, early.name)
    assert (status.level, status.message) == (2, found_by)
    assert "in LIFT" in status.values["reason"]
    span = (int(status.values["span_start"]), int(status.values["span_end"]))
    assert 0 < stamp_ns - (early.started.start_ns + span[0]) <= 0.3e9
    [decision] = Dataset(dataset).decisions(early.id)
    [found] = [f for f in decision.findings if f.id == found_by]
    assert (found.message, found.span) == (status.values["reason"], span)
    assert found_by in graph.log(found_by)
    graph.node.destroy_subscription(subscription)
    graph.stop(found_by)
