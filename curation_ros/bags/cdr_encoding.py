"""Messages as CDR bytes, from plain values and a definition; the inverse of `cdr_walk`."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

from curation_ros.bags.cdr_walk import SIZES
from curation_ros.bags.definitions import PRIMITIVES, TEXTS, Definitions, Field
from curation_ros.core.errors import EpisodeError

#: CDR of XCDR1, little-endian.
_ENCAPSULATION = b"\x00\x01\x00\x00"


def encode(type_name: str, definitions: Definitions, members: Mapping[str, Any]) -> bytes:
    """Encode a message.

    Args:
        type_name: of the message.
        definitions: of that type and all that it is made of.
        members: by name, as `CdrDecoder.read_message` gives them. Members that are absent are
            zero, empty, or messages of zeros.

    Returns:
        CDR bytes with their encapsulation.

    Raises:
        EpisodeError: if a value does not fit its member.
    """
    writer = _Writer(type_name, definitions)
    writer.message(type_name, members)
    return _ENCAPSULATION + bytes(writer.data)


class _Writer:
    def __init__(self, type_name: str, definitions: Definitions) -> None:
        self.data = bytearray()
        self._type_name = type_name
        self._definitions = definitions

    def message(self, type_name: str, members: Mapping[str, Any]) -> None:
        fields = self._definitions[type_name]
        if not fields:
            self.data.append(0)  # a message without members has one byte on the wire
        for field in fields:
            self._member(field, members.get(field.name))

    def _member(self, field: Field, value: Any) -> None:
        if field.kind == "one":
            self._one(field, value)
            return
        elements: Sequence[Any] = [] if value is None else value
        if field.kind == "array":
            if value is None:
                elements = [None] * field.size
            elif len(elements) != field.size:
                raise self._fault(field, f"{len(elements)} elements, expected {field.size}")
        else:
            if field.size and len(elements) > field.size:
                raise self._fault(field, f"{len(elements)} elements, at most {field.size}")
            self._pack(field, "I", len(elements))
        for element in elements:
            self._one(field, element)

    def _one(self, field: Field, value: Any) -> None:
        if field.base in PRIMITIVES:
            self._pack(field, PRIMITIVES[field.base], 0 if value is None else value)
        elif field.base in TEXTS:
            self._text(field, "" if value is None else str(value))
        else:
            self.message(field.base, {} if value is None else value)

    def _pack(self, field: Field, code: str, value: Any) -> None:
        size = SIZES[code]
        self.data += bytes(-len(self.data) % size)
        try:
            whole = value if code in "fd?" else int(value)
            self.data += struct.pack(f"<{code}", whole)
        except (struct.error, TypeError, ValueError, OverflowError) as err:
            raise self._fault(field, f"value {value!r:.40}, expected a {field.base}") from err

    def _text(self, field: Field, text: str) -> None:
        if field.base == "wstring":
            # As rmw_fastrtps writes it: so many 32-bit words without a terminator.
            words = text.encode("utf-32-le")
            self._pack(field, "I", len(words) // 4)
            self.data += words
            return
        raw = text.encode() + b"\x00"
        self._pack(field, "I", len(raw))
        self.data += raw

    def _fault(self, field: Field, what: str) -> EpisodeError:
        return EpisodeError(f"message of type {self._type_name}: {field.name!r} has {what}")
