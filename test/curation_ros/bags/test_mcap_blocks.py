"""Blocks of messages by index against the walk over the same file, which needs no index."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer

from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_blocks import read_blocks
from curation_ros.bags.mcap_file import MAGIC, Message, walk
from curation_ros.bags.mcap_info import McapInfo, read_info
from curation_ros.core.errors import BagError

N_CHANNELS = 3
_HEAD = struct.Struct("<BQ")
in_one_folder = settings(
    max_examples=150,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


class _Shape(NamedTuple):
    channels: list[int]
    sizes: list[int]
    chunk_size: int
    compression: CompressionType
    index_types: IndexType


_shapes = st.integers(0, 40).flatmap(
    lambda n: st.builds(
        _Shape,
        st.lists(st.integers(0, N_CHANNELS - 1), min_size=n, max_size=n),
        st.lists(st.integers(0, 60), min_size=n, max_size=n),
        st.sampled_from([1, 100, 500, 1 << 20]),
        st.sampled_from(list(CompressionType)),
        st.sampled_from([IndexType.ALL, IndexType.NONE, IndexType.CHUNK, IndexType.MESSAGE]),
    )
)


def _file(shape: _Shape, *, late_channels: bool = True, **options: Any) -> bytes:
    """A file of random messages; channels are announced when their first message comes."""
    out = io.BytesIO()
    writer = Writer(
        out,
        chunk_size=shape.chunk_size,
        compression=shape.compression,
        index_types=shape.index_types,
        **options,
    )
    writer.start(profile="ros2")
    rng = np.random.default_rng(len(shape.channels))
    ids: dict[int, int] = {}
    for k, (channel, size) in enumerate(zip(shape.channels, shape.sizes, strict=True)):
        wanted = [channel] if late_channels else range(N_CHANNELS)
        for number in wanted:
            if number not in ids:
                schema = writer.register_schema(f"t{number}", "ros2msg", b"float64 x")
                ids[number] = writer.register_channel(f"/{number}", "cdr", schema)
        writer.add_message(ids[channel], 1000 - k, rng.bytes(size), k, 7 * k)
    writer.finish()
    return out.getvalue()


def _walked(path: Path, channels: set[int]) -> list[Message]:
    return [r for r in walk(path, channels=channels) if isinstance(r, Message)]


def _read(path: Path, info: McapInfo, channels: set[int]) -> list[Message]:
    return [
        Message(*numbers, block.messages[k])
        for block in read_blocks(path, info, channels)
        for k, numbers in enumerate(
            zip(
                block.channels.tolist(),
                block.sequences.tolist(),
                block.log_times_ns.tolist(),
                block.publish_times_ns.tolist(),
                strict=True,
            )
        )
    ]


@in_one_folder
@given(shape=_shapes, wanted=st.sets(st.integers(1, N_CHANNELS)), late=st.booleans())
def test_blocks_are_what_the_walk_finds(
    tmp_path: Path, shape: _Shape, wanted: set[int], late: bool
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(_file(shape, late_channels=late))
    assert _read(path, read_info(path), wanted) == _walked(path, wanted)


@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"use_statistics": False}, {"enable_crcs": False}]
)
def test_blocks_are_read_from_files_without_chunks_statistics_or_checksums(
    tmp_path: Path, options: dict[str, Any]
) -> None:
    shape = _Shape([0, 1, 0, 2, 1] * 4, [9] * 20, 100, CompressionType.ZSTD, IndexType.ALL)
    path = tmp_path / "a.mcap"
    path.write_bytes(_file(shape, **options))
    found = _read(path, read_info(path), {1, 3})
    assert found == _walked(path, {1, 3})
    assert len(found) == 12


def test_blocks_end_after_many_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("curation_ros.bags.mcap_blocks._BLOCK_BYTES", 500)
    monkeypatch.setattr("curation_ros.bags.mcap_blocks._SMALL_BYTES", 100)
    path = tmp_path / "a.mcap"
    for index_types in (IndexType.ALL, IndexType.NONE):
        shape = _Shape([0, 1] * 30, [20] * 60, 200, CompressionType.LZ4, index_types)
        path.write_bytes(_file(shape))
        info = read_info(path)
        assert len(list(read_blocks(path, info, {1, 2}))) >= 3
        assert _read(path, info, {1, 2}) == _walked(path, {1, 2})


def test_small_messages_do_not_keep_the_large_ones_beside_them(tmp_path: Path) -> None:
    sizes = [10, 5000] * 20
    shape = _Shape([0, 1] * 20, sizes, 1 << 20, CompressionType.ZSTD, IndexType.ALL)
    path = tmp_path / "a.mcap"
    path.write_bytes(_file(shape))
    [block] = read_blocks(path, read_info(path), {1})
    assert len(block.messages.buffer) == 200
    assert _read(path, read_info(path), {1}) == _walked(path, {1})


def test_a_file_that_shrinks_after_it_was_opened_is_an_error(tmp_path: Path) -> None:
    shape = _Shape([0, 1] * 30, [20] * 60, 200, CompressionType.NONE, IndexType.ALL)
    path = tmp_path / "a.mcap"
    whole = _file(shape)
    path.write_bytes(whole)
    info = read_info(path)
    for cut in range(0, info.data_end, 41):
        path.write_bytes(whole[:cut])
        with pytest.raises(BagError):
            _read(path, info, {1})


# --- indexes that lie ---------------------------------------------------------------------------


def _records(raw: bytes | bytearray, at: int, stop: int) -> list[tuple[int, int, int]]:
    """(opcode, first byte of the body, length) of the records in a range of bytes."""
    found = []
    while at < stop:
        opcode, length = _HEAD.unpack_from(raw, at)
        found.append((opcode, at + _HEAD.size, length))
        at += _HEAD.size + length
    return found


def _summary_start(raw: bytes | bytearray) -> int:
    return int(struct.unpack_from("<Q", raw, len(raw) - len(MAGIC) - 20)[0])


def _mended(raw: bytearray) -> bytes:
    """With the checksum of the summary as it should be after a change."""
    crc_at = len(raw) - len(MAGIC) - 4
    raw[crc_at : crc_at + 4] = struct.pack("<I", zlib.crc32(raw[_summary_start(raw) : crc_at]))
    return bytes(raw)


def _outcome(path: Path, wanted: set[int]) -> list[Message] | str:
    try:
        return _read(path, read_info(path), wanted)
    except BagError as err:
        return str(err)


def _check(path: Path, raw: bytes, wanted: set[int], truth: list[Message]) -> str:
    path.write_bytes(raw)
    outcome = _outcome(path, wanted)
    if isinstance(outcome, str):
        assert "\n" not in outcome
        return "refused"
    assert outcome == truth
    return "read"


@in_one_folder
@given(data=st.data(), wanted=st.sets(st.integers(1, N_CHANNELS), min_size=1))
@pytest.mark.parametrize("kind", [Opcode.MESSAGE_INDEX, Opcode.CHUNK_INDEX])
def test_a_damaged_index_never_changes_what_is_read(
    tmp_path: Path, kind: int, data: st.DataObject, wanted: set[int]
) -> None:
    shape = _Shape([0, 1, 2, 0, 1] * 5, list(range(25)), 200, CompressionType.ZSTD, IndexType.ALL)
    whole = _file(shape)
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    truth = _walked(path, wanted)
    start = len(MAGIC) if kind == Opcode.MESSAGE_INDEX else _summary_start(whole)
    stop = _summary_start(whole) if kind == Opcode.MESSAGE_INDEX else len(whole) - len(MAGIC)
    places = [x for x in _records(whole, start, stop) if x[0] == kind]
    raw = bytearray(whole)
    for _ in range(data.draw(st.integers(1, 3))):
        _, at, length = data.draw(st.sampled_from(places))
        byte = at + data.draw(st.integers(0, length - 1))
        raw[byte] = data.draw(st.sampled_from([0, 1, 2, 3, 16, 31, 255, raw[byte] ^ 8]))
    _check(path, _mended(raw), wanted, truth)


def _entries(raw: bytes) -> list[tuple[int, int, list[tuple[int, int]]]]:
    """(first byte of entries, channel, entries) of the message indexes of a file."""
    found = []
    for opcode, at, length in _records(raw, len(MAGIC), _summary_start(raw)):
        if opcode == Opcode.MESSAGE_INDEX:
            channel, size = struct.unpack_from("<HI", raw, at)
            assert size == length - 6
            entries = list(struct.iter_unpack("<QQ", raw[at + 6 : at + 6 + size]))
            found.append((at + 6, channel, entries))
    return found


def test_indexes_with_wrong_offsets_or_channels_cost_nothing_but_time(tmp_path: Path) -> None:
    shape = _Shape([0, 1, 2] * 9, [30] * 27, 400, CompressionType.NONE, IndexType.ALL)
    whole = _file(shape, late_channels=False)
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    truth = {1: _walked(path, {1}), 2: _walked(path, {1, 2, 3})}
    seen = set()
    for at, _, entries in _entries(whole):
        lies = [
            [(t, offset + 1) for t, offset in entries],
            [(t, 1 << 63) for t, _ in entries],
            [(t, 1 << 40) for t, _ in entries],
            [(0, offset) for _, offset in entries],
            entries[::-1],
            [entries[0]] * len(entries),
        ]
        changes = [(at, b"".join(struct.pack("<QQ", *x) for x in lie)) for lie in lies]
        changes += [(at - 6, struct.pack("<H", channel)) for channel in (1, 2, 3, 77)]
        for place, bytes_ in changes:
            raw = bytearray(whole)
            raw[place : place + len(bytes_)] = bytes_
            for wanted, expected in (({1}, truth[1]), ({1, 2, 3}, truth[2])):
                seen.add(_check(path, bytes(raw), wanted, expected))
    assert seen == {"read"}


def test_messages_that_two_indexes_swap_between_chunks_are_not_lost_in_silence(
    tmp_path: Path,
) -> None:
    # Two chunks with one channel each; each index claims the channel of the other, so that the
    # sums are right, and whoever wants one channel would skip the chunk that has it.
    shape = _Shape([0] * 6 + [1] * 6, [40] * 12, 400, CompressionType.NONE, IndexType.ALL)
    whole = _file(shape)
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    truth = _walked(path, {1})
    raw = bytearray(whole)
    for at, channel, _ in _entries(whole):
        raw[at - 6 : at - 4] = struct.pack("<H", {1: 2, 2: 1}[channel])
    path.write_bytes(bytes(raw))
    assert len(truth) == 6
    assert _read(path, read_info(path), {1, 2}) == _walked(path, {1, 2})
    with pytest.raises(TornFileError, match="contradict each other"):
        _read(path, read_info(path), {1})


def test_records_inside_the_data_of_a_message_are_no_messages(tmp_path: Path) -> None:
    fake = _HEAD.pack(Opcode.MESSAGE, 22 + 4) + struct.pack("<HIQQ", 1, 666, 6, 6) + b"fake"
    out = io.BytesIO()
    writer = Writer(out, compression=CompressionType.NONE)
    writer.start(profile="ros2")
    schema = writer.register_schema("t", "ros2msg", b"float64 x")
    channel = writer.register_channel("/a", "cdr", schema)
    for k in range(3):
        writer.add_message(channel, k, fake + bytes(9), k, k)
    writer.finish()
    whole = out.getvalue()
    path = tmp_path / "a.mcap"
    path.write_bytes(whole)
    truth = _walked(path, {1})
    [(at, _, entries)] = _entries(whole)
    raw = bytearray(whole)
    for k, (time_ns, offset) in enumerate(entries):
        raw[at + 16 * k : at + 16 * k + 16] = struct.pack("<QQ", time_ns, offset + 31)
    assert _check(path, bytes(raw), {1}, truth) == "read"
    assert [m.sequence for m in truth] == [0, 1, 2]


def test_messages_outside_the_chunks_are_read_in_their_place(tmp_path: Path) -> None:
    shape = _Shape([0, 1] * 6, [10] * 12, 100, CompressionType.ZSTD, IndexType.ALL)
    whole = _file(shape, late_channels=False)
    plain = _HEAD.pack(Opcode.MESSAGE, 22 + 3) + struct.pack("<HIQQ", 1, 99, 1, 1) + b"out"
    records = _records(whole, len(MAGIC), _summary_start(whole))
    cut = next(at for opcode, at, _ in records if opcode == Opcode.CHUNK) - _HEAD.size
    # What follows moves, so that the index of the chunks is wrong as well.
    raw = bytearray(whole[:cut] + plain + whole[cut:])
    at = len(raw) - len(MAGIC) - 20
    starts = [x + len(plain) if x else 0 for x in struct.unpack_from("<QQ", raw, at)]
    raw[at : at + 16] = struct.pack("<QQ", *starts)
    path = tmp_path / "a.mcap"
    path.write_bytes(_mended(raw))
    with pytest.raises(TornFileError, match="statistics"):
        _read(path, read_info(path), {1})
    for opcode, at, _ in _records(raw, _summary_start(raw), len(raw) - len(MAGIC)):
        if opcode == Opcode.STATISTICS:
            raw[at] += 1  # all messages
            assert struct.unpack_from("<HQ", raw, at + 46) == (1, 6)
            raw[at + 48] += 1  # those of channel 1
    path.write_bytes(_mended(raw))
    found = _read(path, read_info(path), {1})
    assert found == _walked(path, {1})
    assert (found[0].sequence, len(found)) == (99, 7)
