"""Values out of CDR bytes: message by message, or a whole column of messages in one pass.

A walk over a message, driven by its definition, finds where every value lies. `read_message` and
irregular messages use it directly. For other messages one walk serves many. Its structural bytes
are the encapsulation, the lengths, the terminators, and the names that were looked up. Messages
of the same length with the same structural bytes have every value at the same place, and NumPy
reads the values of all of them as strided columns.

A layout that was found is kept for the next block, and by `shared_decoder` for the next bag. Where
texts vary in length there are too many layouts. Then `cdr_columns` walks over all messages at
once.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from curation_ros.bags.cdr_columns import ColumnWalk, IrregularError
from curation_ros.bags.cdr_layout import Layout, padded_width
from curation_ros.bags.cdr_paths import ValuePath, resolve_path
from curation_ros.bags.cdr_walk import Walk, least_sizes
from curation_ros.bags.definitions import Definitions, full_type_name, parse_definition
from curation_ros.bags.schemas import message_schema
from curation_ros.core.episode.stream import Columns, Messages, rows_at
from curation_ros.core.errors import EpisodeError

_HEADER_TYPE = "std_msgs/msg/Header"

# Bytes that one vectorised pass copies at most (they stay in the cache of a processor), and
# layouts that are kept or tried.
_BLOCK_BYTES = 256 << 10
_MAX_LAYOUTS = 8
_MAX_CACHED = 512


class CdrDecoder:
    """Decodes CDR (XCDR1, either byte order), as `curation_ros.core.episode.stream.Decoder` asks.

    Bytes after the last member are ignored: Fast-CDR pads there.
    """

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        """Make a decoder.

        Args:
            definitions: message type -> `ros2msg` text of a bag's schema records. Installed
                definitions serve for all other types.
        """
        self._texts = {full_type_name(k): v for k, v in (definitions or {}).items()}
        self._walks: dict[str, tuple[Walk, Definitions]] = {}
        self._paths: dict[tuple[str, str], ValuePath] = {}
        self._layouts: dict[tuple[str, tuple[str, ...], int], list[Layout]] = {}
        self._n_layouts: dict[tuple[str, tuple[str, ...]], int] = {}

    def has_header(self, type_name: str) -> bool:
        """Whether the type begins with a std_msgs/Header.

        Raises:
            BagError: if the type has no definition here.
        """
        walk, definitions = self._walk(type_name)
        fields = definitions[walk.type_name]
        return bool(fields) and fields[0].base == _HEADER_TYPE and fields[0].kind == "one"

    def read_message(self, type_name: str, data: bytes) -> dict[str, Any]:
        """Decode a whole message.

        Returns:
            Member -> number, boolean, text, nested dict, list, or NumPy array for lists of
            numbers and booleans.

        Raises:
            EpisodeError: if the bytes do not fit the type.
            BagError: if the type has no definition here.
        """
        walk = copy.copy(self._walk(type_name)[0])
        values: dict[str, Any] = walk.values(walk.run(data))
        return values

    def decode(
        self, type_name: str, paths: Sequence[str], messages: Sequence[bytes]
    ) -> list[npt.NDArray[np.generic]]:
        """Read the values at `paths` from every message.

        Args:
            type_name: type of all messages.
            paths: as in FieldSpec.values. Integers beyond 2**53 lose digits.
            messages: CDR bytes with their encapsulation.

        Returns:
            One (len(messages),) array per path: float64, or unicode for texts.

        Raises:
            EpisodeError: if a message does not fit the type, or lacks the element or name of a
                path; of several messages the first.
            ConfigError: if the type has no such path.
            BagError: if the type has no definition here.
        """
        columns = self.decode_block(type_name, paths, Messages.joined(messages))
        if columns.bad:
            raise columns.bad[min(columns.bad)]
        values = np.ascontiguousarray(columns.values.T)
        return [columns.texts.get(k, values[k]) for k in range(len(paths))]

    def decode_block(self, type_name: str, paths: Sequence[str], messages: Messages) -> Columns:
        """Read the values at `paths` from every message; bad messages do not spoil the others.

        Args:
            type_name: type of all messages.
            paths: as in FieldSpec.values. Integers beyond 2**53 lose digits.
            messages: CDR bytes with their encapsulation.

        Raises:
            ConfigError: if the type has no such path.
            BagError: if the type has no definition here.
        """
        job = _Job(self, type_name, [self._path(type_name, path) for path in paths], messages)
        sizes = messages.sizes
        if not len(messages):
            return job.columns()
        rows: npt.NDArray[np.int64] = np.arange(len(sizes))
        key = (type_name, tuple(paths))
        if min(len(rows), self._n_layouts.get(key, 0)) > _MAX_LAYOUTS:
            rows = job.decode_together()
        if (sizes == sizes[0]).all():
            groups = [rows]
        else:
            by_size = rows[np.argsort(sizes[rows], kind="stable")]
            groups = np.split(by_size, np.flatnonzero(np.diff(sizes[by_size])) + 1)
        for group in groups:
            if len(group):
                length = int(sizes[group[0]])
                step = max(1, _BLOCK_BYTES // max(length, 1))
                for start in range(0, len(group), step):
                    job.decode(length, group[start : start + step])
        self._n_layouts[key] = self._n_layouts.get(key, 0) + job.n_learned
        return job.columns()

    def start(
        self, type_name: str, paths: Sequence[ValuePath], length: int
    ) -> tuple[Walk, list[Layout]]:
        """A general walk of a type, and the layouts that messages of a length have had so far."""
        if len(self._layouts) > _MAX_CACHED:
            self._layouts.clear()
        key = (type_name, tuple([path.text for path in paths]), length)
        # A copy: a walk has a position, and threads may share a decoder.
        return copy.copy(self._walk(type_name)[0]), self._layouts.setdefault(key, [])

    def _walk(self, type_name: str) -> tuple[Walk, Definitions]:
        known = self._walks.get(type_name)
        if known is None:
            name = full_type_name(type_name)
            own = self._texts.get(name)
            text = own if own is not None else message_schema(name).text
            definitions = parse_definition(name, text, lambda t: message_schema(t).text)
            known = (Walk(name, definitions, least_sizes(definitions)), definitions)
            self._walks[type_name] = known
        return known

    def _path(self, type_name: str, path: str) -> ValuePath:
        known = self._paths.get((type_name, path))
        if known is None:
            walk, definitions = self._walk(type_name)
            known = resolve_path(walk.type_name, definitions, path)
            self._paths[type_name, path] = known
        return known


def shared_decoder(definitions: Mapping[str, str]) -> CdrDecoder:
    """The decoder of this process for a set of definitions, with all the layouts it has learned.

    Args:
        definitions: as `CdrDecoder` takes them.
    """
    return _shared(frozenset(definitions.items()))


@functools.lru_cache(maxsize=64)
def _shared(definitions: frozenset[tuple[str, str]]) -> CdrDecoder:
    return CdrDecoder(dict(definitions))


class _Job:
    """One block of messages on its way to columns."""

    def __init__(
        self, decoder: CdrDecoder, type_name: str, paths: Sequence[ValuePath], messages: Messages
    ) -> None:
        self._decoder = decoder
        self._type_name = type_name
        self._paths = paths
        self._messages = messages
        self._values = np.full((len(messages), len(paths)), np.nan)
        # Column -> rows and their texts, part by part.
        self._texts: dict[int, list[tuple[npt.NDArray[np.int64], npt.NDArray[np.str_]]]] = {
            k: [] for k, path in enumerate(paths) if path.is_text
        }
        self._bad: dict[int, EpisodeError] = {}
        self.n_learned = 0

    def decode_together(self) -> npt.NDArray[np.int64]:
        """Read all messages in one walk, and return the rows of those that it does not accept."""
        walk, _ = self._decoder.start(self._type_name, self._paths, 0)
        together = ColumnWalk(walk, self._messages)
        try:
            tree = together.run()
            found = [together.find(tree, path) for path in self._paths]
            texts = {k: together.texts(found[k]) for k in self._texts}
        except IrregularError:
            return np.arange(len(self._messages))
        fits = together.fits
        rows = np.flatnonzero(fits)
        for column, leaves in enumerate(found):
            if column in texts:
                self._texts[column].append((rows, self._unicode(texts[column][fits], rows)))
            else:
                self._values[rows, column] = together.numbers(leaves)[fits]
        return np.flatnonzero(~fits)

    def columns(self) -> Columns:
        return Columns(
            self._values,
            {k: self._column_of(parts) for k, parts in self._texts.items()},
            self._bad,
        )

    def _column_of(
        self, parts: Sequence[tuple[npt.NDArray[np.int64], npt.NDArray[np.str_]]]
    ) -> npt.NDArray[np.str_]:
        width = max((texts.dtype.itemsize // 4 for _, texts in parts), default=1)
        column = np.zeros(len(self._messages), dtype=f"U{max(width, 1)}")
        for rows, texts in parts:
            column[rows] = texts
        return column

    def decode(self, length: int, rows: npt.NDArray[np.int64]) -> None:
        """Read messages of one length: as blocks of known layouts, and the rest one by one."""
        walk, layouts = self._decoder.start(self._type_name, self._paths, length)
        block = self._gather(rows, length)
        for layout in tuple(layouts):
            rows, block = self._read_alike(layout, block, rows)
            if not len(rows):
                return
        learned: list[Layout] = []
        faults = 0
        while len(rows) and max(len(learned), faults) < _MAX_LAYOUTS:
            try:
                tree = walk.run(self._messages[int(rows[0])])
                layout = Layout(walk, [walk.find(tree, path) for path in self._paths])
            except EpisodeError as err:
                self._bad[int(rows[0])] = err
                rows, block = rows[1:], block[1:]
                faults += 1
                continue
            learned.append(layout)
            rows, block = self._read_alike(layout, block, rows)
        layouts[:] = [*learned, *layouts][:_MAX_LAYOUTS]
        self.n_learned += len(learned)
        for row in rows.tolist():
            self._read_one(walk, row)

    def _gather(self, rows: npt.NDArray[np.int64], length: int) -> npt.NDArray[np.uint8]:
        """(n, width) bytes of messages of one length."""
        width = padded_width(length)
        if not width:
            return np.empty((len(rows), 0), dtype=np.uint8)
        buffer, starts = self._messages.buffer, self._messages.starts[rows]
        if int(starts.max()) + width > len(buffer):
            buffer = np.concatenate([buffer, np.zeros(width - length, dtype=np.uint8)])
        return rows_at(buffer, starts, width)

    def _read_alike(
        self, layout: Layout, block: npt.NDArray[np.uint8], rows: npt.NDArray[np.int64]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
        """Read those messages of a block that have a layout, and return the others."""
        differing = layout.differing(block)
        if differing is None:
            self._read_block(layout, block, rows)
            return rows[:0], block[:0]
        alike = ~differing
        if alike.any():
            self._read_block(layout, block[alike], rows[alike])
            rows, block = rows[differing], block[differing]
        return rows, block

    def _read_block(
        self, layout: Layout, block: npt.NDArray[np.uint8], rows: npt.NDArray[np.int64]
    ) -> None:
        whole = len(rows) == len(self._messages)
        for run in layout.runs:
            values = layout.numbers(block, run)
            columns = slice(run.column, run.column + run.n_columns)
            if whole:
                self._values[:, columns] = values
            else:
                self._values[rows, columns] = values
        for column, leaf in layout.texts:
            if leaf.code == "w":
                walk, _ = self._decoder.start(self._type_name, self._paths, 0)
                for row in rows.tolist():
                    self._read_one(walk, row)
                return
            self._texts[column].append((rows, self._unicode(layout.text(block, leaf), rows)))

    def _unicode(
        self, raw: npt.NDArray[np.bytes_], rows: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.str_]:
        codes = np.ascontiguousarray(raw).view(np.uint8).reshape(len(raw), raw.itemsize)
        if (codes < 0x80).all():  # ASCII: NumPy's own conversion takes ten times as long
            texts: npt.NDArray[np.str_] = codes.astype(np.uint32).view(f"U{codes.shape[1]}")
            return texts[:, 0]
        out = []
        for row, word in zip(rows.tolist(), raw.tolist(), strict=True):
            try:
                out.append(word.decode())
            except UnicodeDecodeError:
                out.append("")
                fault = (
                    f"message of type {self._type_name} is malformed: {word!r:.60} is not UTF-8"
                )
                self._bad.setdefault(row, EpisodeError(fault))
        return np.array(out, dtype=np.str_)

    def _read_one(self, walk: Walk, row: int) -> None:
        try:
            tree = walk.run(self._messages[row])
            values = [walk.value(walk.find(tree, path)) for path in self._paths]
        except EpisodeError as err:
            self._bad[row] = err
            return
        for column, value in enumerate(values):
            if column in self._texts:
                self._texts[column].append((np.array([row]), np.array([value], dtype=np.str_)))
            else:
                self._values[row, column] = value
