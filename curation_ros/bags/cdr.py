"""Values out of CDR bytes: message by message, or a whole column of messages in one pass.

One walk over a message, driven by its definition, finds where every value lies. `read_message`
and irregular messages use it directly. For the rest the walk is done once: messages of the same
length whose structural bytes (encapsulation, lengths, terminators, names that were looked up)
equal those of a walked message have every value at the same place, so that NumPy can read the
values of all of them as strided columns. What such a walk has found is kept for the next block,
and `shared_decoder` keeps it for the next bag.
"""

from __future__ import annotations

import copy
import functools
import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from curation_ros.bags.definitions import (
    PRIMITIVES,
    TEXTS,
    Definitions,
    Field,
    full_type_name,
    parse_definition,
)
from curation_ros.bags.schemas import message_schema
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.stream import Columns, Messages, rows_at

_HEADER_TYPE = "std_msgs/msg/Header"
_TEXT_CODES = frozenset(TEXTS.values())
_SIZES = {code: struct.calcsize(f"={code}") for code in PRIMITIVES.values()}
#: Members that may name the elements of a list of numbers beside them.
_NAME_LISTS = ("name", "joint_names")

# Bytes that one vectorised pass copies at most, and layouts that are kept or tried.
_BLOCK_BYTES = 16 << 20
_MAX_LAYOUTS = 8
_MAX_CACHED = 512


class _Leaf(NamedTuple):
    """Where a value lies: `code` of definitions.py, first byte, number of elements or -1."""

    code: str
    at: int
    length: int = -1


_Node: TypeAlias = _Leaf | dict[str, Any] | list[Any]


class _Named(NamedTuple):
    """Step to the element that a parallel list of names calls `wanted`."""

    names: str
    wanted: str


class _Keyed(NamedTuple):
    """Step to the `value` of the element whose `key` is `wanted`."""

    wanted: str


_Step: TypeAlias = str | int | _Named | _Keyed


class _Path(NamedTuple):
    text: str
    steps: tuple[_Step, ...]
    is_text: bool


