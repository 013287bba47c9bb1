from __future__ import annotations

import itertools
import json
import shutil
import struct
import uuid
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_messages import (
    JOINTS,
    POSE,
    START_NS,
    STATUS,
    STEP_NS,
    STORE,
    TWIST,
    episode_messages,
    make,
    make_writer,
    pose,
    status,
    to_cdr,
    twist,
    write_bag,
)
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter

from curation_ros.bags import BagWriter, message_schema, open_bag, recover_bag
from curation_ros.bags.mcap_info import read_info
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.errors import BagError, ConfigError
from curation_ros.dataset.episodes import read_episode

POSE_TEXT = message_schema(POSE).text.encode()


def _topic_map(**changes: Any) -> TopicMap:
    fields = {
        "eef": {
            "topic": "eef_pose",
            "type": POSE,
            "role": "effector",
            "values": ["pose.position.x", "pose.position.y", "pose.position.z"],
        },
        "joints": {
            "topic": "joint_states",
            "type": JOINTS,
            "role": "observation",
            "values": ["position.robot0_joint1", "position.robot0_joint7"],
        },
        "phase": {
            "topic": "phase",
            "type": STATUS,
            "role": "phase",
            "values": ["status.0.message"],
            "labels": ["PREGRASP", "GRASP"],
        },
        "progress": {
            "topic": "phase",
            "type": STATUS,
            "role": "observation",
            "values": ["status.0.values.progress"],
        },
        "twist": {
            "topic": "command/twist",
            "type": TWIST,
            "role": "action",
            "values": ["twist.linear.x"],
        },
    }
    return topic_map_from_json({"fields": fields, **changes})


def _custom_data(n: int = 40, **changes: Any) -> dict[str, str]:
    topics = list(_topic_map().topics)
    event = {
        "id": "0191-our-id",
        "name": "bowl-0007",
        "event": "ended",
        "start_stamp": START_NS + STEP_NS,
        "end_stamp": START_NS + (n - 2) * STEP_NS,
        "counts": dict.fromkeys(topics, n - 2),
        "source": "live",
        "reason": "",
    }
    return {
        "episode": json.dumps(event | changes),
        "topic_map": json.dumps(_topic_map().to_json()),
        "topics": json.dumps({t: f"/{t}" for t in topics}),
    }


def test_episode_of_our_bag_needs_no_topic_map(tmp_path: Path) -> None:
    write_bag(tmp_path / "ep", episode_messages(), custom_data=_custom_data())
    episode = read_episode(tmp_path / "ep")
    assert (episode.id, episode.name, len(episode)) == ("0191-our-id", "bowl-0007", 38)
    assert episode.findings == ()
    steps = np.arange(1, 39)
    np.testing.assert_array_equal(episode.stamps_ns, START_NS + steps * STEP_NS)
    np.testing.assert_allclose(episode.field("eef")[:, 0], 0.1 * steps)
    np.testing.assert_allclose(episode.field("joints"), [[0.1 + 0.01 * k, 0.7 + 0.01 * k]
                                                         for k in steps])  # fmt: skip
    np.testing.assert_array_equal(episode.field("phase")[:, 0], steps >= 20)
    np.testing.assert_array_equal(episode.field("progress")[:, 0], steps / 40)
    np.testing.assert_allclose(episode.field("twist")[:, 0], 0.01 * steps)


def test_digest_is_the_same_without_metadata_file_and_by_file(tmp_path: Path) -> None:
    writer = write_bag(tmp_path / "ep", episode_messages(), custom_data=_custom_data())
    digest = read_episode(tmp_path / "ep").digest
    assert read_episode(writer.path).digest == digest
    (tmp_path / "ep" / "metadata.yaml").write_text("")
    assert read_episode(tmp_path / "ep").digest == digest
    (tmp_path / "ep" / "metadata.yaml").write_text("a: [")
    assert read_episode(tmp_path / "ep").digest == digest
    (tmp_path / "ep" / "metadata.yaml").unlink()
    assert read_episode(tmp_path / "ep").digest == digest


