"""How commands print: JSON lines for programs, tables for people."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from rich.console import Console

#: For people. Progress and warnings go to stderr, so that stdout can be piped.
console = Console(highlight=False)
progress_console = Console(stderr=True, highlight=False)

VERDICT_STYLE = {"keep": "green", "salvage": "cyan", "review": "yellow", "discard": "red"}


def print_json(row: Mapping[str, Any]) -> None:
    """Print one JSON line; NaN is an error."""
    print(json.dumps(row, allow_nan=False), flush=True)


def say(text: str) -> None:
    """Print a line without wrapping, so that paths can be copied."""
    console.print(text, markup=False, soft_wrap=True)


def warn(problem: object) -> None:
    """Print a line about a problem that did not stop the command."""
    progress_console.print(f"warning: {problem}", style="yellow", markup=False, soft_wrap=True)


def percent(successes: int, n: int, interval: tuple[float, float]) -> str:
    """A share with its interval: `7 of 10 (70%, 95 % interval 40% to 89%)`."""
    low, high = interval
    return f"{successes} of {n} ({successes / n:.0%}, 95 % interval {low:.0%} to {high:.0%})"