class _Walk:
    """Where every value of one message lies; bounds are checked before anything is trusted."""

    def __init__(self, type_name: str, definitions: Definitions, sizes: dict[str, int]) -> None:
        self.type_name = type_name
        self._definitions = definitions
        self._sizes = sizes

    def run(self, data: bytes) -> dict[str, Any]:
        """Walk over a message.

        Returns:
            Members -> leaf, members of a nested message, or list of elements. `structure` then
            holds the ranges of bytes that the layout depends on, `order` the byte order.
        """
        if len(data) < 4 or data[0] != 0 or data[1] > 1:
            found = data[:2].hex() if len(data) >= 4 else f"{len(data)} bytes"
            raise self._fault(f"expected the CDR encapsulation 0000 or 0001, found {found}")
        self.data = data
        self.order = "<" if data[1] else ">"
        self._length_word = struct.Struct(f"{self.order}I")
        self.structure: list[tuple[int, int]] = [(0, 2)]
        self._at = 4
        self._require(1, self._sizes[self.type_name], "the shortest message of its type")
        return self._members(self.type_name)

    def _fault(self, what: str) -> EpisodeError:
        return EpisodeError(f"message of type {self.type_name} is malformed: {what}")

    def _require(self, count: int, size: int, what: str) -> None:
        left = len(self.data) - self._at
        if count * size > left:
            raise self._fault(
                f"{what} at byte {self._at} needs {count * size} bytes, {left} of "
                f"{len(self.data)} are left"
            )

    def _align(self, size: int) -> None:
        self._at += -(self._at - 4) % size

    def _members(self, type_name: str) -> dict[str, Any]:
        fields = self._definitions[type_name]
        if not fields:
            # A message without members has one byte on the wire, as C structs must.
            self._require(1, 1, type_name)
            self._at += 1
        return {field.name: self._member(field) for field in fields}

    def _member(self, field: Field) -> _Node:
        if field.kind == "one":
            return self._one(field)
        count = field.size
        if field.kind == "sequence":
            count = self._length(field.name)
            if field.size and count > field.size:
                raise self._fault(f"{field.name!r} has {count} elements, at most {field.size}")
        self._require(count, self._sizes[field.base], f"{field.name!r} with {count} elements")
        code = PRIMITIVES.get(field.base)
        if code is None:
            return [self._one(field) for _ in range(count)]
        if count:
            self._align(_SIZES[code])
            self._require(count, _SIZES[code], f"{field.name!r} with {count} elements")
        leaf = _Leaf(code, self._at, count)
        self._at += count * _SIZES[code]
        return leaf

    def _one(self, field: Field) -> _Node:
        code = PRIMITIVES.get(field.base)
        if code is not None:
            size = _SIZES[code]
            self._align(size)
            self._require(1, size, repr(field.name))
            leaf = _Leaf(code, self._at)
            self._at += size
            return leaf
        if field.base in TEXTS:
            return self._text(field)
        return self._members(field.base)

    def _length(self, name: str) -> int:
        self._align(4)
        self._require(1, 4, f"the length of {name!r}")
        count: int = self._length_word.unpack_from(self.data, self._at)[0]
        self.structure.append((self._at, self._at + 4))
        self._at += 4
        return count

    def _text(self, field: Field) -> _Leaf:
        count = self._length(field.name)
        # rmw_fastrtps writes a wide string as that many 32-bit words without a terminator.
        wide = field.base == "wstring"
        self._require(count, 4 if wide else 1, f"the text {field.name!r}")
        start = self._at
        self._at += count * (4 if wide else 1)
        if not wide and count:
            count -= 1
            if self.data[start + count]:
                raise self._fault(f"the text {field.name!r} at byte {start} has no terminator")
            self.structure.append((start + count, start + count + 1))
        if field.text_bound and count > field.text_bound:
            raise self._fault(f"the text {field.name!r} has {count} of {field.text_bound} bytes")
        return _Leaf(TEXTS[field.base], start, count)

    def value(self, leaf: _Leaf) -> Any:
        """The number, boolean or text at a leaf; an array for a list of numbers."""
        if leaf.code == "s":
            try:
                return self.data[leaf.at : leaf.at + leaf.length].decode()
            except UnicodeDecodeError as err:
                raise self._fault(f"the text at byte {leaf.at} is not UTF-8") from err
        if leaf.code == "w":
            words = np.frombuffer(self.data, f"{self.order}u4", leaf.length, leaf.at)
            if (words > 0xFFFF).any():
                raise self._fault(f"the wide text at byte {leaf.at} has a word above 0xffff")
            try:
                return words.astype("<u2").tobytes().decode("utf-16-le")
            except UnicodeDecodeError as err:
                raise self._fault(f"the wide text at byte {leaf.at} is not UTF-16") from err
        if leaf.length < 0:
            return struct.unpack_from(self.order + leaf.code, self.data, leaf.at)[0]
        code = "u1" if leaf.code == "?" else self.order + leaf.code
        values = np.frombuffer(self.data, code, leaf.length, leaf.at)
        return values != 0 if leaf.code == "?" else values.astype(values.dtype.newbyteorder("="))

    def values(self, node: _Node) -> Any:
        """A node as nested plain values."""
        if isinstance(node, _Leaf):
            return self.value(node)
        if isinstance(node, dict):
            return {name: self.values(child) for name, child in node.items()}
        return [self.values(child) for child in node]

    def find(self, tree: dict[str, Any], path: _Path) -> _Leaf:
        """The leaf that a path leads to; names that were looked up become structural."""
        node: Any = tree
        parent: dict[str, Any] = tree
        for step in path.steps:
            if isinstance(step, str):
                parent, node = node, node[step]
            elif isinstance(step, _Keyed):
                keys = [element["key"] for element in node]
                node = node[self._lookup(keys, step.wanted, path)]["value"]
            else:
                index = (
                    self._lookup(parent[step.names], step.wanted, path)
                    if isinstance(step, _Named)
                    else step
                )
                count = node.length if isinstance(node, _Leaf) else len(node)
                if index >= count:
                    raise EpisodeError(
                        f"message of type {self.type_name}: path {path.text!r} means element "
                        f"{index}, but there are {count}"
                    )
                if isinstance(node, _Leaf):
                    node = _Leaf(node.code, node.at + index * _SIZES[node.code])
                else:
                    node = node[index]
        leaf: _Leaf = node
        return leaf

    def _lookup(self, names: Sequence[_Leaf], wanted: str, path: _Path) -> int:
        texts = [self.data[leaf.at : leaf.at + leaf.length] for leaf in names]
        self.structure += [(leaf.at, leaf.at + leaf.length) for leaf in names]
        found = [i for i, text in enumerate(texts) if text == wanted.encode()]
        if len(found) == 1:
            return found[0]
        known = ", ".join(sorted(t.decode(errors="replace") for t in texts)[:20]) or "no names"
        raise EpisodeError(
            f"message of type {self.type_name}: path {path.text!r}: expected {wanted!r} once, "
            f"found it {len(found)} times among {known:.300}"
        )


