"""Messages of whole MCAP files as arrays, found by the indexes of their chunks.

The messages are those of `curation_ros.bags.mcap_file.walk`, in its order. An index is used only
if it can be checked. Its messages and the few records between them must tile the chunk, and the
counts must sum up to the statistics. Otherwise the chunk, or the file, is walked.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import numpy.typing as npt
from mcap.opcode import Opcode

from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_file import (
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE,
    PARSERS,
    RECORD,
    Message,
    Record,
    chunk_records,
    open_mcap,
    parse_record,
    unpack_chunk,
    walk,
)
from curation_ros.bags.mcap_info import McapInfo
from curation_ros.core.episode.stream import Messages, rows_at
from curation_ros.core.errors import BagError

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
# Files up to this size are read at once. Blocks of messages end at the second size, so that they
# stay in the cache of a processor while they are decoded.
_SMALL_BYTES = 4 << 20
_BLOCK_BYTES = 1 << 20
# How many times the bytes of its messages a block may keep in memory.
_MOST_UNWANTED = 8

# glibc returns memory to the system above a threshold, and then faults it in again, page by page,
# for every bag. That takes a fifth of the time of reading. Freeing a large block raises the
# threshold.
np.empty(_SMALL_BYTES, dtype=np.uint8)


class MessageBlock(NamedTuple):
    """Messages of some channels in file order; every array has one int64 per message."""

    channels: npt.NDArray[np.int64]
    sequences: npt.NDArray[np.int64]
    log_times_ns: npt.NDArray[np.int64]
    publish_times_ns: npt.NDArray[np.int64]
    messages: Messages

    def take(self, rows: npt.NDArray[np.int64] | slice) -> MessageBlock:
        """Some of the messages; a slice is not copied."""
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
        info: what `read_info` returned for it.
        channels: ids of the wanted channels.

    Raises:
        TornFileError: if the file is damaged, or its index leaves out messages.
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
        head = file.read(place.start, RECORD.size)
        if (
            max(place.size, place.index_size) > MAX_RECORD_BYTES
            or len(head) < RECORD.size
            or RECORD.unpack(head) != (Opcode.CHUNK, place.size - RECORD.size)
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
        head = file.read(at, RECORD.size)
        opcode, length = RECORD.unpack(head) if len(head) == RECORD.size else (0, 0)
        body_at = at + RECORD.size
        if opcode in (0, Opcode.MESSAGE, Opcode.CHUNK, Opcode.FOOTER) or length > stop - body_at:
            return False
        if opcode in PARSERS:
            if length > MAX_RECORD_BYTES:
                return False
            parse_record(path, at, opcode, file.read(body_at, length))
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
            or length != size + head_size - RECORD.size
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
        body = file.read(place.start + RECORD.size, place.size - RECORD.size)
        group.append(_Chunk(place.start, unpack_chunk(path, place.start, body), entries))
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
        records = (r for c in chunks for r in chunk_records(path, c.at, c.data, wanted))
        block = _joined([r for r in records if isinstance(r, Message)])
    return block


def _split_by_index(
    path: Path, chunks: Sequence[_Chunk], wanted: frozenset[int]
) -> MessageBlock | None:
    """The wanted messages of unpacked chunks; None where the index does not fit them."""
    sizes = np.array([len(chunk.data) for chunk in chunks], dtype=np.int64)
    stops = np.cumsum(sizes)
    # Some bytes more, because gathering whole words reads beyond the last message.
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
    fits &= (lengths >= MESSAGE.size) & (lengths <= stop - at - RECORD.size)
    if not fits.all():
        return None
    ends = np.concatenate([[0], at + lengths + RECORD.size])
    begins = np.concatenate([at, stops[-1:]])
    for k in np.flatnonzero(ends != begins).tolist():
        if not _gap_holds_no_message(path, chunks, stops, int(ends[k]), int(begins[k])):
            return None
    messages = Messages(buffer, at + _MESSAGE_HEAD.itemsize, lengths - MESSAGE.size)
    if not wanted.issuperset(ids):
        rows = np.isin(channels, list(wanted))
        heads, channels, messages = heads[rows], channels[rows], messages.take(rows)
    if len(buffer) > _MOST_UNWANTED * int(messages.sizes.sum()):
        messages = messages.compact()  # otherwise a few poses would keep the images between them
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
        place, left = at - base + RECORD.size, min(stop, int(stops[k])) - at - RECORD.size
        if left < 0:
            return False
        opcode, length = RECORD.unpack_from(chunk.data, at - base)
        if opcode == Opcode.MESSAGE or length > left:
            return False
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            parse_record(path, chunk.at, opcode, chunk.data[place : place + length])
        at += RECORD.size + length
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
