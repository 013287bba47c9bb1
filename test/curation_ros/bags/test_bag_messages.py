"""Plain messages as CDR."""

from __future__ import annotations

import bag_messages
import pytest
from bag_messages import to_plain
from plain_messages import MESSAGES, STAMP_NS

from curation_ros.bags import CdrDecoder
from curation_ros.bags.messages import to_cdr
from curation_ros.core.episode import messages
from curation_ros.core.errors import BagError


@pytest.mark.parametrize("type_name", MESSAGES)
def test_content_is_what_a_reader_gets(type_name: str) -> None:
    content = MESSAGES[type_name]
    found = CdrDecoder().read_message(type_name, to_cdr(type_name, content))
    assert to_plain(found) == content


def test_bytes_are_those_of_rosbags() -> None:
    ours = to_cdr(messages.POSE, MESSAGES[messages.POSE])
    assert ours == bag_messages.to_cdr(
        bag_messages.pose(STAMP_NS, (0.1, 0.2, 0.3), (0.5, -0.5, 0.5, 0.5))
    )
    ours = to_cdr(messages.TWIST, MESSAGES[messages.TWIST])
    assert ours == bag_messages.to_cdr(bag_messages.twist(STAMP_NS, (1.0, -0.25, 1 / 3)))


@pytest.mark.parametrize(
    ("type_name", "content", "found"),
    [
        ("my_msgs/msg/Thing", {}, "no message type my_msgs/msg/Thing"),
        (messages.CLOCK, {}, "KeyError 'clock'"),
        (messages.CLOCK, {"clock": {"sec": "soon", "nanosec": 0}}, "rosgraph_msgs/msg/Clock"),
    ],
)
def test_what_does_not_fit_is_an_error(type_name: str, content: dict, found: str) -> None:
    with pytest.raises(BagError, match=found):
        to_cdr(type_name, content)
