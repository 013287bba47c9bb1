"""MCAP files record by record: whole ones by their summary, torn ones up to the tear.

The reader of the mcap package yields half of a record at the end of a torn file and trusts
lengths; here a record counts only if all of its bytes are there and its checksum is right.

`walk` reads any file in its own order; `curation_ros.bags.mcap_blocks` reads whole ones faster.
"""

from __future__ import annotations

import errno
import functools
import os
import stat
import struct
import threading
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
from mcap.records import Channel, Footer, Header, Metadata, MetadataIndex, Schema, Statistics

from curation_ros.core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

#: Name of the metadata record that our writer adds when it finishes a bag.
OWN_METADATA = "curation_ros"

#: Head of a record: opcode, length of its body.
RECORD = struct.Struct("<BQ")
#: Head of the body of a message: channel, sequence, log time, publish time.
MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_CHANNEL_OFFSET = struct.Struct("<HQ")
_LENGTH = struct.Struct("<Q")
_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)
# The most that is held in memory of a chunk, and of any record; those of rosbag2 and of ours are
# a few MB. And a chunk that unpacks to much more than it has is a trap: zeros pack 30,000 to 1.
_MAX_CHUNK_BYTES = MAX_RECORD_BYTES = 1 << 28
_SMALL_CHUNK_BYTES, _MAX_COMPRESSION = 16 << 20, 1000
# Schemas and channels up to this size are kept, as the next bag is likely to have them, too.
_COMMON_BYTES = 16 << 10
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

#: Opcodes of the records that are parsed as a whole.
PARSERS: dict[int, Callable[[ReadDataStream], Record]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
}
_READ_WHOLE = frozenset({*PARSERS, Opcode.CHUNK, Opcode.MESSAGE})


class TornFileError(BagError):
    """The file begins as MCAP, but ends or is damaged before its end; `reason` says where."""

    def __init__(self, path: Path, reason: str, finding: str = "malformed") -> None:
        super().__init__(
            f"{path} is truncated or damaged: {reason}; `curation recover` saves what it "
            "still holds; what an interrupted recording has left, the next recorder does",
            finding=finding,
        )
        self.path = path
        self.reason = reason

    def __reduce__(self) -> tuple[type[TornFileError], tuple[Path, str, str]]:
        # Workers send it to their parent: without this it would be made of its message.
        return type(self), (self.path, self.reason, self.finding)


def open_now(path: Path) -> BinaryIO:
    """Open a file to read it; one that is no plain file, such as a pipe, is never waited for.

    Raises:
        OSError: if it cannot be opened, or is no plain file.
    """
    stream = open(path, "rb", opener=_open_without_waiting)  # noqa: SIM115 - the caller closes it
    if stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
        return stream
    stream.close()
    raise OSError(errno.EINVAL, "not a plain file")


