"""MCAP files record by record: whole ones by their summary, torn ones up to the tear.

The reader of the mcap package yields half of a record at the end of a torn file and trusts
lengths; here a record counts only if all of its bytes are there and its checksum is right.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)

from curation_ros.core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_FOOTER_BYTES = _RECORD.size + 20 + len(MAGIC)
_MAX_CHUNK_BYTES = 1 << 30
_FOREIGN = {
    b"SQLite format 3": "a rosbag2 bag in SQLite (.db3); convert it with rosbags-convert",
    b"#ROSBAG V2.0": "a ROS 1 bag; convert it with rosbags-convert",
    b"\x28\xb5\x2f\xfd": "compressed as a whole; decompress it with zstd -d",
    b"version https://git-lfs": "a Git LFS pointer; fetch the file itself",
}


class Message(NamedTuple):
    """A message record; times are nanoseconds."""

    channel_id: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


Record: TypeAlias = Header | Schema | Channel | Message | Metadata | Statistics

_PARSERS: dict[int, Callable[[ReadDataStream], Record]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
}


class TornFileError(BagError):
    """The file begins as MCAP, but ends or is damaged before its end; `reason` says where."""

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(
            f"{path} is truncated or damaged: {reason}; `ros2 run curation_ros recorder` recovers "
            "what an interrupted recording has left, curation_ros.bags.recover_bag any file"
        )
        self.reason = reason


def open_mcap(path: Path) -> BinaryIO:
    """Open a file that begins as MCAP does.

    Raises:
        BagError: if it cannot be opened, is empty, or is something else, saying what.
    """
    try:
        stream = path.open("rb")
    except OSError as err:
        raise BagError(f"{path}: {err.strerror}") from err
    start = stream.read(32)
    if start.startswith(MAGIC):
        stream.seek(len(MAGIC))
        return stream
    stream.close()
    if not start:
        raise BagError(f"{path} is empty (0 bytes): nothing was recorded in it")
    for magic, what in _FOREIGN.items():
        if start.startswith(magic):
            raise BagError(f"{path} is no MCAP file but {what}")
    raise BagError(f"{path} is no MCAP file: it begins with {start[:8].hex()}, not {MAGIC.hex()}")


def walk(
    path: Path,
    skip_chunk: Callable[[int], bool] = lambda offset: False,
    channels: Collection[int] | None = None,
) -> Iterator[Record]:
    """Read a file in its own order, up to its end or to the first damage.

    Args:
        path: the file.
        skip_chunk: tells by the offset of a chunk that nothing in it is wanted.
        channels: channel ids whose messages are wanted; None: all.

    Raises:
        TornFileError: where a record is incomplete or a checksum wrong, after all before it were
            yielded.
        BagError: if the file is no MCAP file, or cannot be read.
    """
    with open_mcap(path) as stream:
        try:
            yield from _walk(path, stream, skip_chunk, channels)
        except OSError as err:
            raise BagError(f"{path}: {err.strerror or err}") from err


def _walk(
    path: Path,
    stream: BinaryIO,
    skip_chunk: Callable[[int], bool],
    channels: Collection[int] | None,
) -> Iterator[Record]:
    size = os.fstat(stream.fileno()).st_size
    at = stream.tell()
    while True:
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise TornFileError(path, f"it ends at byte {size} without a footer")
        opcode, length = _RECORD.unpack(head)
        left = size - at - _RECORD.size
        if opcode == 0 or length > left:
            what = "zeros" if opcode == 0 else f"a record of {length} bytes, of which {left} exist"
            raise TornFileError(path, f"at byte {at} there is {what}")
        if opcode == Opcode.FOOTER:
            stream.seek(at + _RECORD.size + length)
            if stream.read(len(MAGIC)) != MAGIC:
                raise TornFileError(path, "the magic bytes after its footer are missing")
            return
        if opcode == Opcode.CHUNK and not skip_chunk(at):
            yield from _chunk_records(path, at, stream.read(length), channels)
        elif opcode == Opcode.MESSAGE:
            message = _message(path, at, stream.read(length), 0, length)
            if channels is None or message.channel_id in channels:
                yield message
        elif opcode in _PARSERS:
            yield _parse(path, at, opcode, stream.read(length))
        at += _RECORD.size + length
        stream.seek(at)


def _parse(path: Path, at: int, opcode: int, body: bytes) -> Record:
    try:
        return _PARSERS[opcode](ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as err:
        name = Opcode(opcode).name.lower()
        raise TornFileError(path, f"the {name} record at byte {at} is malformed") from err


def _message(path: Path, at: int, data: bytes, start: int, length: int) -> Message:
    if length < _MESSAGE.size:
        raise TornFileError(path, f"the message record at byte {at} has only {length} bytes")
    body = data[start + _MESSAGE.size : start + length]
    return Message._make((*_MESSAGE.unpack_from(data, start), body))


def _chunk_records(
    path: Path, at: int, body: bytes, channels: Collection[int] | None
) -> Iterator[Record]:
    data = _chunk_data(path, at, body)
    size, place = len(data), 0
    while place < size:
        if size - place < _RECORD.size:
            raise TornFileError(path, f"the chunk at byte {at} ends within a record")
        opcode, length = _RECORD.unpack_from(data, place)
        place += _RECORD.size
        if length > size - place:
            raise TornFileError(path, f"the chunk at byte {at} ends within a record")
        if opcode == Opcode.MESSAGE:
            message = _message(path, at, data, place, length)
            if channels is None or message.channel_id in channels:
                yield message
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield _parse(path, at, opcode, data[place : place + length])
        place += length


def _chunk_data(path: Path, at: int, body: bytes) -> bytes:
    def torn(what: str) -> TornFileError:
        return TornFileError(path, f"the chunk at byte {at} {what}")

    try:
        _, _, size, checksum = _CHUNK.unpack_from(body)
        stream = ReadDataStream(BytesIO(body[_CHUNK.size :]))
        compression = stream.read_prefixed_string()
        packed = stream.read(stream.read8())
    except (McapError, struct.error, ValueError, OverflowError) as err:
        raise torn("is malformed") from err
    if size > _MAX_CHUNK_BYTES:
        raise torn(f"claims {size} bytes; {_MAX_CHUNK_BYTES} are the most that is read")
    try:
        if compression == "zstd":
            # -1: the frame does not say.
            if zstandard.frame_content_size(packed) not in (-1, size):
                raise torn("has another size than it claims")
            data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
        elif compression == "lz4":
            # Never more than claimed, whatever the frame unpacks to.
            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
        elif compression:
            raise BagError(f"{path}: chunk compression {compression!r} is none of zstd, lz4")
        else:
            data = packed
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError) as err:
        raise torn(f"cannot be decompressed ({compression})") from err
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):
        raise torn("has a wrong checksum or size")
    return bytes(data)


@dataclass
class McapInfo:
    """What a file holds, without its messages.

    Attributes:
        profile: of its header.
        schemas, channels: by id.
        counts: channel id -> messages.
        start_ns, end_ns: first and last log time; 0 without messages.
        rosbag2: the last `rosbag2` metadata record, or None.
        chunk_channels: offset of a chunk -> channels in it, where the file has an index.
    """

    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    rosbag2: dict[str, str] | None = None
    chunk_channels: dict[int, frozenset[int]] = field(default_factory=dict)


def read_info(path: Path) -> McapInfo:
    """Read what a whole file holds: from its summary, or by a scan where it has none.

    Raises:
        TornFileError: if it is truncated or damaged.
        BagError: if it is no MCAP file, or cannot be read.
    """
    with open_mcap(path) as stream:
        try:
            info = _read_summary(path, stream)
        except OSError as err:
            raise BagError(f"{path}: {err.strerror or err}") from err
    if info is not None:
        return info
    info, first = McapInfo(), True
    for record in walk(path):
        if isinstance(record, Message):
            if record.channel_id not in info.channels:
                raise TornFileError(path, f"a message of the unknown channel {record.channel_id}")
            info.counts[record.channel_id] = info.counts.get(record.channel_id, 0) + 1
            time_ns = record.log_time_ns
            info.start_ns = time_ns if first else min(info.start_ns, time_ns)
            info.end_ns, first = max(info.end_ns, time_ns), False
        else:
            _note(info, record)
    return info


def _note(info: McapInfo, record: Record) -> None:
    if isinstance(record, Header):
        info.profile = record.profile
    elif isinstance(record, Schema):
        info.schemas[record.id] = record
    elif isinstance(record, Channel):
        info.channels[record.id] = record
    elif isinstance(record, Metadata) and record.name == "rosbag2":
        info.rosbag2 = record.metadata


def _read_summary(path: Path, stream: BinaryIO) -> McapInfo | None:
    """Facts of the summary section; None where there is none that suffices."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _FOOTER_BYTES))
    tail = stream.read(_FOOTER_BYTES)
    opcode, length = _RECORD.unpack_from(tail) if len(tail) == _FOOTER_BYTES else (0, 0)
    if not tail.endswith(MAGIC) or (opcode, length) != (Opcode.FOOTER, 20):
        # Reading on finds out where it is torn.
        return None
    footer = Footer.read(ReadDataStream(BytesIO(tail[_RECORD.size :])))
    if not len(MAGIC) <= footer.summary_start <= size - _FOOTER_BYTES:
        return None
    stream.seek(footer.summary_start)
    summary = stream.read(size - _FOOTER_BYTES - footer.summary_start)
    checked = zlib.crc32(tail[: -len(MAGIC) - 4], zlib.crc32(summary))
    if footer.summary_crc not in (0, checked):
        raise TornFileError(path, "its summary has a wrong checksum")
    info, statistics, place = McapInfo(), None, 0
    metadata_at: list[int] = []
    while place + _RECORD.size <= len(summary):
        opcode, length = _RECORD.unpack_from(summary, place)
        body = summary[place + _RECORD.size : place + _RECORD.size + length]
        at = footer.summary_start + place
        place += _RECORD.size + length
        if opcode == Opcode.STATISTICS:
            found = _parse(path, at, opcode, body)
            statistics = found if isinstance(found, Statistics) else None
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _note(info, _parse(path, at, opcode, body))
        elif opcode in (Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX):
            try:
                _note_index(info, opcode, body, metadata_at)
            except (McapError, struct.error, ValueError, OverflowError) as err:
                raise TornFileError(path, f"the index at byte {at} is malformed") from err
    if statistics is None or statistics.channel_count != len(info.channels):
        return None
    info.counts = dict(statistics.channel_message_counts)
    if statistics.message_count != sum(info.counts.values()):
        return None
    info.start_ns, info.end_ns = statistics.message_start_time, statistics.message_end_time
    if statistics.metadata_count and not metadata_at:
        return None
    stream.seek(len(MAGIC))
    for offset in [len(MAGIC), *metadata_at]:
        stream.seek(offset)
        head = stream.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        if opcode not in (Opcode.HEADER, Opcode.METADATA) or length > size - offset:
            raise TornFileError(path, f"its index points at byte {offset}, where no record is")
        _note(info, _parse(path, offset, opcode, stream.read(length)))
    return info


def _note_index(info: McapInfo, opcode: int, body: bytes, metadata_at: list[int]) -> None:
    stream = ReadDataStream(BytesIO(body))
    if opcode == Opcode.METADATA_INDEX:
        index = MetadataIndex.read(stream)
        if index.name == "rosbag2":
            metadata_at.append(index.offset)
        return
    chunk = ChunkIndex.read(stream)
    if chunk.message_index_offsets:
        info.chunk_channels[chunk.chunk_start_offset] = frozenset(chunk.message_index_offsets)
