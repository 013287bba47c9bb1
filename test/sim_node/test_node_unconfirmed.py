"""The expert with a recorder that does not receive one of the sim node's topics."""

from __future__ import annotations

import pytest
from graph import Graph

pytestmark = [pytest.mark.ros, pytest.mark.sim]
pytest.importorskip("libero", reason="LIBERO is not installed")

PLATE = "objects/plate_1/pose"


def test_first_step_waits_for_every_topic_and_the_missing_one_is_named(graph: Graph):
    graph.start("recorder", dataset=graph.folder / "data", remaps={PLATE: "elsewhere"})
    graph.start("sim_node", max_steps=3, command_timeout_s=0.1, wait_for=["recorder"])
    graph.ready("recorder", "sim_node")
    event = graph.until(
        lambda: next((e for e in graph.events if e.event != "started"), None), "the end"
    )
    assert event.reason == f"aborted: the first step does not reach recorder on {PLATE}"
    assert event.end_ns == event.start_ns
    assert graph.recorded(event.id).message == f"closed {event.id}"
    assert graph.expect_exit("sim_node")[0] == 0
