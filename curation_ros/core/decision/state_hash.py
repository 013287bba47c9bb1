"""One hash for a state of plain values and arrays, the same on every machine."""

from __future__ import annotations

import hashlib
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np


def state_hash(state: object) -> str:
    """SHA-256 of a state as 64 hexadecimal digits, equal for equal states.

    Args:
        state: None, numbers, texts, arrays, and lists, tuples and mappings of such.

    Raises:
        TypeError: for a type without a canonical form.
    """
    digest = hashlib.sha256()
    _feed(digest, state)
    return digest.hexdigest()


def _feed(digest: Any, value: object) -> None:
    """Feed a value to a hash, with its type, so that no two states give the same bytes."""
    if isinstance(value, Mapping):
        digest.update(f"map{len(value)}".encode())
        for key in sorted(value):
            _feed(digest, key)
            _feed(digest, value[key])
    elif isinstance(value, (list, tuple)):
        digest.update(f"seq{len(value)}".encode())
        for item in value:
            _feed(digest, item)
    elif isinstance(value, np.ndarray):
        kind = "<f8" if value.dtype.kind == "f" else "<i8"
        digest.update(f"arr{kind}{value.shape}".encode())
        digest.update(value.astype(kind).tobytes())
    elif value is None or isinstance(value, (bool, np.bool_)):
        digest.update(f"lit{value}".encode())
    elif isinstance(value, (int, np.integer)):
        digest.update(f"int{int(value)};".encode())
    elif isinstance(value, (float, np.floating)):
        digest.update(b"flt" + struct.pack("<d", value))
    elif isinstance(value, str):
        text = value.encode()
        digest.update(f"str{len(text)};".encode() + text)
    else:
        raise TypeError(f"no canonical form for {type(value).__name__}")
