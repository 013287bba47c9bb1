"""YAML as the metadata of rosbag2 needs it, through libyaml where PyYAML has it: far faster."""

from __future__ import annotations

from typing import Any

import yaml

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DUMPER = getattr(yaml, "CSafeDumper", yaml.SafeDumper)


#: Metadata have some kB and some hundred values. Beyond these limits a text is a trap.
MOST_BYTES, MOST_VALUES, MOST_NESTED = 16 << 20, 200_000, 100
#: What opens a level on one line. A small text without many of them cannot be nested deeply.
_OPENERS = (b"[", b"{", b"- ", b"-\t", b"? ", b"?\t")
_FEW_OPENERS, _SMALL_BYTES = 500, 50_000


def load_yaml(text: str | bytes) -> Any:
    """Plain data of a YAML text.

    Raises:
        ValueError: if it is not YAML, nested too deep, or too large with its aliases unfolded.
    """
    raw = text.encode(errors="replace") if isinstance(text, str) else text
    if len(raw) > MOST_BYTES:
        raise ValueError(f"not metadata: a text of {len(raw)} bytes")
    try:
        if len(raw) > _SMALL_BYTES or sum(map(raw.count, _OPENERS)) > _FEW_OPENERS:
            _check_nesting(text)
        data = yaml.load(text, Loader=_LOADER)  # a safe loader, either way
    except yaml.YAMLError as err:
        if "increasing flow level" in str(err):  # libyaml counts these itself from 0.2.6 on
            raise ValueError(f"not metadata: nested more than {MOST_NESTED} deep") from err
        raise ValueError(f"not YAML: {str(err).splitlines()[0]}") from err
    if b"*" in raw:
        _check_unfolded(data)
    return data


def _check_nesting(text: str | bytes) -> None:
    """Refuse a text that is nested too deep: libyaml's loader recurses until the stack is full."""
    depth = 0
    for event in yaml.parse(text, Loader=_LOADER):
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        if depth > MOST_NESTED:
            raise ValueError(f"not metadata: nested more than {MOST_NESTED} deep")


def _check_unfolded(data: Any) -> None:
    """Refuse data that aliases make far larger than their text, or endless."""
    pending, n_values = [data], 0
    while pending:
        value = pending.pop()
        n_values += 1
        if n_values > MOST_VALUES:
            raise ValueError(f"not metadata: more than {MOST_VALUES} values")
        if isinstance(value, dict):
            pending += value.values()
        elif isinstance(value, list):
            pending += value


def dump_yaml(data: Any) -> str:
    """YAML text of plain data, keys in their order.

    Lines are never folded. Folding is legal, but not every reader of rosbag2 metadata unfolds.
    """
    text = yaml.dump(data, Dumper=_DUMPER, sort_keys=False, width=2**30, allow_unicode=True)
    return str(text)