def test_custom_data_is_the_same_with_and_without_our_record(tmp_path: Path) -> None:
    custom_data = _custom_data() | {"": "é: {", "note": "1"}
    writer = write_bag(tmp_path / "ep", episode_messages(), custom_data=custom_data)
    assert open_bag(tmp_path / "ep").custom_data == custom_data
    assert open_bag(writer.path).custom_data == custom_data
    # Without it, as bags of older versions are: the YAML says the same.
    raw = writer.path.read_bytes()
    assert raw.count(b"curation_ros") > raw.count(b"curation_ros 0")
    name = struct.pack("<I", 12) + b"curation_ros"
    writer.path.write_bytes(_with_summary_crc(raw.replace(name, name[:-1] + b"t")))
    assert read_info(writer.path).own is None
    assert open_bag(tmp_path / "ep").custom_data == custom_data
    assert open_bag(writer.path).custom_data == custom_data


def test_metadata_file_that_was_changed_wins_over_our_record(tmp_path: Path) -> None:
    write_bag(tmp_path / "ep", episode_messages(), custom_data={"note": "recorded"})
    metadata = tmp_path / "ep" / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("recorded", "changed"))
    assert open_bag(tmp_path / "ep").custom_data == {"note": "changed"}
    file = tmp_path / "ep" / "ep_0.mcap"
    file.rename(tmp_path / "ep" / "other.mcap")
    with pytest.raises(BagError, match=r"names ep_0\.mcap, which is not there"):
        open_bag(tmp_path / "ep")


def _with_summary_crc(raw: bytes) -> bytes:
    start = struct.unpack_from("<Q", raw, len(raw) - 28)[0]
    return raw[:-12] + struct.pack("<I", zlib.crc32(raw[start:-12])) + raw[-8:]


def test_samples_are_the_messages_in_file_order(tmp_path: Path) -> None:
    write_bag(tmp_path / "ep", episode_messages(30), custom_data=_custom_data(30))
    bag = open_bag(tmp_path / "ep")
    topic_map = _topic_map()
    names = {f"/{topic}": topic for topic in topic_map.topics}
    samples = bag.samples(topic_map)
    expected = [
        (names[m.topic], m.publish_time_ns, m.sequence, m.data) for m in bag.messages(names)
    ]
    assert [sample[:4] for sample in samples] == expected
    blocks = {topic: list(rest) for topic, rest in itertools.groupby(
        sorted(bag.blocks(topic_map), key=lambda b: b.topic), key=lambda b: b.topic
    )}  # fmt: skip
    assert set(blocks) == set(topic_map.topics)
    for topic, parts in blocks.items():
        found = [
            (topic, int(b.stamps_ns[k]), int(b.seqs[k]), b.messages[k])
            for b in parts
            for k in range(len(b.messages))
        ]
        assert found == [sample for sample in expected if sample[0] == topic]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("flush_every", [1, 7, 1000])
def test_episode_of_a_bag_is_that_of_its_samples_one_by_one(
    tmp_path: Path, compression: str, flush_every: int
) -> None:
    rng = np.random.default_rng(flush_every)
    messages = episode_messages(30)
    # Late, lost, repeated and spoilt messages.
    order = np.argsort(np.arange(len(messages)) + rng.normal(0, 4, len(messages)))
    messages = [messages[k] for k in order if rng.random() > 0.03]
    messages += [messages[int(k)] for k in rng.integers(0, len(messages), 5)]
    spoilt_ns = START_NS + 3 * STEP_NS
    messages.append(("/phase", spoilt_ns, status(spoilt_ns, "GRASP", {})))
    options = {"compression": compression, "flush_every": flush_every}
    write_bag(tmp_path / "ep", messages, custom_data=_custom_data(30), **options)
    bag = open_bag(tmp_path / "ep")
    event = bag.event()
    assert event is not None
    assert event.end_ns is not None
    builder = EpisodeBuilder(
        _topic_map(), bag.decoder(), episode_id=event.id, name=event.name, start_ns=event.start_ns
    )
    for sample in bag.samples(_topic_map()):
        builder.push(sample)
    expected = builder.finish(event.end_ns, event.counts)
    episode = read_episode(tmp_path / "ep")
    assert episode.digest == expected.digest
    assert episode.findings == expected.findings
    assert {f.id for f in episode.findings} >= {"clock-back", "incomplete", "undecodable"}


