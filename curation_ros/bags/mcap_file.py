"""MCAP files record by record: whole ones by their summary, torn ones up to the tear.

The reader of the mcap package yields half of a record at the end of a torn file and trusts
lengths; here a record counts only if all of its bytes are there and its checksum is right.

`walk` reads any file in its own order. `read_blocks` gives the same messages of a whole file as
arrays, found by the indexes of its chunks; an index is believed only as far as what it says can
be checked in the chunk: with the few records between them, its messages must tile it.
"""

from __future__ import annotations

import errno
import functools
import os
import stat
import struct
import threading
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import numpy.typing as npt
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Metadata, MetadataIndex, Schema, Statistics

from curation_ros.core.errors import BagError
from curation_ros.core.stream import Messages, rows_at

MAGIC = b"\x89MCAP0\r\n"

#: Name of the metadata record that our writer adds when it finishes a bag.
OWN_METADATA = "curation_ros"

_RECORD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_CHUNK_INDEX = struct.Struct("<QQQQI")
_CHANNEL_OFFSET = struct.Struct("<HQ")
_LENGTH = struct.Struct("<Q")
#: Head of a message index with its opcode and length: channel, bytes of its entries.
_MESSAGE_INDEX = struct.Struct("<BQHI")
#: Head of a message record with its opcode and length, and an entry of a message index.
_MESSAGE_HEAD = np.dtype(
    [
        ("opcode", "u1"),
        ("length", "<i8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log_ns", "<u8"),
        ("publish_ns", "<u8"),
    ]
)
_ENTRY_BYTES = 16
_FOOTER_BYTES = _RECORD.size + 20 + len(MAGIC)
# The most that is held in memory of a chunk, and of any record; those of rosbag2 and of ours are
# a few MB. And a chunk that unpacks to much more than it has is a trap: zeros pack 30,000 to 1.
_MAX_CHUNK_BYTES = _MAX_RECORD_BYTES = 1 << 28
_SMALL_CHUNK_BYTES, _MAX_COMPRESSION = 16 << 20, 1000
# Files up to this size are read at once; blocks of messages end after so much that they still
# stay in the cache of a processor while they are decoded.
_SMALL_BYTES = 4 << 20
_BLOCK_BYTES = 1 << 20
# How many times the bytes of its messages a block may keep in memory.
_MOST_UNWANTED = 8
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

_PARSERS: dict[int, Callable[[ReadDataStream], Record]] = {
    Opcode.HEADER: Header.read,
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.STATISTICS: Statistics.read,
}
_READ_WHOLE = frozenset({*_PARSERS, Opcode.CHUNK, Opcode.MESSAGE})


