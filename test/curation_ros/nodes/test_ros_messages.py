"""Plain messages as ROS messages: the same content as in a bag."""

from __future__ import annotations

import pytest
from bag_messages import to_plain
from plain_messages import MESSAGES, STAMP_NS

rclpy_serialization = pytest.importorskip("rclpy.serialization", reason="rclpy is not installed")
pytestmark = pytest.mark.ros

from curation_ros.bags import CdrDecoder  # noqa: E402
from curation_ros.core.episode import messages  # noqa: E402
from curation_ros.core.episode.status import Status  # noqa: E402
from curation_ros.nodes.messages import (  # noqa: E402
    array_to_ros,
    single_from_ros,
    status_to_ros,
    time_from_ros,
    time_to_ros,
    to_ros,
)


@pytest.mark.parametrize("type_name", MESSAGES)
def test_content_is_what_a_subscriber_gets(type_name: str) -> None:
    message = to_ros(type_name, MESSAGES[type_name])
    data = rclpy_serialization.serialize_message(message)
    assert to_plain(CdrDecoder().read_message(type_name, data)) == MESSAGES[type_name]


def test_two_messages_share_nothing() -> None:
    first, second = (
        to_ros(messages.TWIST, messages.twist([x, 0.0, 0.0], STAMP_NS)) for x in (0.1, 0.2)
    )
    assert (first.twist.linear.x, second.twist.linear.x) == (0.1, 0.2)


def test_status_comes_back() -> None:
    status = Status(2, "bowl-0001", "aborted", "id", {"reason": "stopped", "count/phase": "3"})
    assert single_from_ros(array_to_ros([status], STAMP_NS)) == status
    assert status_to_ros(status).level == b"\x02"


def test_stamp_comes_back() -> None:
    assert time_from_ros(time_to_ros(STAMP_NS)) == STAMP_NS
