"""Plain messages to CDR, through the message types of rosbags: no ROS needed."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import cache, partial
from typing import Any

import numpy as np

from curation_ros.bags.schemas import jazzy_typestore
from curation_ros.core.errors import BagError

_Convert = Callable[[Any], Any]


def to_cdr(type_name: str, content: Mapping[str, Any]) -> bytes:
    """Encode a plain message, see `curation_ros.core.episode.messages`.

    Args:
        type_name: such as `sensor_msgs/msg/JointState`.
        content: every member of the type by its name.

    Raises:
        BagError: if the type is not among those of Jazzy, or a member is missing or of a wrong
            kind.
    """
    try:
        message = _converter(type_name)(content)
        return bytes(jazzy_typestore().serialize_cdr(message, type_name))
    except (KeyError, TypeError, ValueError, AttributeError, struct.error) as err:
        raise BagError(f"message of {type_name}: {type(err).__name__} {err}") from err


@cache
def _converter(type_name: str) -> _Convert:
    """What makes a message of this type from plain data."""
    store = jazzy_typestore()
    if type_name not in store.fielddefs:
        raise BagError(f"no message type {type_name} among the Jazzy types of rosbags")
    _, fields = store.fielddefs[type_name]
    return partial(
        _message, store.types[type_name], [(name, _member(kind)) for name, kind in fields]
    )


def _message(
    make: Callable[..., Any],
    members: list[tuple[str, _Convert | None]],
    content: Mapping[str, Any],
) -> Any:
    return make(
        *[content[k] if convert is None else convert(content[k]) for k, convert in members]
    )


def _member(kind: Any) -> _Convert | None:
    """How to convert a member; None where it is taken as it is."""
    from rosbags.interfaces import Nodetype

    node, detail = kind
    if node == Nodetype.NAME:
        return _converter(detail)
    if node == Nodetype.BASE:
        return None
    element = detail[0]
    if element[0] == Nodetype.NAME:
        return partial(_list, _converter(element[1]))
    name = element[1][0]
    if name == "string":
        return list
    numbers = {"byte": "uint8", "octet": "uint8", "char": "uint8"}.get(name, name)
    return partial(np.array, dtype=numbers)


def _list(convert: _Convert, values: list[Any]) -> list[Any]:
    return [convert(value) for value in values]
