"""Finds the rows of `results.json` that belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.core.types import JsonObject
from curation_ros.study.terms import parse_row

#: A contrast is resolved if its adjusted p is below this.
ALPHA = 0.05


def stages_of_kind(results: JsonObject, *kinds: str) -> Iterator[JsonObject]:
    """Stages of the given kinds, in the order of the plan."""
    return (stage for stage in results["stages"] if stage["kind"] in kinds)


def groups(stage: JsonObject) -> list[tuple[str, str, list[JsonObject]]]:
    """(pool, variant, rows) of a stage, in the order of the plan."""
    by_place: dict[tuple[str, str], list[JsonObject]] = {}
    for row in stage["rows"]:
        by_place.setdefault((row["pool"], row["variant"]), []).append(row)
    return [(pool, variant, rows) for (pool, variant), rows in by_place.items()]


def row_named(rows: Sequence[JsonObject], name: str) -> JsonObject | None:
    """The row with that name in the plan, if there is one."""
    return next((row for row in rows if row["row"] == name), None)


def is_scorer_row(row: JsonObject) -> bool:
    """Whether the training set is what one scorer keeps, and nothing else."""
    return bool(row["scorer"]) and "+" not in row["row"]


def has_scorers(results: JsonObject) -> bool:
    """Whether a scorer made any of the training sets."""
    return any(row["scorer"] for stage in results["stages"] for row in stage["rows"])


def keep_counts(rows: Sequence[JsonObject]) -> list[int]:
    """The different numbers that scorers keep in these rows, ascending."""
    return sorted({row["keep"] for row in rows if is_scorer_row(row)})


def is_sweep(rows: Sequence[JsonObject]) -> bool:
    """Whether scorers keep enough different numbers to draw a curve."""
    return len(keep_counts(rows)) >= 3


def main_keep(results: JsonObject, pool: str, rows: Sequence[JsonObject]) -> int | None:
    """The number kept in figures with one point per scorer.

    It is the audit's if scorers keep that number, otherwise the largest; None without scorers.
    """
    counts = keep_counts(rows)
    audited = next((row["keep"] for row in results["pools"][pool]["audit"]), None)
    return audited if audited in counts else (counts[-1] if counts else None)


def kept_by_scorers(rows: Sequence[JsonObject], keep: int | None) -> list[JsonObject]:
    """The rows in which a scorer keeps that number."""
    return [row for row in rows if is_scorer_row(row) and row["keep"] == keep]


def draws_of(rows: Sequence[JsonObject], control: str) -> dict[int, list[JsonObject]]:
    """Number kept -> rows of a control, one for each draw."""
    by_keep: dict[int, list[JsonObject]] = {}
    for row in rows:
        [first, *more] = parse_row(row["row"])
        if first.name == control and first.keep is not None and not more:
            by_keep.setdefault(first.keep, []).append(row)
    return dict(sorted(by_keep.items()))


def is_resolved(contrast: JsonObject) -> bool:
    """Whether the adjusted p of a planned contrast is small enough to claim a difference."""
    return contrast["p_holm"] is not None and contrast["p_holm"] < ALPHA
