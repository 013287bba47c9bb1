"""A row of benchmarks/results.json."""

from __future__ import annotations

from typing import Any


def row(
    name: str,
    value: float,
    unit: str,
    command: str,
    *,
    against: str = "",
    ratio: float | None = None,
    target: str | None = None,
    holds: bool | None = None,
) -> dict[str, Any]:
    """One measured value.

    Args:
        name: what was measured; a later row of the same name replaces this one.
        value: the value.
        unit: its unit; empty for a ratio.
        command: the command that measures it again.
        against: name of the row that it is compared with.
        ratio: result of that comparison, in the direction in which `target` reads it.
        target: the target in words, such as `< 0.3 s`.
        holds: whether the target is met.
    """
    return {
        "name": name,
        "value": value,
        "unit": unit,
        "against": against,
        "ratio": ratio,
        "target": target,
        "holds": holds,
        "command": command,
    }
