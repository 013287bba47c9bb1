from __future__ import annotations

import contextlib
import struct
from typing import Any

import numpy as np
import pytest
from bag_messages import (
    JOINTS,
    POSE,
    START_NS,
    STATUS,
    STORE,
    header,
    joint_state,
    make,
    pose,
    random_message,
    status,
    to_cdr,
    to_plain,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Schema

from curation_ros.bags.cdr import CdrDecoder, shared_decoder
from curation_ros.bags.schemas import message_schema
from curation_ros.core.episode.stream import Messages
from curation_ros.core.errors import BagError, ConfigError, EpisodeError

JOINT_NAMES = [f"panda_joint{i}" for i in range(1, 8)]


def _all_types() -> list[str]:
    packages = ("sensor_msgs", "geometry_msgs", "diagnostic_msgs", "std_msgs", "nav_msgs")
    packages += ("trajectory_msgs", "shape_msgs", "visualization_msgs", "builtin_interfaces")
    return sorted(t for t in STORE.fielddefs if t.split("/")[0] in packages)


@pytest.mark.parametrize("little_endian", [True, False])
@pytest.mark.parametrize("type_name", _all_types())
def test_read_message_equals_rosbags(type_name: str, little_endian: bool) -> None:
    rng = np.random.default_rng(7)
    decoder = CdrDecoder()
    for _ in range(4):
        message = random_message(type_name, rng)
        data = to_cdr(message, little_endian=little_endian)
        assert to_plain(decoder.read_message(type_name, data)) == to_plain(message)


def _leaf_paths(type_name: str, value: Any, prefix: str = "") -> list[str]:
    """Paths to all numbers and texts of a message, by index."""
    if isinstance(value, dict):
        return [p for k, v in value.items() for p in _leaf_paths(type_name, v, f"{prefix}{k}.")]
    if isinstance(value, (list, np.ndarray)):
        return [p for k, v in enumerate(value) for p in _leaf_paths(type_name, v, f"{prefix}{k}.")]
    return [prefix[:-1]]


def _value_at(value: Any, path: str) -> Any:
    for token in path.split("."):
        value = value[int(token)] if token.isdigit() else value[token]
    return value


@settings(max_examples=25, deadline=None)
@given(st.sampled_from(_all_types()), st.integers(0, 2**32 - 1), st.booleans())
def test_columns_equal_the_general_reader(type_name: str, seed: int, little_endian: bool) -> None:
    rng = np.random.default_rng(seed)
    decoder = CdrDecoder()
    kinds = [random_message(type_name, rng) for _ in range(3)]
    plain = [decoder.read_message(type_name, to_cdr(m)) for m in kinds]
    paths = sorted(set.intersection(*(set(_leaf_paths(type_name, p)) for p in plain)))[:12]
    order = rng.integers(0, 3, 40)
    data = [to_cdr(m, little_endian=little_endian) for m in kinds]
    columns = decoder.decode(type_name, paths, [data[k] for k in order])
    assert len(columns) == len(paths)
    for path, column in zip(paths, columns, strict=True):
        expected = [_value_at(plain[k], path) for k in order]
        if isinstance(expected[0], str):
            assert column.tolist() == expected
        else:
            np.testing.assert_array_equal(column, np.array(expected, dtype=np.float64))
            assert column.dtype == np.float64


def _joint_states(n: int = 50) -> list[bytes]:
    return [
        to_cdr(joint_state(START_NS + k, {name: k + j / 10 for j, name in enumerate(JOINT_NAMES)}))
        for k in range(n)
    ]


def test_joint_is_found_by_name_in_whatever_order_each_message_has() -> None:
    rng = np.random.default_rng(0)
    messages, expected = [], []
    for k in range(200):
        names = JOINT_NAMES if k < 100 else list(rng.permutation(JOINT_NAMES))
        values = {str(name): float(rng.normal()) for name in names}
        messages.append(to_cdr(joint_state(k, values)))
        expected.append([values["panda_joint3"], values["panda_joint7"]])
    columns = CdrDecoder().decode(
        JOINTS, ["position.panda_joint3", "position.panda_joint7"], messages
    )
    np.testing.assert_array_equal(np.column_stack(columns), expected)


def test_joint_names_may_hold_dots_and_slashes() -> None:
    data = to_cdr(joint_state(1, {"arm/left.joint.1": 4.5, "arm": 1.0}))
    for messages in ([data], [data] * 3):
        columns = CdrDecoder().decode(JOINTS, ["position.arm/left.joint.1"], messages)
        assert columns[0].tolist() == [4.5] * len(messages)


def test_key_gives_its_value_as_text() -> None:
    messages = [
        to_cdr(status(k, "GRASP" if k % 2 else "LIFT", {"index": "2", "a.b": repr(k / 7)}))
        for k in range(30)
    ]
    paths = [
        "status.0.message",
        "status.0.values.a.b",
        "status.0.values.0.value",
        "status.0.level",
    ]
    message, by_key, by_index, level = CdrDecoder().decode(STATUS, paths, messages)
    assert message.tolist() == ["LIFT", "GRASP"] * 15
    assert [float(x) for x in by_key] == [k / 7 for k in range(30)]
    assert by_index.tolist() == ["2"] * 30
    assert level.dtype == np.float64


def test_times_are_nested_members() -> None:
    columns = CdrDecoder().decode(
        POSE,
        ["header.stamp.sec", "header.stamp.nanosec", "header.frame_id"],
        [to_cdr(pose(5_000_000_007, (1.0, 2.0, 3.0)))] * 2,
    )
    assert [c.tolist() for c in columns] == [[5.0, 5.0], [7.0, 7.0], ["world", "world"]]


def test_no_messages_give_empty_columns_of_the_right_kind() -> None:
    number, text = CdrDecoder().decode(JOINTS, ["position.0", "header.frame_id"], [])
    assert (number.shape, number.dtype) == ((0,), np.float64)
    assert (text.shape, text.dtype.kind) == ((0,), "U")


@pytest.mark.parametrize("padding", [0, 1, 3, 4, 7])
def test_empty_trailing_lists_with_padding_are_read(padding: int) -> None:
    message = joint_state(9, {"a": 1.5}, velocity=[], effort=[])
    data = to_cdr(message) + b"\xaa" * padding
    plain = CdrDecoder().read_message(JOINTS, data)
    assert plain["position"].tolist() == [1.5]
    assert plain["velocity"].size == plain["effort"].size == 0
    columns = CdrDecoder().decode(JOINTS, ["position.a"], [data] * 4)
    assert columns[0].tolist() == [1.5] * 4


def test_uninitialised_padding_does_not_matter() -> None:
    plain = [bytearray(data) for data in _joint_states(40)]
    decoder = CdrDecoder()
    # "world" and its terminator end at byte 22; the next length stands at 24.
    for k, data in enumerate(plain):
        data[22:24] = bytes([k, 255 - k])
    column = decoder.decode(JOINTS, ["position.0"], [bytes(d) for d in plain])[0]
    assert column.tolist() == list(range(40))


def test_mixed_byte_orders_and_shapes_in_one_batch() -> None:
    messages, expected = [], []
    for k in range(60):
        names = {name: float(k * j) for j, name in enumerate(JOINT_NAMES[: 3 + k % 4])}
        message = joint_state(k, names, velocity=[] if k % 3 else None)
        messages.append(to_cdr(message, little_endian=k % 2 == 0))
        expected.append(float(k * 2))
    column = CdrDecoder().decode(JOINTS, ["position.panda_joint3"], messages)[0]
    assert column.tolist() == expected


def test_all_different_layouts_of_one_length() -> None:
    rng = np.random.default_rng(2)
    messages, expected = [], []
    for _ in range(30):
        cut = rng.permutation(np.arange(12))
        names = ["x" * (cut[k] + 1) for k in range(12)]
        values = {name: float(rng.normal()) for name in names}
        messages.append(to_cdr(joint_state(1, values)))
        expected.append(values["xxx"])
    assert CdrDecoder().decode(JOINTS, ["position.xxx"], messages)[0].tolist() == expected


def test_bools_and_integers_become_floats() -> None:
    booleans = [to_cdr(make("std_msgs/msg/Bool", data=bool(k % 2))) for k in range(4)]
    assert CdrDecoder().decode("std_msgs/msg/Bool", ["data"], booleans)[0].tolist() == [0, 1, 0, 1]
    integers = [to_cdr(make("std_msgs/msg/Int64", data=-k)) for k in range(4)]
    assert CdrDecoder().decode("std_msgs/msg/Int64", ["data"], integers)[0].tolist() == [
        0,
        -1,
        -2,
        -3,
    ]


def test_empty_message_takes_one_byte() -> None:
    text = "Gap gap\nfloat64 x\n" + "=" * 80 + "\nMSG: my_msgs/Gap\n"
    decoder = CdrDecoder({"my_msgs/msg/Holder": text})
    data = b"\0\1\0\0" + b"\0" * 8 + struct.pack("<d", 2.5)
    plain = decoder.read_message("my_msgs/msg/Holder", data)
    assert plain == {"gap": {}, "x": 2.5}


WIDE = """
# every kind of member
int32 LIMIT=5
string NAME="a # b"
string<=4 short
wstring wide
wstring[] wides
float32[2] pair
int16[<=3] few
bool[] flags
string[2] labels
int8 with_default -3
float64[] list_default [1.0, 2.0]
time old
Header header
"""


def _wide_message(order: str) -> bytes:
    out = bytearray()

    def put(code: str, *values: Any) -> None:
        size = struct.calcsize(f"={code[-1]}")
        out.extend(b"\xee" * (-len(out) % size))
        out.extend(struct.pack(f"{order}{code}", *values))

    def text(value: str) -> None:
        raw = value.encode() + b"\0"
        put("I", len(raw))
        out.extend(raw)

    def wide(value: str) -> None:
        raw = value.encode("utf-16-le")
        words = struct.unpack(f"<{len(raw) // 2}H", raw)
        put("I", len(words))
        for word in words:
            put("I", word)

    text("abcd")
    wide("hé€😀")
    put("I", 2)
    wide("")
    wide("x")
    put("2f", 1.5, -2.5)
    put("I", 3)
    put("3h", 1, -2, 3)
    put("I", 2)
    put("2?", True, False)
    text("left")
    text("")
    put("b", -7)
    put("I", 2)
    put("2d", 3.0, 4.0)
    put("i", 11)
    put("I", 12)
    put("i", 13)
    put("I", 14)
    text("map")
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + bytes(out)


@pytest.mark.parametrize("order", ["<", ">"])
def test_definition_of_a_bag_with_every_kind_of_member(order: str) -> None:
    decoder = CdrDecoder({"my_msgs/msg/Wide": WIDE})
    data = _wide_message(order)
    plain = to_plain(decoder.read_message("my_msgs/msg/Wide", data))
    assert plain == {
        "short": "abcd",
        "wide": "hé€😀",
        "wides": ["", "x"],
        "pair": [1.5, -2.5],
        "few": [1, -2, 3],
        "flags": [True, False],
        "labels": ["left", ""],
        "with_default": -7,
        "list_default": [3.0, 4.0],
        "old": {"sec": 11, "nanosec": 12},
        "header": {"stamp": {"sec": 13, "nanosec": 14}, "frame_id": "map"},
    }
    paths = ["wide", "labels.0", "few.2", "flags.0", "header.frame_id"]
    columns = decoder.decode("my_msgs/msg/Wide", paths, [data] * 3)
    assert [c.tolist() for c in columns] == [
        ["hé€😀"] * 3,
        ["left"] * 3,
        [3.0] * 3,
        [1.0] * 3,
        ["map"] * 3,
    ]


def test_bounds_of_the_definition_are_enforced() -> None:
    decoder = CdrDecoder({"my_msgs/msg/Few": "int16[<=3] few\n", "my_msgs/msg/S": "string<=2 s\n"})
    few = b"\0\1\0\0" + struct.pack("<I4h", 4, 1, 2, 3, 4)
    with pytest.raises(EpisodeError, match="at most 3"):
        decoder.read_message("my_msgs/msg/Few", few)
    with pytest.raises(EpisodeError, match="of 2 bytes"):
        decoder.read_message("my_msgs/msg/S", b"\0\1\0\0" + struct.pack("<I4s", 4, b"abc"))


def test_definition_of_the_bag_wins_over_the_installed_one() -> None:
    decoder = CdrDecoder({POSE: "float64 other\n"})
    assert decoder.read_message(POSE, b"\0\1\0\0" + struct.pack("<d", 3.5)) == {"other": 3.5}
    assert not decoder.has_header(POSE)
    assert decoder.has_header(JOINTS)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("Loop loop\n", "contains itself"),
        ("float64 x y z\n= nonsense\n", "no member"),
        ("Unknown there\n", "no definition of"),
    ],
)
def test_definitions_that_make_no_sense_are_refused(text: str, said: str) -> None:
    with pytest.raises(BagError, match=said):
        CdrDecoder({"my_msgs/msg/Loop": text}).read_message("my_msgs/msg/Loop", b"\0\1\0\0")


