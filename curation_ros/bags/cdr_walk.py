"""The general walk over the CDR bytes of one message, driven by its definition."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from curation_ros.bags.cdr_paths import Keyed, Named, ValuePath
from curation_ros.bags.definitions import PRIMITIVES, TEXTS, Definitions, Field
from curation_ros.core.errors import EpisodeError

#: Bytes of each primitive, by its struct code.
SIZES = {code: struct.calcsize(f"={code}") for code in PRIMITIVES.values()}


class Leaf(NamedTuple):
    """Where a value lies: `code` of definitions.py, first byte, number of elements or -1."""

    code: str
    at: int
    length: int = -1


Node: TypeAlias = Leaf | dict[str, Any] | list[Any]


class Walk:
    """Where every value of one message lies; bounds are checked before anything is trusted.

    Attributes:
        type_name: of the messages.
        definitions: of that type and all that it is made of.
    """

    def __init__(self, type_name: str, definitions: Definitions, sizes: dict[str, int]) -> None:
        self.type_name = type_name
        self.definitions = definitions
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
        fields = self.definitions[type_name]
        if not fields:
            # A message without members has one byte on the wire, as C structs must.
            self._require(1, 1, type_name)
            self._at += 1
        return {field.name: self._member(field) for field in fields}

    def _member(self, field: Field) -> Node:
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
            self._align(SIZES[code])
            self._require(count, SIZES[code], f"{field.name!r} with {count} elements")
        leaf = Leaf(code, self._at, count)
        self._at += count * SIZES[code]
        return leaf

    def _one(self, field: Field) -> Node:
        code = PRIMITIVES.get(field.base)
        if code is not None:
            size = SIZES[code]
            self._align(size)
            self._require(1, size, repr(field.name))
            leaf = Leaf(code, self._at)
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

    def _text(self, field: Field) -> Leaf:
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
        return Leaf(TEXTS[field.base], start, count)

    def value(self, leaf: Leaf) -> Any:
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

    def values(self, node: Node) -> Any:
        """A node as nested plain values."""
        if isinstance(node, Leaf):
            return self.value(node)
        if isinstance(node, dict):
            return {name: self.values(child) for name, child in node.items()}
        return [self.values(child) for child in node]

    def find(self, tree: dict[str, Any], path: ValuePath) -> Leaf:
        """The leaf that a path leads to; names that were looked up become structural."""
        node: Any = tree
        parent: dict[str, Any] = tree
        for step in path.steps:
            if isinstance(step, str):
                parent, node = node, node[step]
            elif isinstance(step, Keyed):
                keys = [element["key"] for element in node]
                node = node[self._lookup(keys, step.wanted, path)]["value"]
            else:
                index = (
                    self._lookup(parent[step.names], step.wanted, path)
                    if isinstance(step, Named)
                    else step
                )
                count = node.length if isinstance(node, Leaf) else len(node)
                if index >= count:
                    raise EpisodeError(
                        f"message of type {self.type_name}: path {path.text!r} means element "
                        f"{index}, but there are {count}"
                    )
                if isinstance(node, Leaf):
                    node = Leaf(node.code, node.at + index * SIZES[node.code])
                else:
                    node = node[index]
        leaf: Leaf = node
        return leaf

    def _lookup(self, names: Sequence[Leaf], wanted: str, path: ValuePath) -> int:
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


def least_sizes(definitions: Definitions) -> dict[str, int]:
    """Fewest bytes that a value of each type takes, padding aside; never 0."""
    sizes = {name: SIZES[code] for name, code in PRIMITIVES.items()} | dict.fromkeys(TEXTS, 4)

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
