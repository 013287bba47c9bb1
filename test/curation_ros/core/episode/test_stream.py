from __future__ import annotations

import struct

import numpy as np
import pytest
from bag_messages import header, joint_state, make, pose, to_cdr
from hypothesis import given
from hypothesis import strategies as st

from curation_ros.core.episode.stream import (
    Messages,
    Sample,
    header_stamp_ns,
    header_stamps_ns,
    playback_order,
)
from curation_ros.core.errors import EpisodeError

STAMP_NS = 1_781_000_000_123_456_789


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("stamp_ns", [STAMP_NS, 0, 999_999_999, (2**31 - 1) * 10**9, -(10**9)])
def test_header_stamp_is_read_in_both_byte_orders(stamp_ns: int, little_endian: bool) -> None:
    for message in (
        pose(stamp_ns, (1.0, 2.0, 3.0)),
        joint_state(stamp_ns, {"a": 1.0}),
        make(
            "sensor_msgs/msg/Temperature", header=header(stamp_ns), temperature=1.0, variance=0.0
        ),
    ):
        assert header_stamp_ns(to_cdr(message, little_endian=little_endian)) == stamp_ns


@pytest.mark.parametrize("n_bytes", [0, 1, 4, 11])
def test_message_too_short_for_a_header_is_refused(n_bytes: int) -> None:
    data = to_cdr(pose(STAMP_NS, (1.0, 2.0, 3.0)))[:n_bytes]
    with pytest.raises(EpisodeError, match=f"message of {n_bytes} bytes"):
        header_stamp_ns(data)


@given(
    stamps=st.lists(st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(0, 2**32 - 1))),
    seed=st.integers(0, 99),
)
def test_stamps_of_many_messages_are_those_of_each(
    stamps: list[tuple[int, int]], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    messages = []
    for sec, nanosec in stamps:
        order = int(rng.integers(2))
        head = struct.pack("<BBHiI" if order else ">BBHiI", 0, order, 0, sec, nanosec)
        messages.append(head + rng.bytes(int(rng.integers(0, 5))))
    found = header_stamps_ns(Messages.joined(messages))
    assert found.tolist() == [header_stamp_ns(data) for data in messages]
    assert found.dtype == np.int64


def test_one_message_too_short_for_a_header_among_many_is_refused() -> None:
    whole = to_cdr(pose(STAMP_NS, (1.0, 2.0, 3.0)))
    with pytest.raises(EpisodeError, match="message of 11 bytes"):
        header_stamps_ns(Messages.joined([whole, whole[:11], whole[:3]]))


def test_messages_give_back_their_bytes() -> None:
    messages = [b"", b"abc", b"d", b""]
    joined = Messages.joined(messages)
    assert [joined[k] for k in range(len(joined))] == messages
    some = joined.take(np.array([2, 1]))
    assert [some[k] for k in range(2)] == [b"d", b"abc"]
    assert [some.compact()[k] for k in range(2)] == [b"d", b"abc"]
    assert len(some.compact().buffer) == 4


def _samples(*pairs: tuple[str, int]) -> list[Sample]:
    return [Sample(topic, stamp_ns, k, b"") for k, (topic, stamp_ns) in enumerate(pairs)]


def _order(samples: list[Sample]) -> list[int]:
    return [s.seq for s in playback_order(samples)]


def test_playback_is_in_stamp_order_across_topics() -> None:
    samples = _samples(("a", 1), ("a", 2), ("a", 3), ("b", 1), ("b", 2), ("c", 0))
    assert _order(samples) == [5, 0, 3, 1, 4, 2]


def test_playback_keeps_the_order_of_equal_stamps() -> None:
    assert _order(_samples(("b", 1), ("a", 1), ("b", 1), ("a", 1))) == [0, 1, 2, 3]


def test_stamps_that_went_back_stay_in_their_order() -> None:
    samples = _samples(("a", 1), ("a", 5), ("a", 3), ("a", 6), ("b", 4), ("b", 5), ("b", 6))
    assert _order(samples) == [0, 4, 1, 2, 5, 3, 6]


_STREAM = st.lists(st.tuples(st.sampled_from("abc"), st.integers(0, 20)), max_size=30)


@given(_STREAM)
def test_playback_keeps_each_topic_as_recorded(pairs: list[tuple[str, int]]) -> None:
    samples = _samples(*pairs)
    played = playback_order(samples)
    assert sorted(played, key=lambda s: s.seq) == samples
    for topic in "abc":
        assert [s for s in played if s.topic == topic] == [s for s in samples if s.topic == topic]


@given(_STREAM)
def test_playback_of_a_healthy_stream_is_sorted_by_stamp(pairs: list[tuple[str, int]]) -> None:
    played = playback_order(_samples(*sorted(pairs, key=lambda pair: (pair[0], pair[1]))))
    stamps = [s.stamp_ns for s in played]
    assert stamps == sorted(stamps)


@given(_STREAM)
def test_playing_back_what_was_played_back_changes_nothing(pairs: list[tuple[str, int]]) -> None:
    played = playback_order(_samples(*pairs))
    assert playback_order(played) == played