def _open_without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def open_mcap(path: Path) -> BinaryIO:
    """Open a file that begins as MCAP does.

    Raises:
        BagError: if it cannot be opened, is empty, or is something else, saying what.
    """
    try:
        stream = open_now(path)
        start = stream.read(32)
    except OSError as err:
        gone = isinstance(err, FileNotFoundError)
        finding = "missing-file" if gone else "unreadable"
        raise BagError(f"{path}: {err.strerror}", finding=finding) from err
    if start.startswith(MAGIC):
        stream.seek(len(MAGIC))
        return stream
    stream.close()
    if not start:
        raise BagError(
            f"{path} is empty (0 bytes): nothing was recorded in it", finding="empty-file"
        )
    for magic, what in _FOREIGN.items():
        if start.startswith(magic):
            raise BagError(f"{path} is no MCAP file but {what}", finding="foreign-format")
    raise BagError(
        f"{path} is no MCAP file: it begins with {start[:8].hex()}, not {MAGIC.hex()}",
        finding="not-mcap",
    )


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
        head = stream.read(RECORD.size)
        if len(head) < RECORD.size:
            raise TornFileError(path, f"it ends at byte {size} without a footer", "truncated")
        opcode, length = RECORD.unpack(head)
        left = size - at - RECORD.size
        if opcode == 0 or length > left:
            what = "zeros" if opcode == 0 else f"a record of {length} bytes, of which {left} exist"
            raise TornFileError(path, f"at byte {at} there is {what}", "truncated")
        if length > MAX_RECORD_BYTES and opcode in _READ_WHOLE:
            raise TornFileError(
                path,
                f"the record at byte {at} has {length} bytes; {MAX_RECORD_BYTES} are the most "
                "that is read",
                "too-large",
            )
        if opcode == Opcode.FOOTER:
            stream.seek(at + RECORD.size + length)
            if stream.read(len(MAGIC)) != MAGIC:
                raise TornFileError(
                    path, "the magic bytes after its footer are missing", "truncated"
                )
            return
        if opcode == Opcode.CHUNK and not skip_chunk(at):
            yield from chunk_records(
                path, at, unpack_chunk(path, at, stream.read(length)), channels
            )
        elif opcode == Opcode.MESSAGE:
            message = _message(path, at, stream.read(length), 0, length)
            if channels is None or message.channel_id in channels:
                yield message
        elif opcode in PARSERS:
            yield parse_record(path, at, opcode, stream.read(length))
        at += RECORD.size + length
        stream.seek(at)


def parse_record(path: Path, at: int, opcode: int, body: bytes) -> Record:
    """Parse a record whose opcode is among PARSERS; nobody may change what is returned.

    Raises:
        TornFileError: if it is malformed.
    """
    try:
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and len(body) < _COMMON_BYTES:
            return _parsed_before(opcode, body)
        return PARSERS[opcode](ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as err:
        name = Opcode(opcode).name.lower()
        raise TornFileError(path, f"the {name} record at byte {at} is malformed") from err


@functools.lru_cache(maxsize=512)
def _parsed_before(opcode: int, body: bytes) -> Record:
    """A record that the bags of a dataset have in common; nobody may change it."""
    return PARSERS[opcode](ReadDataStream(BytesIO(body)))


def _message(path: Path, at: int, data: bytes, start: int, length: int) -> Message:
    if length < MESSAGE.size:
        raise TornFileError(path, f"the message record at byte {at} has only {length} bytes")
    body = data[start + MESSAGE.size : start + length]
    return Message._make((*MESSAGE.unpack_from(data, start), body))


def chunk_records(
    path: Path, at: int, data: bytes, channels: Collection[int] | None
) -> Iterator[Record]:
    """The schemas, channels and wanted messages in an unpacked chunk, in its order.

    Args:
        path: the file, for errors.
        at: offset of the chunk, for errors.
        data: the unpacked chunk.
        channels: ids of the wanted channels; None: all.

    Raises:
        TornFileError: where a record is incomplete, after all before it were yielded.
    """
    size, place = len(data), 0
    while place < size:
        if size - place < RECORD.size:
            raise TornFileError(path, f"the chunk at byte {at} ends within a record")
        opcode, length = RECORD.unpack_from(data, place)
        place += RECORD.size
        if length > size - place:
            raise TornFileError(path, f"the chunk at byte {at} ends within a record")
        if opcode == Opcode.MESSAGE:
            message = _message(path, at, data, place, length)
            if channels is None or message.channel_id in channels:
                yield message
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            yield parse_record(path, at, opcode, data[place : place + length])
        place += length


class _PerThread(threading.local):
    zstd: zstandard.ZstdDecompressor | None = None


_PER_THREAD = _PerThread()


def _zstd() -> zstandard.ZstdDecompressor:
    # A new one costs as much as unpacking a small chunk; threads may not share one.
    if _PER_THREAD.zstd is None:
        _PER_THREAD.zstd = zstandard.ZstdDecompressor()
    return _PER_THREAD.zstd


def unpack_chunk(path: Path, at: int, body: bytes) -> bytes:
    """The records in the body of a chunk record, decompressed and checked.

    Raises:
        TornFileError: if it is damaged, or claims to be larger than can be.
        BagError: if its compression is none that is known.
    """

    def torn(what: str, finding: str = "malformed") -> TornFileError:
        return TornFileError(path, f"the chunk at byte {at} {what}", finding)

    try:
        _, _, size, checksum, name_size = _CHUNK.unpack_from(body)
        compression = body[_CHUNK.size : _CHUNK.size + name_size].decode()
        (packed_size,) = _LENGTH.unpack_from(body, _CHUNK.size + name_size)
    except (struct.error, ValueError) as err:
        raise torn("is malformed") from err
    packed_at = _CHUNK.size + name_size + 8
    if packed_size > len(body) - packed_at:
        raise torn("is malformed")
    packed = memoryview(body)[packed_at : packed_at + packed_size]
    if size > _MAX_CHUNK_BYTES:
        text = f"claims {size} bytes; {_MAX_CHUNK_BYTES} are the most that is read"
        raise torn(text, "too-large")
    if size > max(_SMALL_CHUNK_BYTES, _MAX_COMPRESSION * len(packed)):
        text = f"claims {size} bytes in {len(packed)}: no recording is as empty as that"
        raise torn(text, "too-large")
    try:
        if compression == "zstd":
            # -1: the frame does not say.
            if zstandard.frame_content_size(packed) not in (-1, size):
                raise torn("has another size than it claims")
            data = _zstd().decompress(packed, max_output_size=size)
        elif compression == "lz4":
            # Never more than claimed, whatever the frame unpacks to.
            data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
        elif compression:
            raise BagError(
                f"{path}: chunk compression {compression!r} is none of zstd, lz4",
                finding="unsupported-compression",
            )
        else:
            data = bytes(packed)
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError) as err:
        raise torn(f"cannot be decompressed ({compression})") from err
    if len(data) != size or (checksum and zlib.crc32(data) != checksum):
        finding = "checksum" if len(data) == size else "malformed"
        raise torn("has a wrong checksum or size", finding)
    return bytes(data)


