"""Reads what a report shows, for tests."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

from curation_ros.reporting.blocks import Table
from curation_ros.reporting.cells import NOTHING

MOST_BYTES = 3_000_000  # of report.html
ROUNDING = 0.0006  # of three digits


def stage_of(found: dict[str, Any], name: str) -> dict[str, Any]:
    """The stage of that name."""
    [stage] = [s for s in found["stages"] if s["name"] == name]
    return dict(stage)


def cells(table: Table) -> Iterator[dict[str, str]]:
    """Heading -> text of each row."""
    for row in table.rows:
        assert len(row) == len(table.headings)
        yield dict(zip(table.headings, row, strict=True))


def same(text: str, value: float | None, scale: float = 1.0) -> bool:
    """Whether a cell shows that value."""
    if value is None:
        return text == NOTHING
    shown = float(text.removesuffix(" %").split(" ")[0])
    return abs(shown / scale - value) <= ROUNDING


def bounds(text: str) -> list[float]:
    """The numbers of an interval."""
    return [float(x) for x in re.findall(r"-?\d+\.\d+", text)]