def test_one_topic_may_feed_two_of_the_map_and_come_on_two_channels(tmp_path: Path) -> None:
    data = [to_cdr(pose(START_NS + k, (float(k), 0.0, 0.0))) for k in range(6)]
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=200)
        writer.start(profile="ros2")
        schema = writer.register_schema(POSE, "ros2msg", POSE_TEXT)
        channels = [writer.register_channel("/eef_pose", "cdr", schema) for _ in range(2)]
        for k, message in enumerate(data):
            writer.add_message(channels[k % 2], k, message, k)
        writer.finish()
    field = {"topic": "eef_pose", "type": POSE, "role": "clock", "values": ["pose.position.x"]}
    topic_map = topic_map_from_json(
        {"fields": {"a": field, "b": field | {"topic": "/eef_pose", "role": "observation"}}}
    )
    bag = open_bag(tmp_path / "a.mcap")
    assert [(s.topic, s.stamp_ns - START_NS) for s in bag.samples(topic_map)] == [
        (topic, k) for k in range(6) for topic in ("eef_pose", "/eef_pose")
    ]
    episode = read_episode(tmp_path / "a.mcap", topic_map)
    assert episode.field("a")[:, 0].tolist() == episode.field("b")[:, 0].tolist() == list(range(6))


def test_message_without_room_for_a_stamp_is_named(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as file:
        _write_mcap(file, [("/eef_pose", POSE, POSE_TEXT, [b"\0\1\0\0"])])
    for read in (lambda bag: bag.samples(_topic_map()), lambda bag: [*bag.blocks(_topic_map())]):
        with pytest.raises(BagError, match=r"/eef_pose: message of 4 bytes is too short"):
            read(open_bag(tmp_path / "a.mcap"))


def test_foreign_bag_of_rosbags_gets_a_stable_id(tmp_path: Path) -> None:
    with RosbagsWriter(tmp_path / "demo", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connections: dict[str, Any] = {}
        for topic, stamp_ns, message in episode_messages(10):
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(
                    f"/robot1{topic}", kind, typestore=STORE
                )
            writer.write(connections[topic], stamp_ns, to_cdr(message))
    episode = read_episode(tmp_path / "demo", _topic_map())
    bag = open_bag(tmp_path / "demo")
    assert episode.id == str(uuid.uuid5(uuid.NAMESPACE_URL, f"sha256:{bag.sha256}:{START_NS}"))
    assert (episode.name, len(episode), episode.findings) == ("demo", 10, ())
    assert (episode.start_ns, episode.end_ns) == (START_NS, START_NS + 9 * STEP_NS)
    with pytest.raises(BagError, match="give a topic map"):
        read_episode(tmp_path / "demo")


def test_aborted_and_recovered_are_findings(tmp_path: Path) -> None:
    data = _custom_data(event="aborted", reason="person pressed stop", end_stamp=None, counts={})
    writer = BagWriter(tmp_path / "p", "ep", custom_data=data)
    for topic, stamp_ns, message in episode_messages(10):
        writer.add_topic(topic, message.__msgtype__)
        writer.write(topic, stamp_ns, stamp_ns, 0, to_cdr(message))
    writer.flush()
    writer.abandon()
    with pytest.raises(BagError, match=r"truncated.*recorder"):
        read_episode(tmp_path / "p")
    recover_bag(tmp_path / "p", tmp_path / "new")
    episode = read_episode(tmp_path / "new")
    assert [f.id for f in episode.findings] == ["aborted", "recovered"]
    assert len(episode) == 9


def test_split_bag_is_read_in_order(tmp_path: Path) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    for part in range(11):
        with (folder / f"split_{part}.mcap").open("wb") as file:
            messages = [pose(START_NS + 2 * part + k, (1.0, 0.0, 0.0)) for k in range(2)]
            _write_mcap(file, [("/eef_pose", POSE, POSE_TEXT, [to_cdr(m) for m in messages])])
    bag = open_bag(folder)
    assert [p.name for p in bag.mcap_paths][-2:] == ["split_9.mcap", "split_10.mcap"]
    assert bag.topics["/eef_pose"].count == 22
    stamps = [s.stamp_ns for s in bag.samples(_topic_map())]
    assert stamps == [START_NS + k for k in range(22)]


def _write_mcap(
    file: Any,
    topics: list[tuple[str, str, bytes, list[bytes]]],
    *,
    profile: str = "ros2",
    encoding: str = "cdr",
    schema_encoding: str = "ros2msg",
    **options: Any,
) -> None:
    writer = Writer(file, **options)
    writer.start(profile=profile)
    for topic, type_name, text, messages in topics:
        schema = writer.register_schema(type_name, schema_encoding, text)
        channel = writer.register_channel(topic, encoding, schema)
        for k, data in enumerate(messages):
            writer.add_message(channel, k + 1, data, k + 1, k)
    writer.finish()


@pytest.mark.parametrize(
    "options",
    [
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"use_statistics": False, "use_summary_offsets": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"compression": CompressionType.NONE, "chunk_size": 100},
        {"compression": CompressionType.LZ4},
        {"enable_crcs": False},
    ],
)
def test_files_of_any_shape_are_read(tmp_path: Path, options: dict[str, Any]) -> None:
    data = [to_cdr(pose(k + 1, (0.5 * k, 0.0, 0.0))) for k in range(9)]
    with (tmp_path / "a.mcap").open("wb") as file:
        _write_mcap(
            file, [("/eef_pose", POSE, POSE_TEXT, data), ("/b", POSE, POSE_TEXT, data)], **options
        )
    bag = open_bag(tmp_path / "a.mcap")
    assert {t: (x.type, x.count) for t, x in bag.topics.items()} == {
        "/eef_pose": (POSE, 9),
        "/b": (POSE, 9),
    }
    assert (bag.start_ns, bag.end_ns) == (1, 9)
    assert [m.data for m in bag.messages(["/b"])] == data
    assert [m.sequence for m in bag.messages(["/eef_pose"])] == list(range(9))


def test_only_chunks_with_wanted_topics_are_unpacked(tmp_path: Path) -> None:
    writer = make_writer(tmp_path / "ep", "ep", compression="none")
    for topic, n in (("/big", 50), ("/eef_pose", 5)):
        writer.add_topic(topic, POSE)
        for k in range(n):
            writer.write(topic, k, k, k, to_cdr(pose(k, (1.0, 2.0, 3.0))))
        writer.flush()
    writer.close()
    raw = bytearray(writer.path.read_bytes())
    at = raw.find(b"world", 2500)
    raw[at] ^= 1
    writer.path.write_bytes(raw)
    bag = open_bag(tmp_path / "ep")
    assert len(list(bag.messages(["/eef_pose"]))) == 5
    with pytest.raises(BagError, match="checksum"):
        list(bag.messages(["/big"]))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "empty"),
        (b"SQLite format 3\0....", "SQLite"),
        (b"#ROSBAG V2.0\n", "ROS 1"),
        (b"\x28\xb5\x2f\xfd....", "zstd"),
        (b"version https://git-lfs.github.com/spec/v1\n", "Git LFS"),
        (b"PK\3\4 something else", "no MCAP file"),
        (b"\x89MCAP0\r\n", "truncated"),
    ],
)
def test_files_that_are_no_whole_mcap_are_named(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(BagError, match=said) as caught:
        open_bag(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_truncation_of_a_bag_is_an_error(tmp_path: Path) -> None:
    writer = write_bag(tmp_path / "ep", episode_messages(4), custom_data=_custom_data(4))
    whole = writer.path.read_bytes()
    for cut in (*range(0, len(whole), 97), len(whole) - 1):
        writer.path.write_bytes(whole[:cut])
        with pytest.raises(BagError) as caught:
            open_bag(tmp_path / "ep")
        assert cut < 8 or "truncated" in str(caught.value)


def test_damaged_bytes_never_give_another_error(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    writer = write_bag(tmp_path / "ep", episode_messages(3), custom_data=_custom_data(3))
    (tmp_path / "ep" / "metadata.yaml").unlink()
    whole = writer.path.read_bytes()
    outcomes = set()
    for _ in range(300):
        raw = bytearray(whole)
        for at in rng.integers(0, len(raw), 3):
            raw[at] = rng.integers(256)
        if rng.integers(2):
            at = int(rng.integers(0, len(raw) - 8))
            raw[at : at + 8] = rng.integers(0, 256, 8, dtype=np.uint8).tobytes()
        writer.path.write_bytes(raw)
        try:
            read_episode(tmp_path / "ep", _topic_map())
            outcomes.add("read")
        except (BagError, ConfigError) as err:
            outcomes.add("refused" if "\n" not in str(err) else str(err))
    assert outcomes == {"read", "refused"}


def test_foreign_encodings_are_refused(tmp_path: Path) -> None:
    topics = [("/eef_pose", POSE, POSE_TEXT, [to_cdr(pose(1, (1.0, 2.0, 3.0)))])]
    for k, (options, said) in enumerate(
        [
            ({"profile": "ros1"}, "profile 'ros1'"),
            ({"encoding": "json"}, "'json' with a schema in 'ros2msg'"),
            ({"schema_encoding": "jsonschema"}, "'cdr' with a schema in 'jsonschema'"),
        ]
    ):
        path = tmp_path / f"{k}.mcap"
        with path.open("wb") as file:
            _write_mcap(file, topics, **options)
        with pytest.raises(BagError, match=said):
            open_bag(path)


def test_one_unreadable_topic_does_not_spoil_the_bag(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        ros = writer.register_schema(POSE, "ros2msg", POSE_TEXT)
        other = writer.register_schema("x", "protobuf", b"")
        eef = writer.register_channel("/eef_pose", "cdr", ros)
        joints = writer.register_channel("/joint_states", "protobuf", other)
        writer.add_message(eef, 1, to_cdr(pose(START_NS, (1.0, 2.0, 3.0))), 1)
        writer.add_message(joints, 1, b"??", 1)
        writer.finish()
    bag = open_bag(path)
    assert set(bag.topics) == {"/eef_pose"}
    assert len(list(bag.messages())) == 1
    with pytest.raises(BagError, match=r"/joint_states.*protobuf"):
        list(bag.messages(["/joint_states"]))
    with pytest.raises(BagError, match=r"/joint_states.*protobuf"):
        read_episode(path, _topic_map())


def test_one_topic_with_two_types_is_refused(tmp_path: Path) -> None:
    text = message_schema(TWIST).text.encode()
    data = to_cdr(twist(1, (1.0, 2.0, 3.0)))
    with (tmp_path / "a.mcap").open("wb") as file:
        _write_mcap(
            file, [("/eef_pose", POSE, POSE_TEXT, [data]), ("/eef_pose", TWIST, text, [data])]
        )
    with pytest.raises(BagError, match=r"/eef_pose has two types.*PoseStamped.*TwistStamped"):
        open_bag(tmp_path / "a.mcap")


def test_sqlite_and_compressed_bags_say_what_to_do(tmp_path: Path) -> None:
    with RosbagsWriter(
        tmp_path / "sql", version=9, storage_plugin=StoragePlugin.SQLITE3
    ) as writer:
        writer.add_connection("/eef_pose", POSE, typestore=STORE)
    with pytest.raises(BagError, match=r"storage 'sqlite3'.*expected mcap"):
        open_bag(tmp_path / "sql")
    with pytest.raises(BagError, match="SQLite"):
        open_bag(next((tmp_path / "sql").glob("*.db3")))
    (tmp_path / "sql" / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="SQLite"):
        open_bag(tmp_path / "sql")
    write_bag(tmp_path / "ep", episode_messages(2))
    metadata = tmp_path / "ep" / "metadata.yaml"
    text = metadata.read_text()
    metadata.write_text(text.replace("compression_mode: ''", "compression_mode: file"))
    with pytest.raises(BagError, match="compression mode 'file'"):
        open_bag(tmp_path / "ep")
    metadata.write_text(text.replace("- ep_0.mcap", "- ../../etc/passwd"))
    with pytest.raises(BagError, match="names passwd, which is not there"):
        open_bag(tmp_path / "ep")


def test_missing_paths_are_named(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="No such file"):
        open_bag(tmp_path / "nothing.mcap")
    with pytest.raises(BagError, match="neither metadata"):
        open_bag(tmp_path)


def test_resolve_prefers_note_then_root_then_unique_ending(tmp_path: Path) -> None:
    def bag(name: str, topics: dict[str, str], note: dict[str, str] | None = None) -> Any:
        writer = BagWriter(tmp_path / name, name)
        for topic, type_name in topics.items():
            writer.add_topic(topic, type_name)
        writer.close({} if note is None else {"topics": json.dumps(note)})
        return open_bag(tmp_path / name)

    eef = _topic_map()
    two = {"/eef_pose": POSE, "/left/eef_pose": POSE}
    assert bag("a", two).resolve(eef) == {"eef_pose": "/eef_pose"}
    assert bag("b", two, {"eef_pose": "/left/eef_pose"}).resolve(eef) == {
        "eef_pose": "/left/eef_pose"
    }
    assert bag("c", {"/left/eef_pose": POSE, "/x/eef_pose": TWIST}).resolve(eef) == {
        "eef_pose": "/left/eef_pose"
    }
    assert bag("d", {"/other": POSE}).resolve(eef) == {}
    with pytest.raises(BagError, match="/l/eef_pose or /r/eef_pose"):
        bag("e", {"/l/eef_pose": POSE, "/r/eef_pose": POSE}).resolve(eef)
    with pytest.raises(BagError, match=r"/eef_pose has type .*Twist.*expects .*PoseStamped"):
        bag("f", {"/eef_pose": TWIST}).resolve(eef)


def test_source_stamped_topics_use_the_publish_time(tmp_path: Path) -> None:
    field = {
        "topic": "load",
        "type": "std_msgs/msg/Float64",
        "role": "clock",
        "values": ["data"],
    }
    topic_map = topic_map_from_json({"fields": {"load": {**field, "stamp": "source"}}})
    messages = [
        ("/load", START_NS + k * STEP_NS, make("std_msgs/msg/Float64", data=k / 2))
        for k in range(5)
    ]
    write_bag(tmp_path / "ep", messages)
    episode = read_episode(tmp_path / "ep", topic_map)
    np.testing.assert_array_equal(episode.stamps_ns, START_NS + np.arange(5) * STEP_NS)
    np.testing.assert_array_equal(episode.field("load")[:, 0], np.arange(5) / 2)
    with pytest.raises(BagError, match="has no header"):
        read_episode(tmp_path / "ep", topic_map_from_json({"fields": {"load": field}}))


def test_foreign_bag_without_clock_says_what_it_has(tmp_path: Path) -> None:
    write_bag(tmp_path / "ep", [m for m in episode_messages(3) if m[0] == "/phase"])
    with pytest.raises(BagError, match=r"clock topic 'eef_pose'; the bag has /phase"):
        read_episode(tmp_path / "ep", _topic_map())


@pytest.mark.parametrize("key", ["episode", "topic_map", "topics"])
@pytest.mark.parametrize("value", ["{", "[1]", '"x"', '{"fields": 3, "eef_pose": [1]}'])
def test_custom_data_that_makes_no_sense_is_a_bag_error(
    tmp_path: Path, key: str, value: str
) -> None:
    write_bag(tmp_path / "ep", episode_messages(2), custom_data=_custom_data(2) | {key: value})
    if key == "topics" and value.startswith('{"'):
        assert len(open_bag(tmp_path / "ep").resolve(_topic_map())) == 4
        return
    with pytest.raises(BagError):
        read_episode(tmp_path / "ep")


def test_folder_of_several_recordings_is_no_bag(tmp_path: Path) -> None:
    for k in (1, 2):
        shutil.copy(write_bag(tmp_path / str(k), episode_messages(1)).path, tmp_path / f"{k}.mcap")
    with pytest.raises(BagError, match=r"has 2 \.mcap files .* name one of them"):
        open_bag(tmp_path)