def test_unknown_type_is_named() -> None:
    with pytest.raises(BagError, match="no_such_msgs/msg/Thing"):
        CdrDecoder().decode("no_such_msgs/msg/Thing", ["x"], [])


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("pose.position.x", "'pose' is no member of .*it has header, name, position"),
        ("position", "an index or one of its name"),
        ("position.1.x", "has no 'x'"),
        ("name.foo", "an index"),
        ("header.stamp", "Time is a message; it has sec, nanosec"),
        ("header.frame_id.x", "has no 'x'"),
        ("", "no member"),
        ("position.", "an index"),
    ],
)
def test_path_that_the_type_lacks_is_a_config_error(path: str, said: str) -> None:
    decoder = CdrDecoder()
    with pytest.raises(ConfigError, match=said) as caught:
        decoder.decode(JOINTS, [path], _joint_states(1))
    assert JOINTS in str(caught.value)


@pytest.mark.parametrize("n", [1, 2, 20])
def test_missing_joint_or_element_is_an_episode_error(n: int) -> None:
    decoder = CdrDecoder()
    with pytest.raises(EpisodeError, match=r"'nope' once, found it 0 times among panda_joint1"):
        decoder.decode(JOINTS, ["position.nope"], _joint_states(n))
    with pytest.raises(EpisodeError, match="element 7, but there are 7"):
        decoder.decode(JOINTS, ["position.7"], _joint_states(n))


