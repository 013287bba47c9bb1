"""MCAP files record by record, torn ones up to the tear.

The reader of the mcap package trusts lengths, and yields half of a record at the end of a torn
file. Here a record counts only if all of its bytes are there and its checksum is right.

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
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema, Statistics

from curation_ros.bags.errors import TornFileError
from curation_ros.core.errors import BagError

MAGIC = b"\x89MCAP0\r\n"

#: Head of a record: opcode, length of its body.
RECORD = struct.Struct("<BQ")
#: Head of the body of a message: channel, sequence, log time, publish time.
MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_LENGTH = struct.Struct("<Q")
# Limits on what is held in memory of a chunk and of any record. Those of rosbag2 and of ours have
# a few MB. A small chunk that unpacks to a large one is a trap: zeros pack 30,000 to 1.
_MAX_CHUNK_BYTES = MAX_RECORD_BYTES = 1 << 28
_SMALL_CHUNK_BYTES, _MAX_COMPRESSION = 16 << 20, 1000
# Schemas and channels up to this size are cached: the next bag is likely to have them, too.
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


def open_now(path: Path) -> BinaryIO:
    """Open a plain file to read it. Others, such as a pipe, are refused without waiting.

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
        skip_chunk: returns, for the offset of a chunk, whether nothing in it is wanted.
        channels: channel ids whose messages are wanted; None: all.

    Raises:
        TornFileError: if a record is incomplete or a checksum wrong. The records before it are
            yielded first.
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
    """Parse a record whose opcode is among PARSERS; do not change it, since it may be cached.

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
    """A record that the bags of a dataset have in common."""
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
        TornFileError: if a record is incomplete. The records before it are yielded first.
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
    # Making one costs as much as unpacking a small chunk, and threads must not share one.
    if _PER_THREAD.zstd is None:
        _PER_THREAD.zstd = zstandard.ZstdDecompressor()
    return _PER_THREAD.zstd


def unpack_chunk(path: Path, at: int, body: bytes) -> bytes:
    """The records in the body of a chunk record, decompressed and checked.

    Raises:
        TornFileError: if it is damaged, or claims an implausible size.
        BagError: if its compression is not known.
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
            # -1: the frame does not have its size.
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
