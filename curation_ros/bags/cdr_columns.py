"""The walk over the CDR bytes of many messages at once, where texts differ in length.

It follows the general walk step by step, with one place per message instead of one place. It
accepts a message only if the general walk would, if its lists have as many elements as in the
first message, and if the names that were looked up are the same. Other messages are left to the
general walk, which also reports what is wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from curation_ros.bags.cdr_paths import Keyed, Named, ValuePath
from curation_ros.bags.cdr_walk import SIZES, Walk
from curation_ros.bags.definitions import PRIMITIVES, TEXTS, Field
from curation_ros.core.episode.stream import Messages, Stamps, rows_at

#: A place or length in bytes: the same in all messages, or (n,) one per message.
_Place: TypeAlias = int | Stamps

# Lists of messages with more elements, and texts that are longer, are left to the general walk.
_MAX_ELEMENTS = 64
_MAX_TEXT_BYTES = 4096
# The longest read at a place behind the last byte of a message.
_PADDING = 8


class IrregularError(Exception):
    """The first message is not one that others could be like."""


class Leaves(NamedTuple):
    """Where a value lies in every message; see `curation_ros.bags.cdr_walk.Leaf`."""

    code: str
    at: _Place
    length: _Place = -1


class ColumnWalk:
    """Where every value of many messages lies.

    Attributes:
        fits: (n,) which messages were accepted; final when all paths were found.
    """

    def __init__(self, walk: Walk, messages: Messages) -> None:
        """Prepare a walk over at least one message."""
        self._type_name = walk.type_name
        self._definitions = walk.definitions
        self._starts, self._sizes = messages.starts, messages.sizes
        self._least_size = int(self._sizes.min())
        self._views: dict[str, npt.NDArray[np.generic]] = {}
        self._buffer = messages.buffer
        if int((self._starts + self._sizes).max()) + _PADDING > len(self._buffer):
            self._buffer = np.concatenate([self._buffer, np.zeros(_PADDING, dtype=np.uint8)])

    def run(self) -> dict[str, Any]:
        """Walk over the messages.

        Returns:
            Members -> leaves, members of a nested message, or list of elements.

        Raises:
            IrregularError: if the first message cannot be read, or is large.
        """
        heads = rows_at(self._buffer, self._starts, 2)
        if self._sizes[0] < 4 or heads[0, 0] != 0 or heads[0, 1] > 1:
            raise IrregularError
        self._order = "<" if heads[0, 1] else ">"
        self.fits = (heads == heads[0]).all(axis=1)
        self._at: _Place = 4
        tree = self._members(self._type_name)
        # Places only grow: a place inside at the end was never outside.
        self.fits &= self._at <= self._sizes
        if not self.fits[0]:
            raise IrregularError
        return tree

    def _read(self, at: _Place, code: str) -> npt.NDArray[np.generic]:
        """(n,) numbers at a place; of messages that end before it, any."""
        view = self._views.get(code)
        if view is None:
            # A number at every byte, of which only the wanted ones are copied.
            n_places = len(self._buffer) - SIZES[code] + 1
            view = np.ndarray((n_places,), self._order + code, self._buffer, 0, (1,))
            self._views[code] = view
        if not isinstance(at, int) or at > self._least_size:
            at = np.minimum(at, self._sizes)
        values: npt.NDArray[np.generic] = view[self._starts + at]
        return values

    def _align(self, size: int) -> None:
        self._at = self._at + -(self._at - 4) % size

    def _members(self, type_name: str) -> dict[str, Any]:
        fields = self._definitions[type_name]
        if not fields:
            self._at = self._at + 1
        return {field.name: self._member(field) for field in fields}

    def _member(self, field: Field) -> Any:
        if field.kind == "one":
            return self._one(field)
        count = field.size
        if field.kind == "sequence":
            counts = self._length()
            if not isinstance(counts, int):
                self.fits &= counts == counts[0]
            count = counts if isinstance(counts, int) else int(counts[0])
            if field.size and count > field.size:
                raise IrregularError
        code = PRIMITIVES.get(field.base)
        if code is None:
            if count > _MAX_ELEMENTS:
                raise IrregularError
            return [self._one(field) for _ in range(count)]
        if count:
            self._align(SIZES[code])
        leaves = Leaves(code, self._at, count)
        self._at = self._at + count * SIZES[code]
        return leaves

    def _one(self, field: Field) -> Any:
        code = PRIMITIVES.get(field.base)
        if code is not None:
            self._align(SIZES[code])
            leaves = Leaves(code, self._at)
            self._at = self._at + SIZES[code]
            return leaves
        if field.base in TEXTS:
            return self._text(field)
        return self._members(field.base)

    def _length(self) -> _Place:
        self._align(4)
        counts = self._read(self._at, "I")
        self._at = self._at + 4
        return int(counts[0]) if (counts == counts[0]).all() else counts.astype(np.int64)

    def _text(self, field: Field) -> Leaves:
        length = self._length()
        start = self._at
        if field.base == "wstring":
            self._at = start + length * 4
        else:
            self._at = start + length
            if not isinstance(length, int):
                self.fits &= (self._read(self._at - 1, "B") == 0) | (length == 0)
                length = length - np.minimum(length, 1)
            elif length:
                self.fits &= self._read(self._at - 1, "B") == 0
                length -= 1
        if field.text_bound:
            self.fits &= length <= field.text_bound
        return Leaves(TEXTS[field.base], start, length)

    def find(self, tree: dict[str, Any], path: ValuePath) -> Leaves:
        """The leaves that a path leads to; messages with other names there are not accepted.

        Raises:
            IrregularError: if the first message does not have them.
        """
        node: Any = tree
        parent: dict[str, Any] = tree
        for step in path.steps:
            if isinstance(step, str):
                parent, node = node, node[step]
                continue
            if isinstance(step, Keyed):
                keys = [element["key"] for element in node]
                node = node[self._lookup(keys, step.wanted)]["value"]
                continue
            index = (
                self._lookup(parent[step.names], step.wanted) if isinstance(step, Named) else step
            )
            if index >= (node.length if isinstance(node, Leaves) else len(node)):
                raise IrregularError
            if isinstance(node, Leaves):
                node = Leaves(node.code, node.at + index * SIZES[node.code])
            else:
                node = node[index]
        leaves: Leaves = node
        if leaves.code == "w":
            raise IrregularError
        return leaves

    def _lookup(self, names: Sequence[Leaves], wanted: str) -> int:
        found = []
        for index, leaves in enumerate(names):
            texts, lengths = self.texts(leaves), np.broadcast_to(leaves.length, self.fits.shape)
            # NumPy forgets zeros at the end of a text, the length does not.
            self.fits &= (texts == texts[0]) & (lengths == lengths[0])
            if (texts[0], lengths[0]) == (wanted.encode(), len(wanted.encode())):
                found.append(index)
        if len(found) != 1:
            raise IrregularError
        return found[0]

    def numbers(self, leaves: Leaves) -> npt.NDArray[np.generic]:
        """(n,) numbers; of messages that are not accepted, any."""
        values = self._read(leaves.at, "B" if leaves.code == "?" else leaves.code)
        return values != 0 if leaves.code == "?" else values

    def texts(self, leaves: Leaves) -> npt.NDArray[np.bytes_]:
        """(n,) UTF-8 bytes; of messages that are not accepted, any.

        Raises:
            IrregularError: if a text is long.
        """
        n = len(self._starts)
        lengths = np.broadcast_to(np.where(self.fits, leaves.length, 0), (n,))
        width = max(1, int(lengths.max()))
        if width > _MAX_TEXT_BYTES:
            raise IrregularError
        columns = np.arange(width)
        places = (self._starts + np.minimum(leaves.at, self._sizes))[:, None] + columns
        block = self._buffer.take(places, mode="clip")
        block[columns >= lengths[:, None]] = 0
        texts: npt.NDArray[np.bytes_] = block.view(f"S{width}")
        return texts[:, 0]