def test_values_shorter_than_names_are_an_episode_error() -> None:
    data = to_cdr(joint_state(1, dict.fromkeys(JOINT_NAMES, 1.0), velocity=[]))
    with pytest.raises(EpisodeError, match="element 2, but there are 0"):
        CdrDecoder().decode(JOINTS, ["velocity.panda_joint3"], [data] * 3)


def test_one_message_with_another_name_does_not_pass_for_the_rest() -> None:
    messages = _joint_states(20)
    messages[11] = messages[11].replace(b"panda_joint3", b"panda_jointX")
    with pytest.raises(EpisodeError, match="panda_joint3"):
        CdrDecoder().decode(JOINTS, ["position.panda_joint3"], messages)


def test_duplicate_name_is_refused() -> None:
    data = to_cdr(
        make(JOINTS, header=header(1), name=["a", "a"], position=np.ones(2), velocity=np.ones(0),
             effort=np.ones(0))
    )  # fmt: skip
    with pytest.raises(EpisodeError, match="found it 2 times"):
        CdrDecoder().decode(JOINTS, ["position.a"], [data])


@pytest.mark.parametrize("message", ["joints", "status"])
def test_truncation_anywhere_is_an_episode_error(message: str) -> None:
    if message == "joints":
        type_name, paths = JOINTS, ["position.panda_joint3"]
        whole = _joint_states(1)[0]
    else:
        type_name, paths = STATUS, ["status.0.values.progress"]
        whole = to_cdr(status(1, "LIFT", {"index": "3", "progress": "0.5"}))
    decoder = CdrDecoder()
    for n in range(len(whole)):
        for copies in (1, 3):
            with pytest.raises(EpisodeError):
                decoder.decode(type_name, paths, [whole[:n]] * copies)
        with pytest.raises(EpisodeError):
            decoder.decode(type_name, paths, [whole, whole, whole[:n]])