class ChunkPlace(NamedTuple):
    """Where a chunk and the message indexes behind it stand in the file; sizes in bytes."""

    start: int
    size: int
    index_size: int
    channel_map: bytes

    @property
    def channels(self) -> frozenset[int]:
        """Ids of the channels that have messages in it."""
        return frozenset(channel for channel, _ in _CHANNEL_OFFSET.iter_unpack(self.channel_map))


@dataclass
class McapInfo:
    """What a file holds, without its messages.

    Attributes:
        profile: of its header.
        schemas, channels: by id.
        counts: channel id -> messages.
        start_ns, end_ns: first and last log time; 0 without messages.
        data_end: offset behind the last record that is not of the summary, where there is one.
        rosbag2: the last `rosbag2` metadata record, or None.
        own: that of our writer, or None.
        chunks: its chunks in file order, where the file has an index of each.
    """

    profile: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: dict[int, int] = field(default_factory=dict)
    start_ns: int = 0
    end_ns: int = 0
    data_end: int = 0
    rosbag2: dict[str, str] | None = None
    own: dict[str, str] | None = None
    chunks: list[ChunkPlace] = field(default_factory=list)

    @property
    def chunk_channels(self) -> dict[int, frozenset[int]]:
        """Offset of a chunk -> channels in it, where the file says so."""
        return {c.start: c.channels for c in self.chunks if c.channels}


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
                text = f"a message of the unknown channel {record.channel_id}"
                raise TornFileError(path, text, "unknown-channel")
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
    elif isinstance(record, Metadata) and record.name == OWN_METADATA:
        info.own = record.metadata


