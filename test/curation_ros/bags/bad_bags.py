"""Hand-made bad episodes and bags: name -> how to make it, and the finding that must name it.

Each maker gets a `Bench` and a path that does not exist yet, and makes something there. What
scans a folder finds it where it ends in .mcap or is a folder with a bag in it.
"""

from __future__ import annotations

import json
import os
import struct
import uuid
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import bag_messages
import lz4.frame
import numpy as np
import zstandard
from episodes import CLOSE_AT, GRASP_STEPS, TASK_STEPS, make_episode, topic_map
from mcap.opcode import Opcode
from mcap.writer import Writer
from streams import ARM, FINGERS, ended, samples_of

from curation_ros.bags import BagWriter, message_schema
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent, event_to_json
from curation_ros.core.episode.stream import Sample
from curation_ros.core.types import NS_PER_S

MAGIC = b"\x89MCAP0\r\n"
EEF, JOINTS, PHASE = "eef_pose", "joint_states", "phase"
TWIST, GRIPPER = "command/twist", "command/gripper"
BOWL, PLATE = "objects/akita_black_bowl_1/pose", "objects/plate_1/pose"
HUGE_BYTES = 10 << 30
_RECORD = struct.Struct("<BQ")
_RELEASE_AT = TASK_STEPS - 3

Samples = Sequence[Sample]


class Bench:
    """Sound things to spoil, each made once."""

    @cached_property
    def episode(self) -> Episode:
        """A sound demonstration of 240 steps."""
        return make_episode(np.random.default_rng(20260608), name="sound")

    @cached_property
    def samples(self) -> list[Sample]:
        """Its messages."""
        return samples_of(self.episode)

    def bag(
        self,
        path: Path,
        samples: Samples | None = None,
        *,
        episode: Episode | None = None,
        event: EpisodeEvent | None = None,
        custom_data: Mapping[str, str] | None = None,
        types: Mapping[str, str] | None = None,
        namespace: str = "/",
        compression: Any = "zstd",
    ) -> Path:
        """Write a bag as our recorder does, of whatever it is given."""
        if episode is None:  # one without a step is false, too
            episode = self.episode
        if samples is None:
            samples = self.samples if episode is self.episode else samples_of(episode)
        event = event or replace(ended(episode), counts={})
        data = {
            "episode": json.dumps(event_to_json(replace(event, id=_id_of(path), name=path.name))),
            "topic_map": json.dumps(topic_map().to_json()),
            **(custom_data or {}),
        }
        writer = bag_messages.make_writer(
            path, path.name, custom_data=data, compression=compression
        )
        for topic, kind in {**topic_map().topics, **(types or {})}.items():
            writer.add_topic(namespace + topic, kind)
        for k, s in enumerate(samples):
            writer.write(namespace + s.topic, s.log_ns, s.publish_ns, s.seq, s.data)
            if k % 200 == 199:
                writer.flush()
        writer.close(data)
        return path

    @cached_property
    def plain(self) -> bytes:
        """A sound .mcap file with chunks that are not compressed."""
        return self._file("none")

    @cached_property
    def packed(self) -> bytes:
        """A sound .mcap file with compressed chunks."""
        return self._file("zstd")

    def _file(self, compression: str) -> bytes:
        path = self.scratch / compression
        bag = self.bag(path, self.samples[:700], compression=compression)
        [file] = bag.glob("*.mcap")
        return file.read_bytes()

    def __init__(self, scratch: Path) -> None:
        """Make a bench with a folder of its own."""
        self.scratch = scratch


def _id_of(path: Path) -> str:
    """An id of its own for each bag."""
    return str(uuid.uuid5(uuid.NAMESPACE_URL, path.name))


# --- samples ------------------------------------------------------------------------------------


def _of(samples: Iterable[Sample], topic: str) -> list[Sample]:
    return [s for s in samples if s.topic == topic]


def _without(
    samples: Samples, topic: str, first: int = 0, last: int | None = None
) -> list[Sample]:
    gone = {id(s) for s in _of(samples, topic)[first:last]}
    return [s for s in samples if id(s) not in gone]


def _changed(
    samples: Samples,
    topic: str,
    change: Callable[[Sample], Sample],
    steps: range = range(TASK_STEPS),
) -> list[Sample]:
    wanted = {id(s) for k, s in enumerate(_of(samples, topic)) if k in steps}
    return [change(s) if id(s) in wanted else s for s in samples]


def _restamped(sample: Sample, stamp_ns: int) -> Sample:
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    data = sample.data[:4] + struct.pack("<iI", sec, nanosec) + sample.data[12:]
    return sample._replace(stamp_ns=stamp_ns, data=data)


def _with_bytes(change: Callable[[bytes], bytes]) -> Callable[[Sample], Sample]:
    return lambda sample: sample._replace(data=change(sample.data))


def _joints(names: Sequence[str]) -> Callable[[Sample], Sample]:
    """The same joints under other names."""

    def rename(sample: Sample) -> Sample:
        message = bag_messages.joint_state(sample.stamp_ns, {n: 0.1 for n in dict.fromkeys(names)})
        message.name = list(names)
        message.position = np.full(len(names), 0.1)
        return sample._replace(data=bag_messages.to_cdr(message))

    return rename


def _status(label: str) -> Callable[[Sample], Sample]:
    def rename(sample: Sample) -> Sample:
        message = bag_messages.status(sample.stamp_ns, label, {"index": "0"})
        return sample._replace(data=bag_messages.to_cdr(message))

    return rename


def _no_status(sample: Sample) -> Sample:
    message = bag_messages.status(sample.stamp_ns, "", {})
    message.status = []
    return sample._replace(data=bag_messages.to_cdr(message))