@pytest.mark.parametrize("head", ["0002", "0003", "0007", "000a", "0101", "ffff"])
def test_other_encapsulations_are_refused(head: str) -> None:
    data = bytes.fromhex(head) + _joint_states(1)[0][2:]
    with pytest.raises(EpisodeError, match=head):
        CdrDecoder().decode(JOINTS, ["position.0"], [data])


def test_lying_lengths_neither_read_outside_nor_allocate() -> None:
    rng = np.random.default_rng(3)
    decoder = CdrDecoder()
    sources = [
        (JOINTS, ["position.panda_joint3", "header.frame_id"], _joint_states(1)[0]),
        (
            STATUS,
            ["status.0.values.progress", "status.0.message"],
            to_cdr(status(1, "LIFT", {"index": "3", "progress": "0.5"})),
        ),
    ]
    outcomes = set()
    for type_name, paths, whole in sources:
        good = [whole] * 3
        for at in range(4, len(whole) - 3):
            for lie in (0, 1, 0xFFFFFFFF, 0x7FFFFFFF, int(rng.integers(2**32))):
                bad = bytearray(whole)
                bad[at : at + 4] = struct.pack("<I", lie)
                try:
                    columns = decoder.decode(type_name, paths, [*good, bytes(bad)])
                    alone = decoder.decode(type_name, paths, [bytes(bad)])
                    assert [c[-1] for c in columns] == [c[0] for c in alone] or any(
                        c.dtype.kind == "f" and np.isnan(c[0]) for c in alone
                    )
                    outcomes.add("read")
                except EpisodeError:
                    with pytest.raises(EpisodeError):
                        decoder.decode(type_name, paths, [bytes(bad)])
                    outcomes.add("refused")
    assert outcomes == {"read", "refused"}


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=80), st.sampled_from(_all_types()))
def test_any_bytes_are_read_or_refused(data: bytes, type_name: str) -> None:
    decoder = CdrDecoder()
    for raw in (data, b"\0\1\0\0" + data, b"\0\0\0\0" + data):
        with contextlib.suppress(EpisodeError):
            decoder.read_message(type_name, raw)


