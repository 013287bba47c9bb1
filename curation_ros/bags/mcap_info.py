"""What an MCAP file holds: from its summary, or by a scan where it has none."""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Header, Metadata, MetadataIndex, Schema, Statistics

from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_file import (
    MAGIC,
    MAX_RECORD_BYTES,
    RECORD,
    Message,
    Record,
    open_mcap,
    parse_record,
    walk,
)
from curation_ros.core.errors import BagError

#: Name of the metadata record that our writer adds when it finishes a bag.
OWN_METADATA = "curation_ros"

_FOOTER_BYTES = RECORD.size + 20 + len(MAGIC)
_CHUNK_INDEX = struct.Struct("<QQQQI")
_CHANNEL_OFFSET = struct.Struct("<HQ")
_LENGTH = struct.Struct("<Q")


class ChunkPlace(NamedTuple):
    """Where a chunk and the message indexes behind it are in the file; sizes in bytes."""

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
        data_end: offset of the summary; 0 if there is none.
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
        """Offset of a chunk -> channels in it, for those whose index lists them."""
        return {c.start: c.channels for c in self.chunks if c.channels}


def read_info(path: Path) -> McapInfo:
    """Read what a whole file holds: from its summary, or by a scan if it has none.

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
    """What the summary section holds; None if it is missing or does not suffice."""
    size = stream.seek(0, os.SEEK_END)
    stream.seek(max(0, size - _FOOTER_BYTES))
    tail = stream.read(_FOOTER_BYTES)
    opcode, length = RECORD.unpack_from(tail) if len(tail) == _FOOTER_BYTES else (0, 0)
    if not tail.endswith(MAGIC) or (opcode, length) != (Opcode.FOOTER, 20):
        # The scan finds out where it is torn.
        return None
    footer = Footer.read(ReadDataStream(BytesIO(tail[RECORD.size :])))
    if not len(MAGIC) <= footer.summary_start <= size - _FOOTER_BYTES:
        return None
    if size - footer.summary_start > MAX_RECORD_BYTES:  # the scan finds out what it is
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
        info.chunks = []  # only a scan can find out what is in this file
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
    for offset in [len(MAGIC), *metadata_at]:
        _note(info, _record_at(path, stream, offset, size))
    return info


def _record_at(path: Path, stream: BinaryIO, offset: int, size: int) -> Record:
    """The header or metadata record at an offset that the file itself names."""
    stream.seek(offset)
    head = stream.read(RECORD.size)
    opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
    known = opcode in (Opcode.HEADER, Opcode.METADATA)
    if not known or length > min(size - offset, MAX_RECORD_BYTES):
        raise TornFileError(path, f"its index points at byte {offset}, where no record is")
    return parse_record(path, offset, opcode, stream.read(length))


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
