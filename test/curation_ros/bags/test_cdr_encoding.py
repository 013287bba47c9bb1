"""Encoding is the inverse of decoding, and gives the bytes of other implementations."""

from __future__ import annotations

import numpy as np
import pytest
from bag_messages import STORE, random_message, to_cdr, to_plain

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.cdr_encoding import encode
from curation_ros.bags.definitions import parse_definition
from curation_ros.bags.schemas import message_schema
from curation_ros.core.errors import EpisodeError

TYPES = sorted(
    name
    for name in STORE.fielddefs
    if name.split("/")[0]
    in ("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "sensor_msgs", "std_msgs")
    and name != "std_msgs/msg/Empty"  # the value of its one byte means nothing
)


def definitions(type_name):
    text = message_schema(type_name).text
    return parse_definition(type_name, text, lambda name: message_schema(name).text)


@pytest.mark.parametrize("type_name", TYPES)
def test_bytes_are_those_of_rosbags(type_name):
    rng = np.random.default_rng(1)
    for _ in range(5):
        message = random_message(type_name, rng)
        found = encode(type_name, definitions(type_name), to_plain(message))
        assert found == to_cdr(message)


def test_members_that_are_absent_are_zero_or_empty():
    name = "sensor_msgs/msg/Imu"
    data = encode(name, definitions(name), {"linear_acceleration": {"z": 9.81}})
    message = CdrDecoder().read_message(name, data)
    assert message["header"] == {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""}
    assert message["linear_acceleration"] == {"x": 0.0, "y": 0.0, "z": 9.81}
    assert message["orientation_covariance"].tolist() == [0.0] * 9


@pytest.mark.parametrize(
    ("name", "members", "words"),
    [
        ("std_msgs/msg/Int8", {"data": 300}, "'data' has value 300, expected a int8"),
        ("std_msgs/msg/Float64", {"data": "much"}, "'data' has value 'much', expected a float64"),
        (
            "sensor_msgs/msg/Imu",
            {"orientation_covariance": [1.0]},
            "'orientation_covariance' has 1 elements, expected 9",
        ),
        (
            "shape_msgs/msg/SolidPrimitive",
            {"dimensions": [1.0] * 4},
            "'dimensions' has 4 elements, at most 3",
        ),
    ],
)
def test_value_that_does_not_fit_is_refused(name, members, words):
    with pytest.raises(EpisodeError, match=words) as caught:
        encode(name, definitions(name), members)
    assert name in str(caught.value)