def test_huge_fixed_arrays_of_a_hostile_definition_allocate_nothing() -> None:
    text = "Many[1000000000] a\n" + "=" * 80 + "\nMSG: my_msgs/Many\nfloat64[1000000000] b\n"
    with pytest.raises(EpisodeError, match="shortest message"):
        CdrDecoder({"my_msgs/msg/Huge": text}).read_message("my_msgs/msg/Huge", b"\0\1\0\0" * 9)


def test_text_that_is_not_utf8_is_refused() -> None:
    data = _joint_states(1)[0].replace(b"world", b"w\xffrld")
    for messages in ([data], [data] * 3):
        with pytest.raises(EpisodeError, match="UTF-8"):
            CdrDecoder().decode(JOINTS, ["header.frame_id"], messages)
        assert CdrDecoder().decode(JOINTS, ["position.0"], messages)[0].tolist() == [0.0] * len(
            messages
        )


def test_text_without_terminator_is_refused() -> None:
    data = _joint_states(1)[0].replace(b"world\0", b"worlds")
    for messages in ([data], [data, *_joint_states(2)]):
        with pytest.raises(EpisodeError, match="terminator"):
            CdrDecoder().decode(JOINTS, ["position.0"], messages)


def test_mcap_ros2_reads_the_same() -> None:
    theirs = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    rng = np.random.default_rng(5)

    def plain(value: Any) -> Any:
        if hasattr(value, "__slots__"):
            return {k: plain(getattr(value, k)) for k in value.__slots__}
        return [plain(v) for v in value] if isinstance(value, list) else value

    for n, type_name in enumerate([JOINTS, POSE, STATUS, "nav_msgs/msg/Path"]):
        text = message_schema(type_name).text
        record = Schema(id=n + 1, data=text.encode(), encoding="ros2msg", name=type_name)
        data = to_cdr(random_message(type_name, rng))
        ours = CdrDecoder({type_name: text}).read_message(type_name, data)
        read = theirs.decoder_for("cdr", record)
        assert read is not None
        np.testing.assert_equal(to_plain(ours), plain(read(data)))