class _Run(NamedTuple):
    """Numbers that lie side by side, for columns that stand side by side."""

    code: str
    at: int
    column: int
    n_columns: int


class _Layout:
    """What one walked message says about all that look alike.

    Blocks of messages are (n, width) bytes, `width` the length rounded up to whole words.
    """

    def __init__(self, walk: _Walk, leaves: Sequence[_Leaf]) -> None:
        self.order = walk.order
        length = len(walk.data)
        mask = np.zeros(_width(length), dtype=np.uint8)
        for start, stop in walk.structure:
            mask[start:stop] = 0xFF
        expected = np.zeros(_width(length), dtype=np.uint8)
        expected[:length] = np.frombuffer(walk.data, np.uint8)
        self._mask = mask.view(np.uint64)
        self._expected = expected.view(np.uint64)
        self.runs: list[_Run] = []
        self.texts: list[tuple[int, _Leaf]] = []
        for column, leaf in enumerate(leaves):
            if leaf.code in _TEXT_CODES:
                self.texts.append((column, leaf))
                continue
            last = self.runs[-1] if self.runs else _Run("", -1, -1, 0)
            follows = (leaf.code, leaf.at, column) == (
                last.code,
                last.at + last.n_columns * _SIZES.get(last.code, 0),
                last.column + last.n_columns,
            )
            if follows:
                self.runs[-1] = last._replace(n_columns=last.n_columns + 1)
            else:
                self.runs.append(_Run(leaf.code, leaf.at, column, 1))

    def differing(self, block: npt.NDArray[np.uint8]) -> npt.NDArray[np.bool_] | None:
        """(n,) which messages of a block have another layout; None: none has."""
        wrong = (block.view(np.uint64) ^ self._expected) & self._mask
        if not wrong.any():
            return None
        return np.asarray(wrong.any(axis=1))

    def numbers(self, block: npt.NDArray[np.uint8], run: _Run) -> npt.NDArray[np.generic]:
        """(n, n_columns) values of a run, of their own type, in a view of the block."""
        code = "u1" if run.code == "?" else self.order + run.code
        shape, strides = (len(block), run.n_columns), (block.shape[1], _SIZES[run.code])
        values: npt.NDArray[np.generic] = np.ndarray(shape, code, block, run.at, strides)
        return values != 0 if run.code == "?" else values

    @staticmethod
    def text(block: npt.NDArray[np.uint8], leaf: _Leaf) -> npt.NDArray[np.bytes_]:
        """(n,) UTF-8 bytes at a leaf, in a view of the block."""
        if not leaf.length:
            return np.zeros(len(block), dtype="S1")
        strides = (block.shape[1],)
        texts: npt.NDArray[np.bytes_] = np.ndarray(
            (len(block),), f"S{leaf.length}", block, leaf.at, strides
        )
        return texts


