from __future__ import annotations

import errno
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from bag_messages import (
    JOINTS,
    POSE,
    START_NS,
    STATUS,
    STORE,
    TWIST,
    episode_messages,
    pose,
    to_cdr,
    to_plain,
    write_bag,
)
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader
from rosbags.interfaces import ConnectionExtRosbag2, QosDurability, QosReliability

from curation_ros.bags import BagWriter, QosProfile, message_schema, open_bag
from curation_ros.bags.qos import qos_from_yaml, qos_to_yaml
from curation_ros.core.errors import BagError

JOINT_HASH = "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e"


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_rosbags_reads_back_every_value(tmp_path: Path, compression: str) -> None:
    messages = episode_messages()
    write_bag(tmp_path / "ep", messages, compression=compression)
    with AnyReader([tmp_path / "ep"]) as reader:
        read = [
            (c.topic, t - 1000, c.msgtype, to_plain(reader.deserialize(data, c.msgtype)))
            for c, t, data in reader.messages()
        ]
        types = {c.topic: (c.msgtype, c.digest, c.ext) for c in reader.connections}
    expected = [(topic, t, m.__msgtype__, to_plain(m)) for topic, t, m in messages]
    assert sorted(read, key=repr) == sorted(expected, key=repr)
    assert {t[0] for t in types.values()} == {JOINTS, POSE, STATUS, TWIST}
    assert types["/joint_states"][1] == JOINT_HASH
    ext = types["/joint_states"][2]
    assert isinstance(ext, ConnectionExtRosbag2)
    [qos] = ext.offered_qos_profiles
    assert (qos.depth, qos.reliability, qos.durability) == (
        1000,
        QosReliability.RELIABLE,
        QosDurability.VOLATILE,
    )
    assert (qos.deadline.sec, qos.deadline.nsec) == (9223372036, 854775807)


def test_mcap_ros2_reads_back_every_value(tmp_path: Path) -> None:
    read_ros2_messages = pytest.importorskip("mcap_ros2.reader").read_ros2_messages
    messages = episode_messages()
    writer = write_bag(tmp_path / "ep", messages)

    def plain(value: object) -> object:
        if hasattr(value, "__slots__"):
            return {k: plain(getattr(value, k)) for k in value.__slots__}
        return [plain(v) for v in value] if isinstance(value, list) else value

    read = list(read_ros2_messages(str(writer.path), log_time_order=False))
    assert len(read) == len(messages)
    for found, (topic, stamp_ns, message) in zip(read, messages, strict=True):
        assert found.channel.topic == topic
        assert found.log_time_ns == stamp_ns + 1000
        assert found.publish_time_ns == stamp_ns
        np.testing.assert_equal(plain(found.ros_msg), to_plain(message))


def test_mcap_records_are_those_of_rosbag2(tmp_path: Path) -> None:
    writer = write_bag(tmp_path / "ep", episode_messages(), custom_data={"a": "b: {c}"})
    with writer.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
            known = message_schema(schema.name)
            assert schema.data.decode() == known.text
            assert channel.metadata["topic_type_hash"] == known.type_hash
            [qos] = yaml.safe_load(channel.metadata["offered_qos_profiles"])
            assert (qos["history"], qos["reliability"]) == ("keep_last", "reliable")
        sequences = [m.sequence for _, c, m in reader.iter_messages() if c.topic == "/eef_pose"]
        assert sequences == list(range(1, 41))
        records = [m for m in reader.iter_metadata() if m.name == "rosbag2"]
    assert len(records) == 2
    last = yaml.safe_load(records[-1].metadata["serialized_metadata"])
    assert (
        last
        == yaml.safe_load((tmp_path / "ep" / "metadata.yaml").read_text())[
            "rosbag2_bagfile_information"
        ]
    )


def test_metadata_file_has_every_key_of_version_9(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "ep", "ep", custom_data={"early": "1"})
    writer.add_topic("/eef_pose", POSE, [QosProfile(durability="transient_local")])
    for k in (5, 3, 9):
        writer.write("/eef_pose", k, k, k, to_cdr(pose(k, (1.0, 2.0, 3.0))))
    writer.close({"episode": '{"id": "é: \\"x\\" #"}'})
    assert not list((tmp_path / "ep").glob("*.tmp"))
    raw = yaml.safe_load((tmp_path / "ep" / "metadata.yaml").read_text())
    info = raw["rosbag2_bagfile_information"]
    assert set(info) == {
        "version", "storage_identifier", "duration", "starting_time", "message_count",
        "topics_with_message_count", "compression_format", "compression_mode",
        "relative_file_paths", "files", "custom_data", "ros_distro",
    }  # fmt: skip
    assert (info["version"], info["storage_identifier"]) == (9, "mcap")
    assert info["starting_time"] == {"nanoseconds_since_epoch": 3}
    assert info["duration"] == {"nanoseconds": 6}
    assert info["files"] == [
        {
            "path": "ep_0.mcap",
            "starting_time": {"nanoseconds_since_epoch": 3},
            "duration": {"nanoseconds": 6},
            "message_count": 3,
        }
    ]
    [topic] = info["topics_with_message_count"]
    assert topic["message_count"] == info["message_count"] == 3
    assert set(topic["topic_metadata"]) == {
        "name", "type", "serialization_format", "offered_qos_profiles", "type_description_hash",
    }  # fmt: skip
    assert topic["topic_metadata"]["offered_qos_profiles"][0]["durability"] == "transient_local"
    assert info["custom_data"] == {"early": "1", "episode": '{"id": "é: \\"x\\" #"}'}
    assert open_bag(tmp_path / "ep").custom_data == info["custom_data"]