@pytest.mark.ros
def test_bytes_of_rclpy_are_read() -> None:
    serialization = pytest.importorskip("rclpy.serialization")
    sensor_msgs = pytest.importorskip("sensor_msgs.msg")
    decoder = CdrDecoder()
    for velocity, effort in (
        ([], []),
        ([], [1.0, 2.0]),
        ([3.0, 4.0], []),
        ([3.0, 4.0], [5.0, 6.0]),
    ):
        message = sensor_msgs.JointState()
        message.header.stamp.sec, message.header.frame_id = 7, "base"
        message.name, message.position = ["a", "b"], [0.5, 1.5]
        message.velocity, message.effort = velocity, effort
        plain = to_plain(decoder.read_message(JOINTS, serialization.serialize_message(message)))
        assert plain["name"] == ["a", "b"]
        assert plain["position"] == [0.5, 1.5]
        assert (plain["velocity"], plain["effort"]) == (velocity, effort)
        assert plain["header"]["stamp"] == {"sec": 7, "nanosec": 0}
        ours = to_cdr(joint_state(7_000_000_000, {"a": 0.5, "b": 1.5}, velocity, effort))
        theirs = to_plain(decoder.read_message(JOINTS, ours.replace(b"world", b"base\0")))
        assert theirs["effort"] == effort


# --- blocks -------------------------------------------------------------------------------------

_PATHS = {
    STATUS: [
        "status.0.message",
        "status.0.values.progress",
        "status.0.level",
        "header.stamp.nanosec",
        "status.0.hardware_id",
    ],
    JOINTS: ["position.b", "effort.0", "header.frame_id", "position.a", "velocity.1"],
}


