"""Writes the values of `results.json` for people: a text for each cell or sentence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from curation_ros.core.types import JsonObject

NOTHING = "-"


def number(value: float | None, digits: int = 3) -> str:
    """A number, such as `0.804`."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """A rate, such as `93.3 %`."""
    return NOTHING if value is None else f"{100 * value:.1f} %"


def points(value: float | None) -> str:
    """A difference of two rates in percentage points, such as `-50.0`."""
    return NOTHING if value is None else f"{100 * value:+.1f}"


def unsigned_points(value: float | None) -> str:
    """A standard deviation or a distance in percentage points, such as `16.6`."""
    return NOTHING if value is None else f"{100 * value:.1f}"


def interval(bounds: Sequence[float] | None, digits: int = 2) -> str:
    """An interval of numbers, such as `[0.48, 0.80]`."""
    return NOTHING if bounds is None else f"[{bounds[0]:.{digits}f}, {bounds[1]:.{digits}f}]"


def percent_interval(bounds: Sequence[float] | None) -> str:
    """An interval of rates in per cent without the sign, such as `[48.1, 80.0]`."""
    return NOTHING if bounds is None else f"[{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"


def with_interval(value: float | None, bounds: Sequence[float] | None) -> str:
    """A number with its interval, such as `0.638 [0.48, 0.80]`."""
    return NOTHING if value is None else f"{number(value)} {interval(bounds)}"


def probability(p: float | None) -> str:
    """A p-value; a small one is never written as 0."""
    if p is None:
        return NOTHING
    return "<0.0001" if p < 0.0001 else f"{p:.4f}"


def rate_with_deviation(rate: float | None, sd: float | None) -> str:
    """A rate with its standard deviation, such as `63.3 ± 30.7`, in per cent like the paper's."""
    if rate is None:
        return NOTHING
    return f"{100 * rate:.1f} ± {100 * sd:.1f}" if sd is not None else f"{100 * rate:.1f}"


def names(values: Sequence[str]) -> str:
    """A list, such as `object pose, reference`."""
    return ", ".join(values)


def tally(counts: Mapping[str, int]) -> str:
    """Counts by name, such as `LIFT 12, GRASP 3`."""
    return ", ".join(f"{name} {n}" for name, n in counts.items()) or NOTHING


# --- of a row -----------------------------------------------------------------------------------


def place(row: JsonObject) -> str:
    """Pool and observations of a row or contrast, such as `paired, relative`."""
    return f"{row['pool']}, {row['variant']}"


def seed_successes(row: JsonObject) -> str:
    """Successes of each training seed's policy, such as `6, 25, 26 of 30`."""
    counts = row["counts"]
    if not counts:
        return NOTHING
    totals = {c["n"] for c in counts}
    if len(totals) == 1:
        return ", ".join(str(c["successes"]) for c in counts) + f" of {totals.pop()}"
    return ", ".join(f"{c['successes']}/{c['n']}" for c in counts)


def modes(row: JsonObject) -> str:
    """How many policies fail, are in between and work; `bimodal` if some fail and some work."""
    counts = row["modes"]
    if counts is None:
        return NOTHING
    text = f"{counts['low']} / {counts['middle']} / {counts['high']}"
    return f"{text} bimodal" if counts["low"] and counts["high"] else text


def good_in(row: JsonObject) -> str:
    """How many of the pool's whole demonstrations in a set succeeded, such as `12 of 16`."""
    if not row["n_pool"]:
        return NOTHING
    n_good, n_parts = row["n_good"], row.get("n_salvaged", 0)
    if n_good is None:
        return NOTHING
    text = f"{n_good:g} of {row['n_pool'] - n_parts}"
    return f"{text}, and {n_parts} parts" if n_parts else text


def rival(row: JsonObject) -> str:
    """The best row that needs no more, and the difference from it in percentage points."""
    other = row["rival"]
    if other is None:
        return NOTHING
    return f"{other['row']} ({percent(other['rate'])}): {points(other['difference'])}"