def _width(length: int) -> int:
    """Length of a message in whole words of 8 bytes."""
    return -(-length // 8) * 8


class CdrDecoder:
    """Decodes CDR (XCDR1, either byte order), as `curation_ros.core.stream.Decoder` asks.

    Bytes after the last member are ignored: Fast-CDR pads there.
    """

    def __init__(self, definitions: Mapping[str, str] | None = None) -> None:
        """Make a decoder.

        Args:
            definitions: message type -> `ros2msg` text of a bag's schema records. They win over
                what is installed, which serves for all other types.
        """
        self._texts = {full_type_name(k): v for k, v in (definitions or {}).items()}
        self._walks: dict[str, tuple[_Walk, Definitions]] = {}
        self._paths: dict[tuple[str, str], _Path] = {}
        self._layouts: dict[tuple[str, tuple[str, ...], int], list[_Layout]] = {}

    def has_header(self, type_name: str) -> bool:
        """Whether the type begins with a std_msgs/Header.

        Raises:
            BagError: if the type has no definition here.
        """
        walk, definitions = self._walk(type_name)
        fields = definitions[walk.type_name]
        return bool(fields) and fields[0].base == _HEADER_TYPE and fields[0].kind == "one"

    def check_path(self, type_name: str, path: str) -> None:
        """Check a path of a topic map against a type.

        Raises:
            ConfigError: if the type has no such value, naming what it has.
            BagError: if the type has no definition here.
        """
        self._path(type_name, path)

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
            One (len(messages),) array a path: float64, or unicode for texts.

        Raises:
            EpisodeError: if a message does not fit the type, or lacks the element or name that a
                path asks for; of several the first.
            ConfigError: if the type has no such path.
            BagError: if the type has no definition here.
        """
        columns = self.decode_block(type_name, paths, Messages.joined(messages))
        if columns.bad:
            raise columns.bad[min(columns.bad)]
        values = np.ascontiguousarray(columns.values.T)
        return [columns.texts.get(k, values[k]) for k in range(len(paths))]

    def decode_block(self, type_name: str, paths: Sequence[str], messages: Messages) -> Columns:
        """Read the values at `paths` from every message, whatever is wrong with others.

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
        if (sizes == sizes[0]).all():
            groups = [np.arange(len(sizes))]
        else:
            by_size = np.argsort(sizes, kind="stable")
            groups = np.split(by_size, np.flatnonzero(np.diff(sizes[by_size])) + 1)
        for rows in groups:
            length = int(sizes[rows[0]])
            step = max(1, _BLOCK_BYTES // max(length, 1))
            for start in range(0, len(rows), step):
                job.decode(length, rows[start : start + step])
        return job.columns()

    def start(
        self, type_name: str, paths: Sequence[_Path], length: int
    ) -> tuple[_Walk, list[_Layout]]:
        """A general walk of a type, and the layouts that messages of a length have had so far."""
        if len(self._layouts) > _MAX_CACHED:
            self._layouts.clear()
        key = (type_name, tuple([path.text for path in paths]), length)
        # A copy: a walk remembers where it is, and threads may share a decoder.
        return copy.copy(self._walk(type_name)[0]), self._layouts.setdefault(key, [])

    def _walk(self, type_name: str) -> tuple[_Walk, Definitions]:
        known = self._walks.get(type_name)
        if known is None:
            name = full_type_name(type_name)
            own = self._texts.get(name)
            text = own if own is not None else message_schema(name).text
            definitions = parse_definition(name, text, lambda t: message_schema(t).text)
            known = (_Walk(name, definitions, _least_sizes(definitions)), definitions)
            self._walks[type_name] = known
        return known

    def _path(self, type_name: str, path: str) -> _Path:
        known = self._paths.get((type_name, path))
        if known is None:
            walk, definitions = self._walk(type_name)
            known = _resolve_path(walk.type_name, definitions, path)
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
        self, decoder: CdrDecoder, type_name: str, paths: Sequence[_Path], messages: Messages
    ) -> None:
        self._decoder = decoder
        self._type_name = type_name
        self._paths = paths
        self._messages = messages
        self._values = np.empty((len(messages), len(paths)))
        # Column -> rows and their texts, part by part.
        self._texts: dict[int, list[tuple[npt.NDArray[np.int64], npt.NDArray[np.str_]]]] = {
            k: [] for k, path in enumerate(paths) if path.is_text
        }
        self._bad: dict[int, EpisodeError] = {}

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
        """Read messages of one length: as blocks of known layouts, what is left one by one."""
        walk, layouts = self._decoder.start(self._type_name, self._paths, length)
        block = self._gather(rows, length)
        for layout in tuple(layouts):
            rows, block = self._read_alike(layout, block, rows)
            if not len(rows):
                return
        learned: list[_Layout] = []
        faults = 0
        while len(rows) and max(len(learned), faults) < _MAX_LAYOUTS:
            try:
                tree = walk.run(self._messages[int(rows[0])])
                layout = _Layout(walk, [walk.find(tree, path) for path in self._paths])
            except EpisodeError as err:
                self._bad[int(rows[0])] = err
                rows, block = rows[1:], block[1:]
                faults += 1
                continue
            learned.append(layout)
            rows, block = self._read_alike(layout, block, rows)
        layouts[:] = [*learned, *layouts][:_MAX_LAYOUTS]
        for row in rows.tolist():
            self._read_one(walk, row)

    def _gather(self, rows: npt.NDArray[np.int64], length: int) -> npt.NDArray[np.uint8]:
        """(n, width) bytes of messages of one length."""
        width = _width(length)
        if not width:
            return np.empty((len(rows), 0), dtype=np.uint8)
        buffer, starts = self._messages.buffer, self._messages.starts[rows]
        if int(starts.max()) + width > len(buffer):
            buffer = np.concatenate([buffer, np.zeros(width - length, dtype=np.uint8)])
        return rows_at(buffer, starts, width)

    def _read_alike(
        self, layout: _Layout, block: npt.NDArray[np.uint8], rows: npt.NDArray[np.int64]
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
        self, layout: _Layout, block: npt.NDArray[np.uint8], rows: npt.NDArray[np.int64]
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
        try:
            return raw.astype(np.str_)
        except UnicodeDecodeError:
            pass  # not ASCII
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

    def _read_one(self, walk: _Walk, row: int) -> None:
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


def _least_sizes(definitions: Definitions) -> dict[str, int]:
    """Fewest bytes that a value of each type takes, padding aside; never 0."""
    sizes = {name: _SIZES[code] for name, code in PRIMITIVES.items()} | dict.fromkeys(TEXTS, 4)

    def least(name: str) -> int:
        if name not in sizes:
            sizes[name] = max(
                1,
                sum(
                    4
                    if field.kind == "sequence"
                    else least(field.base) * (field.size if field.kind == "array" else 1)
                    for field in definitions[name]
                ),
            )
        return sizes[name]

    for name in definitions:
        least(name)
    return sizes


def _resolve_path(type_name: str, definitions: Definitions, path: str) -> _Path:
    tokens = path.split(".")
    steps: list[_Step] = []
    owner = type_name

    def wrong(what: str) -> ConfigError:
        return ConfigError(f"path {path!r} of {type_name}: {what}")

    while True:
        fields = {field.name: field for field in definitions[owner]}
        if not tokens or tokens[0] not in fields:
            said = f"{tokens[0]!r} is no member of {owner}" if tokens else f"{owner} is a message"
            raise wrong(f"{said}; it has {', '.join(fields) or 'no members'}")
        field = fields[tokens.pop(0)]
        steps.append(field.name)
        if field.kind != "one":
            names = _names_beside(fields) if field.base in PRIMITIVES else None
            keyed = field.is_struct and _value_beside_key(definitions[field.base])
            rest = ".".join(tokens)
            hints = ["an index", *([f"one of its {names}"] if names else [])]
            hints += ["a key"] if keyed else []
            if not rest:
                raise wrong(f"{field.name!r} is a list: expected {' or '.join(hints)} after it")
            if tokens[0].isascii() and tokens[0].isdigit():
                index = int(tokens.pop(0))
                if field.size and index >= field.size:
                    raise wrong(f"{field.name!r} has at most {field.size} elements")
                steps.append(index)
            elif names:
                return _Path(path, (*steps, _Named(names, rest)), is_text=False)
            elif keyed:
                return _Path(path, (*steps, _Keyed(rest)), is_text=keyed in TEXTS)
            else:
                raise wrong(f"expected {' or '.join(hints)} after {field.name!r}, found {rest!r}")
        if not field.is_struct:
            if tokens:
                raise wrong(f"{field.name!r} is a {field.base}, which has no {tokens[0]!r}")
            return _Path(path, tuple(steps), is_text=field.base in TEXTS)
        owner = field.base


def _names_beside(fields: Mapping[str, Field]) -> str | None:
    for name in _NAME_LISTS:
        if name in fields and fields[name].base == "string" and fields[name].kind != "one":
            return name
    return None


def _value_beside_key(fields: Sequence[Field]) -> str:
    """Type of `value` where the members are a text `key` and a plain `value`, else empty."""
    by_name = {field.name: field for field in fields}
    key, value = by_name.get("key"), by_name.get("value")
    if key is None or value is None or key.base != "string" or value.is_struct:
        return ""
    return value.base if key.kind == value.kind == "one" else ""