def test_type_hashes_and_texts_equal_those_of_rosbags() -> None:
    for type_name in (JOINTS, POSE, TWIST, STATUS, "sensor_msgs/msg/CompressedImage"):
        schema = message_schema(type_name)
        assert schema.type_hash == STORE.hash_rihs01(type_name)
        lines = [line.split("#")[0].split() for line in schema.text.splitlines()]
        other = STORE.generate_msgdef(type_name, ros_version=2)[0].splitlines()
        sections = [words for words in lines if words[:1] == ["MSG:"]]
        assert sorted(sections) == sorted(w.split() for w in other if w.startswith("MSG:"))


def test_type_that_is_not_installed_comes_from_rosbags(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    message_schema.cache_clear()
    try:
        assert message_schema(JOINTS).type_hash == JOINT_HASH
    finally:
        message_schema.cache_clear()


@pytest.mark.parametrize("name", ["JointState", "sensor_msgs/JointState", "../msg/x", "a/msg/b/c"])
def test_type_name_of_another_form_is_refused(name: str) -> None:
    with pytest.raises(BagError, match="package/msg/Type"):
        message_schema(name)


def test_qos_round_trip_and_numbers_of_old_bags() -> None:
    profiles = (
        QosProfile(depth=1000),
        QosProfile("keep_all", 0, "best_effort", "transient_local", deadline_ns=1_500_000_000),
    )
    assert qos_from_yaml(qos_to_yaml(profiles)) == profiles
    old = "- history: 1\n  depth: 5\n  reliability: 2\n  durability: 1\n  liveliness: 1\n"
    assert qos_from_yaml(old) == (QosProfile("keep_last", 5, "best_effort", "transient_local"),)
    assert qos_from_yaml("{") == qos_from_yaml("") == qos_from_yaml("- 5") == ()


def test_second_writer_of_a_folder_is_refused(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "ep", "ep")
    with pytest.raises(BagError, match="exists already"):
        BagWriter(tmp_path / "ep", "ep")
    writer.abandon()


def test_misuse_is_refused_with_one_line(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "ep", "ep")
    writer.add_topic("/eef_pose", POSE)
    writer.add_topic("/eef_pose", POSE)
    with pytest.raises(BagError, match="has type"):
        writer.add_topic("/eef_pose", TWIST)
    with pytest.raises(BagError, match="was not added"):
        writer.write("/other", 1, 1, 1, b"")
    for time_ns in (-1, 2**63):
        with pytest.raises(BagError, match="must be between"):
            writer.write("/eef_pose", time_ns, 1, 1, b"\0\1\0\0")
    writer.write("/eef_pose", 1, 1, 2**32 + 7, b"\0\1\0\0")
    writer.close()
    assert writer.counts == {"/eef_pose": 1}
    [message] = open_bag(tmp_path / "ep").messages()
    assert message.sequence == 7
    for act in (writer.flush, writer.close):
        with pytest.raises(BagError, match="is closed"):
            act()


def test_bag_without_messages_is_whole(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "ep", "ep")
    writer.add_topic("/eef_pose", POSE)
    writer.close()
    bag = open_bag(tmp_path / "ep")
    assert (bag.topics["/eef_pose"].count, bag.start_ns, bag.end_ns) == (0, 0, 0)
    assert list(bag.messages()) == []


def test_flushed_messages_are_in_the_file(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / "ep", "ep")
    writer.add_topic("/eef_pose", POSE)
    before = writer.path.stat().st_size
    writer.write("/eef_pose", 1, 1, 1, to_cdr(pose(1, (1.0, 2.0, 3.0))))
    assert writer.path.stat().st_size == before
    writer.flush()
    assert writer.path.stat().st_size > before
    writer.abandon()
    writer.abandon()


@pytest.mark.parametrize("during", ["flush", "close", "metadata"])
def test_full_disk_is_a_bag_error_and_keeps_what_was_flushed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, during: str
) -> None:
    from curation_ros.bags import recover_bag

    writer = BagWriter(tmp_path / "ep", "ep")
    writer.add_topic("/eef_pose", POSE)
    data = to_cdr(pose(START_NS, (1.0, 2.0, 3.0)))
    for k in range(10):
        writer.write("/eef_pose", START_NS + k, START_NS + k, k, data)
    writer.flush()
    writer.write("/eef_pose", START_NS + 11, START_NS + 11, 11, data)
    real = os.write

    def full(fd: int, block: bytes) -> int:
        # Half of the block still fits, as on a real disk.
        if len(block) < 8:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return real(fd, block[: len(block) // 2])

    if during == "metadata":

        def no_folder(path: Path) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

        monkeypatch.setattr("curation_ros.files.sync_folder", no_folder)
    else:
        monkeypatch.setattr(os, "write", full)
    with pytest.raises(BagError, match="No space left on device") as caught:
        writer.flush() if during == "flush" else writer.close()
    assert str(tmp_path / "ep") in str(caught.value)
    with pytest.raises(BagError, match="is closed"):
        writer.write("/eef_pose", 1, 1, 1, data)
    writer.abandon()
    monkeypatch.undo()
    report = recover_bag(tmp_path / "ep", tmp_path / "new")
    assert report.messages["/eef_pose"] >= 10


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_device_that_is_full_from_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.open
    monkeypatch.setattr(os, "open", lambda path, flags, mode=0o644: real("/dev/full", os.O_WRONLY))
    with pytest.raises(BagError, match="No space left on device"):
        BagWriter(tmp_path / "ep", "ep")


def test_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(BagError, match="file"):
        BagWriter(tmp_path / "file" / "ep", "ep")