def _sampled(change: Callable[[list[Sample], Episode], Samples]) -> Callable[[Bench, Path], Path]:
    """A bag with other samples."""
    return lambda bench, path: bench.bag(path, change(bench.samples, bench.episode))


def _fields(change: Callable[[dict[str, Any]], None]) -> Callable[[Bench, Path], Path]:
    """A bag of the same episode with other values."""

    def make(bench: Bench, path: Path) -> Path:
        fields = {name: values.copy() for name, values in bench.episode.fields.items()}
        change(fields)
        return bench.bag(path, episode=replace(bench.episode, fields=fields))

    return make


def _made(**options: Any) -> Callable[[Bench, Path], Path]:
    """A bag of an episode that is made otherwise."""

    def make(bench: Bench, path: Path) -> Path:
        return bench.bag(path, episode=make_episode(np.random.default_rng(3), **options))

    return make


def _cut(first: int, last: int) -> Callable[[Bench, Path], Path]:
    """A bag of steps [first, last) alone, as if nothing else had been recorded."""

    def make(bench: Bench, path: Path) -> Path:
        part = bench.episode.steps(last, first)
        start = int(part.stamps_ns[0]) - 10_000_000 if len(part) else part.start_ns
        end = int(part.stamps_ns[-1]) if len(part) else part.start_ns
        return bench.bag(path, episode=replace(part, start_ns=start, end_ns=end))

    return make


def _retimed(periods_s: Callable[[int], Any]) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        e = bench.episode
        periods = np.broadcast_to(periods_s(len(e) - 1), len(e) - 1)
        offsets = np.concatenate([[0], np.cumsum(np.round(periods * 1e9))]).astype(np.int64)
        stamps = e.stamps_ns[0] + offsets
        return bench.bag(path, episode=replace(e, stamps_ns=stamps, end_ns=int(stamps[-1])))

    return make


def _padded(zeros: bool) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        e, n = bench.episode, 40
        stamps = np.concatenate([e.stamps_ns, e.stamps_ns[-1] + 50_000_000 * np.arange(1, n + 1)])
        scale = 0.0 if zeros else 1.0
        fields = {
            k: np.concatenate([v, np.repeat(v[-1:], n, axis=0) * (1.0 if k == "phase" else scale)])
            for k, v in e.fields.items()
        }
        end_ns = int(stamps[-1])
        return bench.bag(path, episode=replace(e, stamps_ns=stamps, end_ns=end_ns, fields=fields))

    return make