def _mixed_messages(type_name: str, n: int, rng: np.random.Generator) -> list[bytes]:
    """Regular messages among those with other names, orders, lengths, and damages."""

    def text(longest: int = 9) -> str:
        return "".join(rng.choice(list("abé"), int(rng.integers(0, longest))))

    out = []
    for k in range(n):
        odd = int(rng.integers(0, 8))
        message: Any
        if type_name == STATUS:
            values = {"index": text(), "progress": repr(float(rng.random()))[: odd + 3]}
            if odd == 1:
                values = {text(): "x"} | dict(reversed(values.items()))
            message = status(k, text(), values)
        else:
            names = list("abc") if odd else list(rng.permutation(["a", "b", "cc", "d"]))
            lists = {"velocity": [] if odd == 1 else None, "effort": [1.5, k] if odd > 2 else None}
            message = joint_state(k, {str(x): float(rng.normal()) for x in names}, **lists)
        data = bytearray(to_cdr(message, little_endian=bool(rng.integers(5))))
        damage = int(rng.integers(0, 12))
        if damage == 0:
            data = data[: int(rng.integers(0, len(data)))]
        elif damage == 1:
            for at in rng.integers(0, len(data), 2):
                data[at] = int(rng.integers(256))
        elif damage == 2:
            at = 4 * int(rng.integers(1, len(data) // 4))
            data[at : at + 4] = struct.pack("<I", int(rng.choice([0, 1, 5, 2**31, 2**32 - 1])))
        elif damage == 3:
            data += bytes(rng.bytes(int(rng.integers(1, 9))))
        out.append(bytes(data))
    return out


def _block(messages: list[bytes], rng: np.random.Generator) -> Messages:
    """Messages here and there in a buffer, in another order than that of their rows."""
    buffer, starts = bytearray(), [0] * len(messages)
    for row in rng.permutation(len(messages)).tolist():
        buffer += rng.bytes(int(rng.integers(0, 4)))
        starts[row] = len(buffer)
        buffer += messages[row]
    return Messages(
        np.frombuffer(bytes(buffer), dtype=np.uint8),
        np.array(starts, dtype=np.int64),
        np.array([len(data) for data in messages], dtype=np.int64),
    )


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([STATUS, JOINTS]),
    st.integers(0, 60),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_a_block_gives_what_the_messages_give_one_by_one(
    type_name: str, n: int, seed: int, is_warm: bool
) -> None:
    rng = np.random.default_rng(seed)
    paths = _PATHS[type_name]
    decoder = CdrDecoder()
    if is_warm:  # it knows many layouts, also some of those that come
        decoder.decode_block(
            type_name, paths, Messages.joined(_mixed_messages(type_name, 99, rng))
        )
    messages = _mixed_messages(type_name, n, rng)
    values, texts, bad = decoder.decode_block(type_name, paths, _block(messages, rng))
    assert values.shape == (n, len(paths))
    for row, data in enumerate(messages):
        fresh = CdrDecoder()  # it knows no layout, so it walks
        if row in bad:
            with pytest.raises(EpisodeError) as caught:
                fresh.decode(type_name, paths, [data])
            assert str(bad[row]) == str(caught.value)
            continue
        for k, column in enumerate(fresh.decode(type_name, paths, [data])):
            if k in texts:
                assert texts[k][row] == column[0]
            else:
                np.testing.assert_equal(values[row, k], column[0])
    assert set(texts) == {k for k, p in enumerate(paths) if p.split(".")[-1] in _TEXT_MEMBERS}


_TEXT_MEMBERS = ("message", "progress", "hardware_id", "frame_id")


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(_all_types()), st.integers(0, 2**32 - 1), st.booleans())
def test_a_warm_decoder_reads_any_type_as_a_new_one(
    type_name: str, seed: int, little_endian: bool
) -> None:
    rng = np.random.default_rng(seed)
    kinds = [to_cdr(random_message(type_name, rng), little_endian=little_endian) for _ in range(9)]
    decoder = CdrDecoder()
    plain = [decoder.read_message(type_name, data) for data in kinds]
    paths = sorted(set.intersection(*(set(_leaf_paths(type_name, p)) for p in plain)))[:12]
    block = Messages.joined([kinds[k] for k in rng.integers(0, 9, 60)])
    first = decoder.decode_block(type_name, paths, block)
    again = decoder.decode_block(type_name, paths, block)
    np.testing.assert_array_equal(first.values, again.values)
    assert {k: v.tolist() for k, v in first.texts.items()} == {
        k: v.tolist() for k, v in again.texts.items()
    }
    assert first.bad == again.bad == {}


def test_a_name_with_a_zero_behind_it_is_another_name() -> None:
    rng = np.random.default_rng(4)
    messages = [
        to_cdr(status(k, "x" * (k % 13), {"key": "v" * (k % 7), "last": "1"})) for k in range(90)
    ]
    odd = to_cdr(status(1, "x", {"key\0": "v", "last": "1"}))
    decoder = CdrDecoder()
    decoder.decode_block(STATUS, ["status.0.values.key"], Messages.joined(messages))
    columns = decoder.decode_block(
        STATUS, ["status.0.values.key"], _block([*messages, odd, messages[0]], rng)
    )
    assert list(columns.bad) == [90]
    assert "'key' once, found it 0 times" in str(columns.bad[90])
    assert columns.texts[0][:90].tolist() == ["v" * (k % 7) for k in range(90)]


def test_bad_messages_cost_neither_their_neighbours_nor_much_time() -> None:
    good = _joint_states(5)
    bad = [data.replace(b"panda_joint3", b"panda_jointX") for data in _joint_states(300)]
    columns = CdrDecoder().decode_block(
        JOINTS, ["position.panda_joint3"], Messages.joined([*bad, *good])
    )
    assert sorted(columns.bad) == list(range(300))
    assert columns.values[300:, 0].tolist() == [k + 0.2 for k in range(5)]


def test_bags_with_equal_definitions_share_a_decoder() -> None:
    texts = {JOINTS: message_schema(JOINTS).text, POSE: message_schema(POSE).text}
    assert shared_decoder(texts) is shared_decoder(dict(reversed(texts.items())))
    other = shared_decoder(texts | {POSE: "float64 other\n"})
    assert other.read_message(POSE, b"\0\1\0\0" + struct.pack("<d", 3.5)) == {"other": 3.5}
    assert shared_decoder(texts).has_header(POSE)