def _read_summary(path: Path, stream: BinaryIO) -> McapInfo | None:
    """Facts of the summary section; None where there is none that suffices."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _FOOTER_BYTES))
    tail = stream.read(_FOOTER_BYTES)
    opcode, length = RECORD.unpack_from(tail) if len(tail) == _FOOTER_BYTES else (0, 0)
    if not tail.endswith(MAGIC) or (opcode, length) != (Opcode.FOOTER, 20):
        # Reading on finds out where it is torn.
        return None
    footer = Footer.read(ReadDataStream(BytesIO(tail[RECORD.size :])))
    if not len(MAGIC) <= footer.summary_start <= size - _FOOTER_BYTES:
        return None
    if size - footer.summary_start > MAX_RECORD_BYTES:  # reading on finds out what it is
        return None
    stream.seek(footer.summary_start)
    summary = stream.read(size - _FOOTER_BYTES - footer.summary_start)
    checked = zlib.crc32(tail[: -len(MAGIC) - 4], zlib.crc32(summary))
    if footer.summary_crc not in (0, checked):
        raise TornFileError(path, "its summary has a wrong checksum", "checksum")
    info, statistics, place = McapInfo(), None, 0
    metadata_at: list[int] = []
    is_plain = True
    while place + RECORD.size <= len(summary):
        opcode, length = RECORD.unpack_from(summary, place)
        body = summary[place + RECORD.size : place + RECORD.size + length]
        at = footer.summary_start + place
        place += RECORD.size + length
        if opcode == Opcode.STATISTICS:
            found = parse_record(path, at, opcode, body)
            statistics = found if isinstance(found, Statistics) else None
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _note(info, parse_record(path, at, opcode, body))
        elif opcode in (Opcode.CHUNK_INDEX, Opcode.METADATA_INDEX):
            try:
                _note_index(info, opcode, body, metadata_at)
            except (McapError, struct.error, ValueError, OverflowError) as err:
                raise TornFileError(path, f"the index at byte {at} is malformed") from err
        elif opcode in (Opcode.MESSAGE, Opcode.CHUNK):
            is_plain = False
    if statistics is None or statistics.channel_count != len(info.channels):
        return None
    if statistics.chunk_count != len(info.chunks) or not is_plain or place != len(summary):
        info.chunks = []  # only reading all of it tells what is in this file
    info.chunks.sort()
    info.data_end = footer.summary_start
    info.counts = dict(statistics.channel_message_counts)
    if statistics.message_count != sum(info.counts.values()):
        if info.counts:
            raise TornFileError(path, "its statistics contradict themselves")
        return None
    info.start_ns, info.end_ns = statistics.message_start_time, statistics.message_end_time
    if statistics.metadata_count and not metadata_at:
        return None
    stream.seek(len(MAGIC))
    for offset in [len(MAGIC), *metadata_at]:
        stream.seek(offset)
        head = stream.read(RECORD.size)
        opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        known = opcode in (Opcode.HEADER, Opcode.METADATA)
        if not known or length > min(size - offset, MAX_RECORD_BYTES):
            raise TornFileError(path, f"its index points at byte {offset}, where no record is")
        _note(info, parse_record(path, offset, opcode, stream.read(length)))
    return info


def _note_index(info: McapInfo, opcode: int, body: bytes, metadata_at: list[int]) -> None:
    if opcode == Opcode.METADATA_INDEX:
        index = MetadataIndex.read(ReadDataStream(BytesIO(body)))
        if index.name in ("rosbag2", OWN_METADATA):
            metadata_at.append(index.offset)
        return
    _, _, start, size, map_size = _CHUNK_INDEX.unpack_from(body)
    rest = _CHUNK_INDEX.size + map_size
    if map_size % _CHANNEL_OFFSET.size:
        raise ValueError("half an entry at the end of a map")
    (index_size,) = _LENGTH.unpack_from(body, rest)
    channel_map = body[_CHUNK_INDEX.size : rest]
    info.chunks.append(ChunkPlace(start, size, index_size, channel_map))