def _set(name: str, rows: slice | int, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(fields: dict[str, Any]) -> None:
        fields[name][rows] = value

    return change


def _hold(first: int, last: int, *names: str) -> Callable[[dict[str, Any]], None]:
    def change(fields: dict[str, Any]) -> None:
        for name in names or tuple(fields):
            fields[name][first : last + 1] = fields[name][first]

    return change


def _rest(fields: dict[str, Any]) -> None:
    rng = np.random.default_rng(5)
    fields["eef_position"][10:90] = fields["eef_position"][10] + 1e-6 * rng.random((80, 3))


def _invert(fields: dict[str, Any]) -> None:
    fields["gripper"] *= -1.0


def _teleport(fields: dict[str, Any]) -> None:
    fields["eef_position"][120:] += 3.0


# --- what the owner said -----------------------------------------------------------------------


def _event(**changes: Any) -> Callable[[Bench, Path], Path]:
    """A bag whose owner said something else; a key that is None is left out."""

    def make(bench: Bench, path: Path) -> Path:
        said = event_to_json(replace(ended(bench.episode), id=_id_of(path))) | changes
        text = json.dumps({k: v for k, v in said.items() if v is not None})
        return bench.bag(path, custom_data={"episode": text})

    return make


def _custom(**texts: str) -> Callable[[Bench, Path], Path]:
    return lambda bench, path: bench.bag(path, custom_data=texts)


def _map(change: Callable[[dict[str, Any]], None]) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        raw = topic_map().to_json()
        change(raw)
        return bench.bag(path, custom_data={"topic_map": json.dumps(raw)})

    return make


def _map_field(name: str, key: str, value: Any) -> Callable[[Bench, Path], Path]:
    return _map(lambda raw: raw["fields"][name].update({key: value}))


def _wrong_id(bench: Bench, path: Path) -> Path:
    return bench.bag(path.with_name("01a20ca5-6a30-74af-8fb4-b3b457abcd9c"))


def _no_map(bench: Bench, path: Path) -> Path:
    writer = BagWriter(path, path.name)
    writer.add_topic("/eef_pose", bag_messages.POSE)
    for s in _of(bench.samples, EEF):
        writer.write("/eef_pose", s.log_ns, s.publish_ns, s.seq, s.data)
    writer.close({})
    return path


# --- files --------------------------------------------------------------------------------------


class _Place(NamedTuple):
    """A record of a file: opcode, offset of its head, length of its body."""

    opcode: int
    at: int
    length: int


def _records(data: bytes) -> Iterator[_Place]:
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        opcode, length = _RECORD.unpack_from(data, at)
        yield _Place(opcode, at, length)
        at += _RECORD.size + length


def _places(data: bytes, opcode: int) -> list[_Place]:
    return [p for p in _records(data) if p.opcode == opcode]


def _file(content: Callable[[Bench], bytes]) -> Callable[[Bench, Path], Path]:
    """A single file."""

    def make(bench: Bench, path: Path) -> Path:
        file = path.with_suffix(".mcap")
        file.write_bytes(content(bench))
        return file

    return make


def _cut_at(share: Callable[[bytes], int]) -> Callable[[Bench, Path], Path]:
    return _file(lambda bench: bench.packed[: share(bench.packed)])


def _patched(data: bytes, at: int, patch: bytes) -> bytes:
    return data[:at] + patch + data[at + len(patch) :]


def _flip(data: bytes, at: int) -> bytes:
    return _patched(data, at, bytes([data[at] ^ 0x55]))


def _chunk_patch(offset: int, patch: bytes) -> Callable[[Bench, Path], Path]:
    """Something else in the head of the second chunk."""

    def change(bench: Bench) -> bytes:
        chunk = _places(bench.plain, Opcode.CHUNK)[1]
        return _patched(bench.plain, chunk.at + _RECORD.size + offset, patch)

    return _file(change)


def _chunk_flip(name: str) -> Callable[[Bench, Path], Path]:
    def change(bench: Bench) -> bytes:
        data = getattr(bench, name)
        chunk = _places(data, Opcode.CHUNK)[1]
        return _flip(data, chunk.at + chunk.length // 2)

    return _file(change)


def _summary_start(data: bytes) -> int:
    footer = _places(data, Opcode.FOOTER)[0]
    return int(struct.unpack_from("<Q", data, footer.at + _RECORD.size)[0])


def _resummed(data: bytes) -> bytes:
    """The file with a right checksum of its summary."""
    footer = _places(data, Opcode.FOOTER)[0]
    crc_at = footer.at + _RECORD.size + 16
    crc = zlib.crc32(data[_summary_start(data) : crc_at])
    return _patched(data, crc_at, struct.pack("<I", crc))


def _huge_statistics(bench: Bench) -> bytes:
    data = bench.packed
    [statistics] = _places(data, Opcode.STATISTICS)
    return _resummed(_patched(data, statistics.at + _RECORD.size, struct.pack("<Q", 10**15)))


def _lying_statistics(bench: Bench) -> bytes:
    """More messages of the last channel than there are, in the sum, too."""
    data = bench.packed
    [statistics] = _places(data, Opcode.STATISTICS)
    body = statistics.at + _RECORD.size
    [total] = struct.unpack_from("<Q", data, body)
    last = body + statistics.length - 8
    [count] = struct.unpack_from("<Q", data, last)
    data = _patched(data, last, struct.pack("<Q", count + 10**12))
    return _resummed(_patched(data, body, struct.pack("<Q", total + 10**12)))


def _index_to_nowhere(bench: Bench) -> bytes:
    data = bench.packed
    index = _places(data, Opcode.METADATA_INDEX)[0]
    return _resummed(_patched(data, index.at + _RECORD.size, struct.pack("<Q", 20)))


def _in_chunk(name: str, offset: int, patch: bytes) -> Callable[[Bench, Path], Path]:
    """Something else in the first record of a kind in the second chunk, with right checksums."""

    def change(bench: Bench) -> bytes:
        data = bench.plain
        chunk = _places(data, Opcode.CHUNK)[1]
        body = chunk.at + _RECORD.size
        start = body + 8 + 8 + 8 + 4 + 4 + 8  # times, size, CRC, empty compression, length
        stop = body + chunk.length
        at = start
        while data[at] != Opcode[name]:
            at += _RECORD.size + _RECORD.unpack_from(data, at)[1]
        data = _patched(data, at + offset, patch)
        return _patched(data, body + 24, struct.pack("<I", zlib.crc32(data[start:stop])))

    return _file(change)


def _chunk(packed: bytes, size: int, compression: bytes, checksum: int = 0) -> bytes:
    body = struct.pack("<QQQII", 1, 2, size, checksum, len(compression)) + compression
    body += struct.pack("<Q", len(packed)) + packed
    return _RECORD.pack(Opcode.CHUNK, len(body)) + body


def _only_chunk(packed: bytes, size: int, compression: bytes) -> bytes:
    """A file with this chunk and no summary."""
    header = struct.pack("<I", 4) + b"ros2" + struct.pack("<I", 0)
    return (
        MAGIC
        + _RECORD.pack(Opcode.HEADER, len(header))
        + header
        + _chunk(packed, size, compression)
        + _RECORD.pack(Opcode.FOOTER, 20)
        + bytes(20)
        + MAGIC
    )


def _bomb_zstd(_: Bench) -> bytes:
    size = 200 << 20
    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size)
    parts = [packer.compress(bytes(1 << 20)) for _ in range(size >> 20)]
    return _only_chunk(b"".join([*parts, packer.flush()]), size, b"zstd")


def _bomb_lz4(_: Bench) -> bytes:
    """It claims as much as it unpacks to, and packs to 1 / 250 of that: the format's best."""
    size = 300 << 20
    with lz4.frame.LZ4FrameCompressor() as packer:
        parts = [packer.begin(), *(packer.compress(bytes(1 << 20)) for _ in range(size >> 20))]
        parts.append(packer.flush())
    return _only_chunk(b"".join(parts), size, b"lz4")


def _sparse(head: bytes, tail: bytes = b"") -> Callable[[Bench, Path], Path]:
    """A file of 10 GB that takes no space; nobody may read it all."""

    def make(bench: Bench, path: Path) -> Path:
        file = path.with_suffix(".mcap")
        with file.open("wb") as stream:
            stream.write(head)
            stream.truncate(HUGE_BYTES)
            if tail:
                stream.seek(0, os.SEEK_END)
                stream.write(tail)
        return file

    return make


def _footer(summary_start: int) -> bytes:
    return _RECORD.pack(Opcode.FOOTER, 20) + struct.pack("<QQI", summary_start, 0, 0) + MAGIC


#: The head of a record that claims all of the sparse file.
_REST = HUGE_BYTES - 100


# --- files of the mcap package ------------------------------------------------------------------


@dataclass(frozen=True)
class _Channel:
    """A channel, and messages for it; by default the poses of the sound episode."""

    topic: str = "/eef_pose"
    type: str = bag_messages.POSE
    text: bytes | None = None
    schema_encoding: str = "ros2msg"
    encoding: str = "cdr"
    messages: tuple[bytes, ...] | None = None
    has_schema: bool = True


def _foreign(
    *channels: _Channel,
    profile: str = "ros2",
    noted: str | None = None,
    map_: Callable[[dict[str, Any]], None] = lambda raw: None,
    **options: Any,
) -> Callable[[Bench, Path], Path]:
    """A file of another writer, with a topic map for it."""

    def make(bench: Bench, path: Path) -> Path:
        raw = topic_map().to_json()
        raw["fields"] = {"eef_position": raw["fields"]["eef_position"]}
        raw = {"fields": raw["fields"], "state": ["eef_position"]}
        map_(raw)
        text = noted or json.dumps({"custom_data": {"topic_map": json.dumps(raw)}})
        file = path.with_suffix(".mcap")
        with file.open("wb") as stream:
            writer = Writer(stream, **options)
            writer.start(profile=profile)
            writer.add_metadata("rosbag2", {"serialized_metadata": text})
            for channel in channels or (_Channel(),):
                definition = channel.text
                if definition is None:
                    definition = message_schema(channel.type).text.encode()
                schema = 0
                if channel.has_schema:
                    schema = writer.register_schema(
                        channel.type, channel.schema_encoding, definition
                    )
                channel_id = writer.register_channel(channel.topic, channel.encoding, schema)
                stamped = _of(bench.samples, EEF)
                messages = channel.messages or tuple(s.data for s in stamped)
                for k, (sample, data) in enumerate(zip(stamped, messages, strict=False)):
                    writer.add_message(channel_id, sample.log_ns, data, sample.publish_ns, k)
            writer.finish()
        return file

    return make


#: Eight lines that stand for 10**8 values.
_UNFOLDING = "\n".join(
    [
        "a0: &a0 [" + ", ".join("0" * 10) + "]",
        *(f"a{k}: &a{k} [" + ", ".join([f"*a{k - 1}"] * 10) + "]" for k in range(1, 8)),
        "custom_data: {topic_map: *a7}",
    ]
)
_POINT = "geometry_msgs/msg/PointStamped"


def _headerless(raw: dict[str, Any]) -> None:
    raw["fields"]["eef_position"].update(type="geometry_msgs/msg/Pose", values=["position.x"])


# --- folders ------------------------------------------------------------------------------------


def _folder(
    files: Mapping[str, bytes | Callable[[Bench], bytes]],
) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        path.mkdir()
        for name, content in files.items():
            (path / name).write_bytes(content if isinstance(content, bytes) else content(bench))
        return path

    return make


def _metadata(**information: Any) -> bytes:
    return json.dumps({"rosbag2_bagfile_information": information}).encode()


def _packed(bench: Bench) -> bytes:
    return bench.packed


def _emptied(bench: Bench, path: Path) -> Path:
    bench.bag(path)
    for file in path.glob("*.mcap"):
        file.write_bytes(b"")
    return path


def _gone(bench: Bench, path: Path) -> Path:
    bench.bag(path)
    for file in path.glob("*.mcap"):
        file.unlink()
    return path


def _link(target: str) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        link = path.with_suffix(".mcap")
        link.symlink_to(target.format(name=link.name))
        return link

    return make


def _fifo_in_a_bag(bench: Bench, path: Path) -> Path:
    path.mkdir()
    os.mkfifo(path / "a_0.mcap")
    return path


def _fifo_of_metadata(bench: Bench, path: Path) -> Path:
    bench.bag(path)
    (path / "metadata.yaml").unlink()
    os.mkfifo(path / "metadata.yaml")
    return path


def _sparse_metadata(bench: Bench, path: Path) -> Path:
    path.mkdir()
    with (path / "metadata.yaml").open("wb") as file:
        file.truncate(HUGE_BYTES)
    return path


def _fifo(bench: Bench, path: Path) -> Path:
    file = path.with_suffix(".mcap")
    os.mkfifo(file)
    return file


def _unreadable(bench: Bench, path: Path) -> Path:
    file = path.with_suffix(".mcap")
    file.write_bytes(bench.packed)
    file.chmod(0)
    return file


def _not_utf8(bench: Bench, path: Path) -> Path:
    file = Path(os.fsdecode(os.fsencode(path) + b"-\xff\xfe.mcap"))
    file.write_bytes(bench.packed[:300])
    return file


def _named(name: str, content: bytes) -> Callable[[Bench, Path], Path]:
    def make(bench: Bench, path: Path) -> Path:
        file = path.with_name(f"{path.name}{name}")
        file.write_bytes(content)
        return file

    return make


# --- the table ----------------------------------------------------------------------------------

Make = Callable[[Bench, Path], Path]

#: Name -> (how to make it, the finding that names what is wrong).
BAD: dict[str, tuple[Make, str]] = {
    # values
    "nan-in-effector": (_fields(_set("eef_position", 50, np.nan)), "not-finite"),
    "infinite-joint": (_fields(_set("joint_position", (slice(60, 62), 3), np.inf)), "not-finite"),
    "minus-infinite-command": (_fields(_set("twist", 70, -np.inf)), "not-finite"),
    "nan-all-along": (_fields(_set("bowl_position", slice(None), np.nan)), "not-finite"),
    "nan-gripper-command": (_fields(_set("gripper", slice(90, 110), np.nan)), "not-finite"),
    # length
    "no-step": (_cut(0, 0), "too-short"),
    "one-step": (_cut(100, 101), "too-short"),
    "four-steps": (_cut(100, 104), "too-short"),
    "a-fifth-of-it": (_cut(0, TASK_STEPS // 5), "too-short"),
    # stamps
    "unsorted-stamps": (
        _sampled(
            lambda s, _: [
                *_without(s, EEF),
                *(_of(s, EEF)[k] for k in np.random.default_rng(2).permutation(TASK_STEPS)),
            ]
        ),
        "clock-back",
    ),
    "neighbours-swapped": (
        _sampled(
            lambda s, _: [
                *_without(s, JOINTS),
                *(_of(s, JOINTS)[k] for k in (*range(80), 81, 80, *range(82, TASK_STEPS))),
            ]
        ),
        "clock-back",
    ),
    "clock-set-back-by-a-second": (
        _sampled(
            lambda s, e: _changed(
                s, EEF, lambda x: _restamped(x, x.stamp_ns - NS_PER_S), range(120, TASK_STEPS)
            )
        ),
        "clock-back",
    ),
    "stamps-all-equal": (
        _sampled(lambda s, e: [_restamped(x, int(e.stamps_ns[0])) for x in s]),
        "duplicate-stamp",
    ),
    "one-stamp-two-values": (
        _sampled(
            lambda s, _: [
                *s,
                _restamped(_of(s, PLATE)[3], _of(s, PLATE)[2].stamp_ns)._replace(
                    data=_restamped(_of(s, BOWL)[9], _of(s, PLATE)[2].stamp_ns).data
                ),
            ]
        ),
        "duplicate-stamp",
    ),
    "stamps-of-another-epoch": (
        _sampled(lambda s, e: _changed(s, EEF, lambda x: _restamped(x, x.stamp_ns - e.start_ns))),
        "missing-topic",
    ),
    "stamps-before-1970": (
        _sampled(lambda s, _: _changed(s, JOINTS, lambda x: _restamped(x, -5 * NS_PER_S))),
        "missing-topic",
    ),
    "half-the-rate": (_retimed(lambda n: 0.1), "rate"),
    "twice-the-rate": (_retimed(lambda n: 0.025), "rate"),
    "bursts": (_retimed(lambda n: np.where(np.arange(n) % 3 == 0, 0.11, 0.02)), "rate"),
    # topics
    "missing-effector": (_sampled(lambda s, _: _without(s, EEF)), "missing-topic"),
    "missing-joints": (_sampled(lambda s, _: _without(s, JOINTS)), "missing-topic"),
    "missing-phase": (_sampled(lambda s, _: _without(s, PHASE)), "missing-topic"),
    "missing-bowl": (_sampled(lambda s, _: _without(s, BOWL)), "missing-topic"),
    "missing-plate": (_sampled(lambda s, _: _without(s, PLATE)), "missing-topic"),
    "missing-twist": (_sampled(lambda s, _: _without(s, TWIST)), "missing-topic"),
    "missing-gripper": (_sampled(lambda s, _: _without(s, GRIPPER)), "missing-topic"),
    "gap-in-the-effector": (_sampled(lambda s, _: _without(s, EEF, 100, 110)), "gap"),
    "gap-in-everything": (
        _sampled(lambda s, e: [x for x in s if not 100 <= x.seq < 120]),
        "gap",
    ),
    "command-starts-late": (_sampled(lambda s, _: _without(s, TWIST, 0, 30)), "gap"),
    "joints-end-early": (_sampled(lambda s, _: _without(s, JOINTS, 200)), "gap"),
    # messages
    "unknown-phase": (
        _sampled(lambda s, _: _changed(s, PHASE, _status("DANCE"), range(50, 60))),
        "unknown-phase",
    ),
    "phase-without-a-name": (
        _sampled(lambda s, _: _changed(s, PHASE, _status(""))),
        "unknown-phase",
    ),
    "phase-without-a-status": (
        _sampled(lambda s, _: _changed(s, PHASE, _no_status)),
        "undecodable",
    ),
    "phase-not-utf-8": (
        _sampled(
            lambda s, _: _changed(
                s,
                PHASE,
                _with_bytes(lambda d: d.replace(b"PREGRASP", b"PREGR\xff\xfeP")),
            )
        ),
        "undecodable",
    ),
    "joints-renamed": (
        _sampled(lambda s, _: _changed(s, JOINTS, _joints(["a", "b", "c"]))),
        "undecodable",
    ),
    "one-joint-missing": (
        _sampled(lambda s, _: _changed(s, JOINTS, _joints([*ARM[:-1], *FINGERS]))),
        "undecodable",
    ),
    "fingers-missing": (_sampled(lambda s, _: _changed(s, JOINTS, _joints(ARM))), "undecodable"),
    "two-joints-of-one-name": (
        _sampled(lambda s, _: _changed(s, JOINTS, _joints([*ARM, *FINGERS, ARM[0]]))),
        "undecodable",
    ),
    "no-joints": (_sampled(lambda s, _: _changed(s, JOINTS, _joints([]))), "undecodable"),
    "messages-cut-in-half": (
        _sampled(lambda s, _: _changed(s, TWIST, _with_bytes(lambda d: d[: len(d) // 2]))),
        "undecodable",
    ),
    "messages-too-short-for-a-header": (
        _sampled(lambda s, _: _changed(s, EEF, _with_bytes(lambda d: d[:8]), range(9, 10))),
        "undecodable",
    ),
    "messages-not-in-cdr": (
        _sampled(
            lambda s, _: _changed(
                s, PLATE, _with_bytes(lambda d: b"\x00\x03" + d[2:]), range(20, 40)
            )
        ),
        "undecodable",
    ),
    "text-longer-than-its-message": (
        _sampled(
            lambda s, _: _changed(
                s, EEF, _with_bytes(lambda d: _patched(d, 12, b"\xff\xff\xff\x7f")), range(20, 40)
            )
        ),
        "undecodable",
    ),
    "text-without-an-end": (
        _sampled(
            lambda s, _: _changed(
                s, BOWL, _with_bytes(lambda d: d.replace(b"world\x00", b"world!")), range(20, 40)
            )
        ),
        "undecodable",
    ),
    "sequence-of-four-billion": (
        _sampled(
            lambda s, _: _changed(
                s,
                GRIPPER,
                _with_bytes(
                    lambda d: d.replace(
                        struct.pack("<I", 1) + struct.pack("<I", 8) + b"gripper",
                        b"\xff\xff\xff\xff" + struct.pack("<I", 8) + b"gripper",
                    )
                ),
            )
        ),
        "undecodable",
    ),
    # arrays
    "everything-constant": (_fields(_hold(0, TASK_STEPS)), "frozen"),
    "frozen-effector": (_fields(_hold(40, 80, "eef_position", "eef_quat_xyzw")), "frozen"),
    "frozen-joints": (_fields(_hold(120, 150, "joint_position", "finger_position")), "frozen"),
    "joints-that-never-move": (
        _fields(_hold(0, TASK_STEPS, "joint_position", "finger_position")),
        "frozen",
    ),
    "padded-with-copies": (_padded(zeros=False), "padded-tail"),
    "padded-with-zeros": (_padded(zeros=True), "padded-tail"),
    "starts-while-descending": (_cut(70, TASK_STEPS), "clipped-start"),
    "starts-while-lifting": (_cut(CLOSE_AT + GRASP_STEPS + 5, TASK_STEPS), "clipped-start"),
    "gripper-inverted": (_fields(_invert), "gripper-meaning"),
    "teleport": (_fields(_teleport), "jump"),
    "long-rest": (_fields(_rest), "idle"),
    "never-grasped": (_made(close_at=None), "never-grasped"),
    "early-release": (_made(open_at=CLOSE_AT + GRASP_STEPS + 20), "opened-early"),
    "stops-while-carrying": (_cut(0, _RELEASE_AT - 20), "unfinished"),
    "never-lets-go": (_made(open_at=None), "unfinished"),
    "duplicate-of-another": (lambda bench, path: bench.bag(path), "duplicate"),
    # what the owner said
    "aborted": (_event(event="aborted", reason="a person pressed stop"), "aborted"),
    "lost-messages": (
        lambda bench, path: bench.bag(
            path, _without(bench.samples, TWIST, 50, 52), event=ended(bench.episode)
        ),
        "incomplete",
    ),
    "several-publishers": (_event(reason="unknown-loss: two publishers"), "unknown-loss"),
    "recovered": (_custom(recovered="true", recovered_tail="it ends at byte 9"), "recovered"),
    "end-before-start": (
        lambda bench, path: _event(end_stamp=bench.episode.start_ns - NS_PER_S)(bench, path),
        "missing-topic",
    ),
    "negative-start": (_event(start_stamp=-1), "bad-metadata"),
    "start-beyond-any-clock": (_event(start_stamp=2**70), "bad-metadata"),
    "start-is-a-word": (_event(start_stamp="noon"), "bad-metadata"),
    "event-without-id": (_event(id=""), "bad-metadata"),
    "event-of-no-kind": (_event(event="paused"), "bad-metadata"),
    "event-without-counts": (_event(counts=None), "bad-metadata"),
    "counts-are-words": (_event(counts={"eef_pose": "many"}), "bad-metadata"),
    "event-is-no-json": (_custom(episode='{"id": '), "bad-metadata"),
    "event-is-a-list": (_custom(episode="[1, 2]"), "bad-metadata"),
    "topics-are-no-json": (_custom(topics="{'eef_pose': 1}"), "bad-metadata"),
    "map-is-no-json": (_custom(topic_map="fields:"), "bad-metadata"),
    "map-without-fields": (_custom(topic_map="{}"), "bad-metadata"),
    "map-with-an-unknown-role": (_map_field("twist", "role", "dance"), "bad-metadata"),
    "map-with-an-unknown-key": (_map(lambda raw: raw.update(rate=20)), "bad-metadata"),
    "map-without-a-clock": (
        _map(
            lambda raw: (raw.pop("clock"), raw["fields"].pop("eef_position"), raw.update(state=[]))
        ),  # type: ignore[func-returns-value]
        "bad-metadata",
    ),
    "map-path-that-does-not-exist": (
        _map_field("eef_position", "values", ["pose.position.w"]),
        "bad-config",
    ),
    "id-of-another-folder": (_wrong_id, "wrong-id"),
    "event-nested-too-deep": (_custom(episode="[" * 100_000), "bad-metadata"),
    "map-nested-too-deep": (_custom(topic_map='{"a":' * 100_000), "bad-metadata"),
    "no-topic-map": (_no_map, "no-topic-map"),
    # whole files
    "empty-file": (_file(lambda _: b""), "empty-file"),
    "empty-file-in-a-bag": (_emptied, "empty-file"),
    "text-file": (_file(lambda _: b"dear diary\n" * 50), "not-mcap"),
    "picture": (_file(lambda _: b"\x89PNG\r\n\x1a\n" + bytes(400)), "not-mcap"),
    "zeros": (_file(lambda _: bytes(5000)), "not-mcap"),
    "half-of-the-magic": (_file(lambda _: MAGIC[:4]), "not-mcap"),
    "sqlite-file": (_file(lambda _: b"SQLite format 3\0" + bytes(4000)), "foreign-format"),
    "ros-1-bag": (_file(lambda _: b"#ROSBAG V2.0\n" + bytes(4000)), "foreign-format"),
    "compressed-as-a-whole": (
        _file(lambda bench: zstandard.compress(bench.plain)),
        "foreign-format",
    ),
    "git-lfs-pointer": (
        _file(lambda _: b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n"),
        "foreign-format",
    ),
    # torn
    "only-the-magic": (_file(lambda _: MAGIC), "truncated"),
    "cut-in-the-header": (_cut_at(lambda d: 20), "truncated"),
    "cut-in-the-first-chunk": (
        _cut_at(lambda d: _places(d, Opcode.CHUNK)[0].at + 100),
        "truncated",
    ),
    "cut-between-chunks": (_cut_at(lambda d: _places(d, Opcode.CHUNK)[1].at), "truncated"),
    "cut-in-the-last-chunk": (
        _cut_at(lambda d: _places(d, Opcode.CHUNK)[-1].at + 1000),
        "truncated",
    ),
    "cut-in-a-message-index": (
        _cut_at(lambda d: _places(d, Opcode.MESSAGE_INDEX)[-1].at + 12),
        "truncated",
    ),
    "cut-before-the-summary": (_cut_at(_summary_start), "truncated"),
    "cut-in-the-summary": (_cut_at(lambda d: (_summary_start(d) + len(d)) // 2), "truncated"),
    "cut-before-the-footer": (
        _cut_at(lambda d: _places(d, Opcode.FOOTER)[0].at),
        "truncated",
    ),
    "cut-in-the-footer": (_cut_at(lambda d: len(d) - 20), "truncated"),
    "cut-in-the-last-magic": (_cut_at(lambda d: len(d) - 3), "truncated"),
    "end-overwritten-with-zeros": (
        _file(lambda bench: bench.packed[:-3000] + bytes(3000)),
        "truncated",
    ),
    "half-a-bag-in-a-folder": (
        _folder({"half.mcap": lambda bench: bench.packed[: len(bench.packed) // 2]}),
        "truncated",
    ),
    # changed bytes
    "wrong-checksum-of-a-chunk": (_chunk_patch(24, b"\x01\x02\x03\x04"), "checksum"),
    "bit-flipped-in-a-chunk": (_chunk_flip("plain"), "checksum"),
    "bit-flipped-in-a-packed-chunk": (_chunk_flip("packed"), "checksum"),
    "wrong-checksum-of-the-summary": (
        _file(lambda bench: _flip(bench.packed, _places(bench.packed, Opcode.FOOTER)[0].at + 25)),
        "checksum",
    ),
    "bit-flipped-in-the-summary": (
        _file(lambda bench: _flip(bench.packed, _summary_start(bench.packed) + 40)),
        "checksum",
    ),
    "magic-at-the-end-changed": (
        _file(lambda bench: _flip(bench.packed, len(bench.packed) - 1)),
        "truncated",
    ),
    # lies
    "record-longer-than-the-file": (
        _file(
            lambda bench: _patched(
                bench.packed[: _summary_start(bench.packed)],
                _places(bench.packed, Opcode.CHUNK)[1].at + 1,
                struct.pack("<Q", 2**62),
            )
        ),
        "truncated",
    ),
    "chunk-of-a-terabyte": (_chunk_patch(16, struct.pack("<Q", 1 << 40)), "too-large"),
    "chunk-smaller-than-it-says": (_chunk_patch(16, struct.pack("<Q", 1 << 20)), "malformed"),
    "chunk-with-a-name-longer-than-it": (_chunk_patch(28, b"\xff\xff\xff\x7f"), "malformed"),
    "message-longer-than-its-chunk": (
        _in_chunk("MESSAGE", 1, struct.pack("<Q", 1 << 30)),
        "malformed",
    ),
    "message-shorter-than-its-head": (_in_chunk("MESSAGE", 1, struct.pack("<Q", 9)), "malformed"),
    "message-of-an-unknown-channel": (
        _file(lambda bench: _unknown_channel(bench)),
        "unknown-channel",
    ),
    "statistics-of-a-quadrillion": (_file(_huge_statistics), "malformed"),
    "statistics-that-add-up-and-lie": (_file(_lying_statistics), "malformed"),
    "index-to-nowhere": (_file(_index_to_nowhere), "malformed"),
    "bomb-in-zstd": (_file(_bomb_zstd), "too-large"),
    "bomb-in-lz4": (_file(_bomb_lz4), "too-large"),
    "chunk-in-brotli": (
        _file(lambda _: _only_chunk(b"?" * 90, 90, b"brotli")),
        "unsupported-compression",
    ),
    # 10 GB
    "sparse-zeros": (_sparse(b""), "not-mcap"),
    "sparse-after-the-magic": (_sparse(MAGIC), "truncated"),
    "sparse-message": (_sparse(MAGIC + _RECORD.pack(Opcode.MESSAGE, _REST)), "too-large"),
    "sparse-chunk": (_sparse(MAGIC + _RECORD.pack(Opcode.CHUNK, _REST)), "too-large"),
    "sparse-metadata": (_sparse(MAGIC + _RECORD.pack(Opcode.METADATA, _REST)), "too-large"),
    "sparse-summary": (_sparse(MAGIC, _footer(len(MAGIC))), "truncated"),
    # foreign
    "protobuf-schema": (
        _foreign(_Channel(schema_encoding="protobuf", encoding="protobuf")),
        "foreign-encoding",
    ),
    "json-messages": (
        _foreign(_Channel(encoding="json", schema_encoding="jsonschema")),
        "foreign-encoding",
    ),
    "idl-schema": (_foreign(_Channel(schema_encoding="ros2idl")), "foreign-encoding"),
    "no-schema": (_foreign(_Channel(has_schema=False)), "foreign-encoding"),
    "foreign-topic-beside-ours": (
        _foreign(_Channel(topic="/other"), _Channel(encoding="json")),
        "foreign-encoding",
    ),
    "topic-that-writes-on-the-terminal": (
        _foreign(_Channel(topic="/a\n\x1b[2Jeef_pose", encoding="json")),
        "foreign-encoding",
    ),
    "profile-of-ros-1": (_foreign(profile="ros1"), "foreign-encoding"),
    "schema-of-garbage": (
        _foreign(_Channel(text=b"std_msgs/Header header\n??? pose")),
        "bad-definition",
    ),
    "schema-that-contains-itself": (
        _foreign(_Channel(text=b"geometry_msgs/PoseStamped inner")),
        "bad-definition",
    ),
    "schema-without-its-parts": (
        _foreign(_Channel(text=b"std_msgs/Header header\nnowhere_msgs/Nothing pose")),
        "bad-definition",
    ),
    "wrong-type": (_foreign(_Channel(type=_POINT)), "wrong-type"),
    "type-without-a-header": (
        _foreign(_Channel(type="geometry_msgs/msg/Pose"), map_=_headerless),
        "no-header",
    ),
    "no-clock": (_foreign(_Channel(topic="/something/else")), "no-clock"),
    "two-types-on-one-topic": (_foreign(_Channel(), _Channel(type=_POINT)), "ambiguous"),
    "two-definitions-of-one-type": (
        _foreign(_Channel(), _Channel(topic="/b", text=b"int32 x")),
        "ambiguous",
    ),
    "two-topics-that-would-do": (
        _foreign(_Channel(topic="/left/eef_pose"), _Channel(topic="/right/eef_pose")),
        "ambiguous",
    ),
    # folders and names
    "two-files-and-spoilt-metadata": (
        _folder({"one.mcap": _packed, "two.mcap": _packed, "metadata.yaml": b"a: [\n"}),
        "ambiguous",
    ),
    "file-that-metadata-names-is-missing": (_gone, "missing-file"),
    "metadata-alone-and-spoilt": (_folder({"metadata.yaml": b"a: [\n"}), "missing-file"),
    "metadata-names-a-folder-above": (
        _folder({"metadata.yaml": _metadata(relative_file_paths=["../../etc/passwd"])}),
        "missing-file",
    ),
    "metadata-of-sqlite": (
        _folder({"metadata.yaml": _metadata(storage_identifier="sqlite3"), "a.db3": b"SQLite"}),
        "foreign-format",
    ),
    "sqlite-folder": (_folder({"a_0.db3": b"SQLite format 3\0"}), "foreign-format"),
    "compressed-folder": (
        _folder({"metadata.yaml": b"", "a_0.mcap.zstd": b"\x28\xb5\x2f\xfd"}),
        "unsupported-compression",
    ),
    "compression-mode-message": (
        _folder({"metadata.yaml": _metadata(compression_mode="message"), "a_0.mcap": _packed}),
        "unsupported-compression",
    ),
    "folder-without-a-bag": (_folder({"notes.txt": b"tomorrow"}), "missing-file"),
    "folder-named-as-a-file": (
        lambda bench, path: _folder({})(bench, path.with_suffix(".mcap")),
        "missing-file",
    ),
    "link-to-nowhere": (_link("nowhere"), "missing-file"),
    "link-to-itself": (_link("{name}"), "missing-file"),
    "pipe": (_fifo, "missing-file"),
    "pipe-in-a-bag": (_fifo_in_a_bag, "unreadable"),
    "pipe-for-metadata": (_fifo_of_metadata, "unreadable"),
    "sparse-metadata-file": (_sparse_metadata, "missing-file"),
    "metadata-that-unfolds": (_foreign(noted=_UNFOLDING), "no-topic-map"),
    "metadata-without-end": (_foreign(noted="a: &a [*a]\ncustom_data: *a"), "no-topic-map"),
    "metadata-nested-too-deep": (
        _folder({"metadata.yaml": b"[" * 100_000}),
        "missing-file",
    ),
    "not-allowed": (_unreadable, "unreadable"),
    "name-that-is-not-utf-8": (_not_utf8, "truncated"),
    "csv-file": (_named(".csv", b"t,x,y\n0,1,2\n"), "not-mcap"),
}


def _unknown_channel(bench: Bench) -> bytes:
    """A message of channel 777 outside of any chunk, and no summary."""
    data = bench.packed[: _summary_start(bench.packed)]
    data_end = _places(bench.packed, Opcode.DATA_END)[0].at
    body = struct.pack("<HIQQ", 777, 1, 1, 1) + b"\x00\x01\x00\x00"
    return data[:data_end] + _RECORD.pack(Opcode.MESSAGE, len(body)) + body + _footer(0)


def make_bad(name: str, bench: Bench, folder: Path) -> Path:
    """Make one of the table in a folder; returns what a person would name."""
    make, _ = BAD[name]
    return make(bench, folder / name)