class TornFileError(BagError):
    """The file begins as MCAP, but ends or is damaged before its end; `reason` says where."""

    def __init__(self, path: Path, reason: str, finding: str = "malformed") -> None:
        super().__init__(
            f"{path} is truncated or damaged: {reason}; `ros2 run curation_ros recorder` recovers "
            "what an interrupted recording has left, curation_ros.bags.recover_bag any file",
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
        head = stream.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise TornFileError(path, f"it ends at byte {size} without a footer", "truncated")
        opcode, length = _RECORD.unpack(head)
        left = size - at - _RECORD.size
        if opcode == 0 or length > left:
            what = "zeros" if opcode == 0 else f"a record of {length} bytes, of which {left} exist"
            raise TornFileError(path, f"at byte {at} there is {what}", "truncated")
        if length > _MAX_RECORD_BYTES and opcode in _READ_WHOLE:
            raise TornFileError(
                path,
                f"the record at byte {at} has {length} bytes; {_MAX_RECORD_BYTES} are the most "
                "that is read",
                "too-large",
            )
        if opcode == Opcode.FOOTER:
            stream.seek(at + _RECORD.size + length)
            if stream.read(len(MAGIC)) != MAGIC:
                raise TornFileError(
                    path, "the magic bytes after its footer are missing", "truncated"
                )
            return
        if opcode == Opcode.CHUNK and not skip_chunk(at):
            yield from _chunk_records(
                path, at, _chunk_data(path, at, stream.read(length)), channels
            )
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
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and len(body) < _COMMON_BYTES:
            return _parsed_before(opcode, body)
        return _PARSERS[opcode](ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, ValueError, OverflowError) as err:
        name = Opcode(opcode).name.lower()
        raise TornFileError(path, f"the {name} record at byte {at} is malformed") from err


@functools.lru_cache(maxsize=512)
def _parsed_before(opcode: int, body: bytes) -> Record:
    """A record that the bags of a dataset have in common; nobody may change it."""
    return _PARSERS[opcode](ReadDataStream(BytesIO(body)))


def _message(path: Path, at: int, data: bytes, start: int, length: int) -> Message:
    if length < _MESSAGE.size:
        raise TornFileError(path, f"the message record at byte {at} has only {length} bytes")
    body = data[start + _MESSAGE.size : start + length]
    return Message._make((*_MESSAGE.unpack_from(data, start), body))


def _chunk_records(
    path: Path, at: int, data: bytes, channels: Collection[int] | None
) -> Iterator[Record]:
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


# glibc returns memory to the system above a threshold, and then faults it in anew, page by page,
# for every bag: half the time of reading one. Freeing a large block raises that threshold.
np.empty(_SMALL_BYTES, dtype=np.uint8)


class _PerThread(threading.local):
    zstd: zstandard.ZstdDecompressor | None = None


_PER_THREAD = _PerThread()


def _zstd() -> zstandard.ZstdDecompressor:
    # A new one costs as much as unpacking a small chunk; threads may not share one.
    if _PER_THREAD.zstd is None:
        _PER_THREAD.zstd = zstandard.ZstdDecompressor()
    return _PER_THREAD.zstd


def _chunk_data(path: Path, at: int, body: bytes) -> bytes:
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
    opcode, length = _RECORD.unpack_from(tail) if len(tail) == _FOOTER_BYTES else (0, 0)
    if not tail.endswith(MAGIC) or (opcode, length) != (Opcode.FOOTER, 20):
        # Reading on finds out where it is torn.
        return None
    footer = Footer.read(ReadDataStream(BytesIO(tail[_RECORD.size :])))
    if not len(MAGIC) <= footer.summary_start <= size - _FOOTER_BYTES:
        return None
    if size - footer.summary_start > _MAX_RECORD_BYTES:  # reading on finds out what it is
        return None
    stream.seek(footer.summary_start)
    summary = stream.read(size - _FOOTER_BYTES - footer.summary_start)
    checked = zlib.crc32(tail[: -len(MAGIC) - 4], zlib.crc32(summary))
    if footer.summary_crc not in (0, checked):
        raise TornFileError(path, "its summary has a wrong checksum", "checksum")
    info, statistics, place = McapInfo(), None, 0
    metadata_at: list[int] = []
    is_plain = True
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
        head = stream.read(_RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        known = opcode in (Opcode.HEADER, Opcode.METADATA)
        if not known or length > min(size - offset, _MAX_RECORD_BYTES):
            raise TornFileError(path, f"its index points at byte {offset}, where no record is")
        _note(info, _parse(path, offset, opcode, stream.read(length)))
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


class MessageBlock(NamedTuple):
    """Messages of some channels in file order; every array has a value a message, int64."""

    channels: npt.NDArray[np.int64]
    sequences: npt.NDArray[np.int64]
    log_times_ns: npt.NDArray[np.int64]
    publish_times_ns: npt.NDArray[np.int64]
    messages: Messages

    def take(self, rows: npt.NDArray[np.int64] | slice) -> MessageBlock:
        """Some of the messages; for a slice without a copy."""
        return MessageBlock(
            self.channels[rows],
            self.sequences[rows],
            self.log_times_ns[rows],
            self.publish_times_ns[rows],
            self.messages.take(rows),
        )


def read_blocks(path: Path, info: McapInfo, channels: Collection[int]) -> Iterator[MessageBlock]:
    """Read the messages of some channels, many at once; chunks without any are not unpacked.

    The messages are those of `walk`, in its order.

    Args:
        path: the file.
        info: what `read_info` said about it.
        channels: ids of the wanted channels.

    Raises:
        TornFileError: if the file is damaged, or its index leaves out messages that are there.
        BagError: if the file is no MCAP file, or cannot be read.
    """
    with open_mcap(path) as stream:
        try:
            file = _File(stream)
            indexes = _message_indexes(path, info, file)
            if indexes is None:
                n_left = sum(info.counts.get(channel, 0) for channel in channels)
                for block in _walked_blocks(walk(path, channels=channels)):
                    n_left -= len(block.messages)
                    yield block
                if n_left and info.data_end:
                    raise TornFileError(
                        path, "its statistics and its messages contradict each other"
                    )
            else:
                yield from _indexed_blocks(path, info, file, indexes, channels)
        except OSError as err:
            raise BagError(f"{path}: {err.strerror or err}") from err


class _File:
    """Bytes of a file by offset; a small one is read at once."""

    def __init__(self, stream: BinaryIO) -> None:
        self._fd = stream.fileno()
        size = os.fstat(self._fd).st_size
        self._all = os.pread(self._fd, size, 0) if size <= _SMALL_BYTES else None

    def read(self, at: int, size: int) -> bytes:
        """Bytes from an offset on; fewer than asked for at the end of the file."""
        if self._all is not None:
            return self._all[at : at + size]
        parts = []
        while size and (part := os.pread(self._fd, size, at)):
            parts.append(part)
            at, size = at + len(part), size - len(part)
        return b"".join(parts)


def _message_indexes(path: Path, info: McapInfo, file: _File) -> list[dict[int, bytes]] | None:
    """For each chunk the entries of its message indexes by channel.

    None where they do not account for the file: then something stands outside the chunks, a chunk
    has no index, or they do not sum up to the statistics.
    """
    if not info.chunks:
        return None
    at = len(MAGIC)
    indexes = []
    totals: dict[int, int] = {}
    for place in info.chunks:
        head = file.read(place.start, _RECORD.size)
        if (
            max(place.size, place.index_size) > _MAX_RECORD_BYTES
            or len(head) < _RECORD.size
            or _RECORD.unpack(head) != (Opcode.CHUNK, place.size - _RECORD.size)
            or (at != place.start and not _holds_no_message(path, file, at, place.start))
        ):
            return None
        at = place.start + place.size
        entries = _index_entries(file.read(at, place.index_size))
        if entries is None:
            return None
        at += place.index_size
        indexes.append(entries)
        for channel, raw in entries.items():
            totals[channel] = totals.get(channel, 0) + len(raw) // _ENTRY_BYTES
    counts = {channel: count for channel, count in info.counts.items() if count}
    if {channel: count for channel, count in totals.items() if count} != counts:
        return None
    return indexes if _holds_no_message(path, file, at, info.data_end) else None


def _holds_no_message(path: Path, file: _File, at: int, stop: int) -> bool:
    """Whether the bytes between chunks are whole records, and none of them holds messages."""
    while at < stop:
        head = file.read(at, _RECORD.size)
        opcode, length = _RECORD.unpack(head) if len(head) == _RECORD.size else (0, 0)
        body_at = at + _RECORD.size
        if opcode in (0, Opcode.MESSAGE, Opcode.CHUNK, Opcode.FOOTER) or length > stop - body_at:
            return False
        if opcode in _PARSERS:
            if length > _MAX_RECORD_BYTES:
                return False
            _parse(path, at, opcode, file.read(body_at, length))
        at = body_at + length
    return at == stop


def _index_entries(data: bytes) -> dict[int, bytes] | None:
    """Channel -> entries of its message index; None where the bytes are anything else."""
    entries: dict[int, bytes] = {}
    at, stop, head_size = 0, len(data), _MESSAGE_INDEX.size
    while at < stop:
        if stop - at < head_size:
            return None
        opcode, length, channel, size = _MESSAGE_INDEX.unpack_from(data, at)
        at += head_size
        if (
            opcode != Opcode.MESSAGE_INDEX
            or length != size + head_size - _RECORD.size
            or size % _ENTRY_BYTES
            or size > stop - at
            or channel in entries
        ):
            return None
        entries[channel] = data[at : at + size]
        at += size
    return entries


class _Chunk(NamedTuple):
    at: int
    data: bytes
    entries: dict[int, bytes]


def _indexed_blocks(
    path: Path,
    info: McapInfo,
    file: _File,
    indexes: Sequence[dict[int, bytes]],
    channels: Collection[int],
) -> Iterator[MessageBlock]:
    wanted = frozenset(channels)
    missing = sum(info.counts.get(channel, 0) for channel in wanted)
    group: list[_Chunk] = []
    group_bytes = 0
    for place, entries in zip(info.chunks, indexes, strict=True):
        if not any(raw for channel, raw in entries.items() if channel in wanted):
            continue
        body = file.read(place.start + _RECORD.size, place.size - _RECORD.size)
        group.append(_Chunk(place.start, _chunk_data(path, place.start, body), entries))
        group_bytes += len(group[-1].data)
        if group_bytes >= _BLOCK_BYTES:
            block = _split(path, group, wanted)
            missing -= len(block.messages)
            yield block
            group, group_bytes = [], 0
    if group:
        block = _split(path, group, wanted)
        missing -= len(block.messages)
        yield block
    if missing:
        raise TornFileError(path, "its message indexes and its chunks contradict each other")


def _split(path: Path, chunks: Sequence[_Chunk], wanted: frozenset[int]) -> MessageBlock:
    """The wanted messages of unpacked chunks."""
    block = _split_by_index(path, chunks, wanted)
    if block is None:
        records = (r for c in chunks for r in _chunk_records(path, c.at, c.data, wanted))
        block = _joined([r for r in records if isinstance(r, Message)])
    return block


def _split_by_index(
    path: Path, chunks: Sequence[_Chunk], wanted: frozenset[int]
) -> MessageBlock | None:
    """The wanted messages of unpacked chunks; None where the index does not fit them."""
    sizes = np.array([len(chunk.data) for chunk in chunks], dtype=np.int64)
    stops = np.cumsum(sizes)
    # Some bytes more: whoever gathers whole words reads beyond the last message.
    buffer = np.frombuffer(b"".join([*(chunk.data for chunk in chunks), bytes(8)]), np.uint8)
    ids = [channel for chunk in chunks for channel in chunk.entries]
    raws = [raw for chunk in chunks for raw in chunk.entries.values()]
    repeats = np.array([len(raw) for raw in raws], dtype=np.int64) // _ENTRY_BYTES
    chunk_of = np.repeat(np.arange(len(chunks)), [len(chunk.entries) for chunk in chunks])
    stop = np.repeat(stops[chunk_of], repeats)
    base = np.repeat((stops - sizes)[chunk_of], repeats)
    claimed = np.repeat(np.array(ids, dtype=np.uint16), repeats)
    offsets = np.frombuffer(b"".join(raws), "<i8")[1::2]
    if ((offsets < 0) | (offsets > stop - base - _MESSAGE_HEAD.itemsize)).any():
        return None
    order = np.argsort(offsets + base)
    at, stop, claimed = (offsets + base)[order], stop[order], claimed[order]
    heads = rows_at(buffer, at, _MESSAGE_HEAD.itemsize).view(_MESSAGE_HEAD)[:, 0]
    lengths, channels = heads["length"], heads["channel"]
    fits = (heads["opcode"] == Opcode.MESSAGE) & (channels == claimed)
    fits &= (lengths >= _MESSAGE.size) & (lengths <= stop - at - _RECORD.size)
    if not fits.all():
        return None
    ends = np.concatenate([[0], at + lengths + _RECORD.size])
    begins = np.concatenate([at, stops[-1:]])
    for k in np.flatnonzero(ends != begins).tolist():
        if not _gap_holds_no_message(path, chunks, stops, int(ends[k]), int(begins[k])):
            return None
    messages = Messages(buffer, at + _MESSAGE_HEAD.itemsize, lengths - _MESSAGE.size)
    if not wanted.issuperset(ids):
        rows = np.isin(channels, list(wanted))
        heads, channels, messages = heads[rows], channels[rows], messages.take(rows)
    if len(buffer) > _MOST_UNWANTED * int(messages.sizes.sum()):
        messages = messages.compact()  # else some poses would keep the images beside them
    return MessageBlock(
        channels.astype(np.int64),
        heads["sequence"].astype(np.int64),
        heads["log_ns"].astype(np.int64),
        heads["publish_ns"].astype(np.int64),
        messages,
    )


def _gap_holds_no_message(
    path: Path, chunks: Sequence[_Chunk], stops: npt.NDArray[np.int64], at: int, stop: int
) -> bool:
    """Whether the bytes between indexed messages are whole records, and none is a message."""
    while at < stop:
        k = int(np.searchsorted(stops, at, side="right"))
        chunk, base = chunks[k], int(stops[k]) - len(chunks[k].data)
        place, left = at - base + _RECORD.size, min(stop, int(stops[k])) - at - _RECORD.size
        if left < 0:
            return False
        opcode, length = _RECORD.unpack_from(chunk.data, at - base)
        if opcode == Opcode.MESSAGE or length > left:
            return False
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _parse(path, chunk.at, opcode, chunk.data[place : place + length])
        at += _RECORD.size + length
    return at == stop


def _walked_blocks(records: Iterator[Record]) -> Iterator[MessageBlock]:
    found: list[Message] = []
    size = 0
    for record in records:
        if isinstance(record, Message):
            found.append(record)
            size += len(record.data)
            if size >= _BLOCK_BYTES:
                yield _joined(found)
                found, size = [], 0
    if found:
        yield _joined(found)


def _joined(found: Sequence[Message]) -> MessageBlock:
    return MessageBlock(
        np.array([m.channel_id for m in found], dtype=np.int64),
        np.array([m.sequence for m in found], dtype=np.int64),
        np.array([m.log_time_ns for m in found], dtype=np.uint64).astype(np.int64),
        np.array([m.publish_time_ns for m in found], dtype=np.uint64).astype(np.int64),
        Messages.joined([m.data for m in found]),
    )
