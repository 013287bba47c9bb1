"""The tables of a report."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

from curation_ros.batch import published
from curation_ros.core.types import JsonObject
from curation_ros.reporting.blocks import Table
from curation_ros.reporting.cells import (
    NOTHING,
    good_in,
    interval,
    modes,
    names,
    number,
    percent,
    percent_interval,
    place,
    points,
    probability,
    rate_with_deviation,
    rival,
    seed_successes,
    tally,
    unsigned_points,
    with_interval,
)
from curation_ros.reporting.rows import (
    groups,
    is_scorer_row,
    kept_by_scorers,
    main_keep,
    row_named,
)

_AGAINST = {
    "auroc": "AUROC, length controlled",
    "auroc_raw": "AUROC, raw",
    "n_good": "good demonstrations kept",
}
Column: TypeAlias = Callable[[JsonObject], str]
#: What tables show of a row: heading -> its text.
_ROW_COLUMNS: dict[str, Column] = {
    "row": lambda r: str(r["row"]),
    "where": place,
    "needs": lambda r: names(r["needs"]),
    "n": lambda r: str(r["n"]),
    "good": good_in,
    "contamination": lambda r: percent(r["contamination"]),
    "AUROC": lambda r: number(r["auroc"]),
    "success": lambda r: percent(r["rate"]),
    "interval": lambda r: percent_interval(r["interval"]),
    "sd": lambda r: unsigned_points(r["sd"]),
    "seeds": seed_successes,
    "low / middle / high": modes,
    "rival": rival,
    "failures reached": lambda r: tally(r["stages_reached"]),
    "ended by": lambda r: tally(r["ended"]),
    "tied at cut": lambda r: NOTHING if r["tied_at_cut"] is None else f"{r['tied_at_cut']:g}",
    "missing": lambda r: str(r["n_missing"]),
}
#: What the table of contrasts shows of one that has data: heading -> its text.
_DIFFERENCE_COLUMNS: dict[str, Column] = {
    "difference": lambda c: points(c["value"]),
    "interval": lambda c: percent_interval(c["interval"]),
    "p": lambda c: probability(c["p"]),
    "p (Holm)": lambda c: probability(c["p_holm"]),
    "floor": lambda c: probability(c["p_floor"]),
    "seeds": lambda c: str(c["n_seeds"]),
    "starts": lambda c: str(c["n_starts"]),
    "unpaired": lambda c: str(c["n_unpaired"]),
    "detectable": lambda c: unsigned_points(c["minimum_detectable"]),
}
_LEFT_COLUMNS = {"row", "where", "needs"}


def stage_caption(stage: JsonObject) -> str:
    """Beginning of a caption: name and kind of the stage."""
    return f"Stage {stage['name']} ({stage['kind']})"


def rows_table(
    caption: str,
    headings: Sequence[str],
    rows: Iterable[JsonObject],
    more: Mapping[str, Column] | None = None,
) -> Table:
    """A table of rows.

    Args:
        caption: what it shows.
        headings: its columns, in order.
        rows: rows of a stage.
        more: columns beyond the usual ones: heading -> text of a row.
    """
    columns = {**_ROW_COLUMNS, **(more or {})}
    return Table(
        caption,
        tuple(headings),
        tuple(tuple(columns[heading](row) for heading in headings) for row in rows),
        text=tuple(k for k, heading in enumerate(headings) if heading in _LEFT_COLUMNS),
    )


def table_1(results: JsonObject, pool: str) -> Table:
    """AUROC raw and with length controlled, next to the paper's Table I."""
    facts = results["pools"][pool]
    control = facts["length_control"]
    steps = f", T = {control['steps']} steps" if control.get("steps") is not None else ""
    rows = []
    for row in facts["audit"]:
        paper = row.get("paper") or {}
        rows.append(
            (
                row["scorer"],
                names(facts["needs"].get(row["scorer"], [row["needs"]])),
                with_interval(row["auroc_raw"], row["ci_raw"]),
                number(paper.get("raw")),
                with_interval(row["auroc_controlled"], row["ci"]),
                number(paper.get("truncated")),
                number(paper.get("truncated_joined_by_name")),
                number(row.get("precision")),
                number(row.get("clean_recall")),
            )
        )
    kept = next((row["keep"] for row in facts["audit"]), None)
    return Table(
        f"Pool {pool}: {facts['n_good']} good of {facts['n']}, {facts['n_starts']} start states; "
        f"length control {control['mode']}{steps} (needs {control['needs']}). Intervals are 95 %. "
        f"Precision and recall: of the best {kept}.",
        (
            "scorer", "needs", "AUROC raw", "paper raw", "AUROC controlled", "paper T = 324",
            "paper joined", "precision", "clean recall",
        ),
        tuple(rows),
        text=(0, 1),
    )  # fmt: skip


def table_2(results: JsonObject, stage: JsonObject, pool: str) -> Table:
    """Success of all conditions at one number kept, next to the paper's Table II."""
    by_variant = {variant: rows for p, variant, rows in groups(stage) if p == pool}
    first = next(iter(by_variant.values()))
    headings = [
        *("condition", "needs", "good", "AUROC", "paper AUROC", "paper joined"),
        *(f"{v}: success" for v in by_variant),
        "paper success",
        *(f"{v}: gap closed" for v in by_variant),
        "paper gap closed",
        *(f"{v}: {what}" for v in by_variant for what in ("interval", "seeds")),
    ]
    rows = []
    for name in _conditions(first, main_keep(results, pool, first)):
        some = [row_named(those, name) or {} for those in by_variant.values()]
        one = next(row for row in some if row)
        paper = published.TABLE_2.get(one["scorer"] or one["row"])
        cells = [name, names(one["needs"]), good_in(one), number(one["auroc"])]
        cells += [number(paper.auroc if paper else None), number(paper.joined if paper else None)]
        cells += [rate_with_deviation(r.get("rate"), r.get("sd_population")) for r in some]
        cells += [rate_with_deviation(paper.success, paper.sd) if paper else NOTHING]
        cells += [percent(r.get("gap_closed")) for r in some]
        cells += [f"{100 * paper.gap_closed:.0f} %" if paper else NOTHING]
        for row in some:
            cells += [percent_interval(row.get("interval"))]
            cells += [seed_successes(row) if row else NOTHING]
        rows.append(tuple(cells))
    return Table(
        f"{stage_caption(stage)}, pool {pool}: success in per cent, mean ± "
        "population standard deviation over training seeds (as the paper has it), 95 % interval "
        "over seeds and starts, successes of each seed's policy.",
        tuple(headings),
        tuple(rows),
        text=(0, 1),
    )


def _conditions(rows: Sequence[JsonObject], keep: int | None) -> list[str]:
    """Names of the rows that Table II compares: scorers in the paper's order, and baselines."""
    scorers = [r["row"] for r in kept_by_scorers(rows, keep)]
    order = [f"{name}@{keep}" for name in published.TABLE_2]
    scorers.sort(key=lambda n: order.index(n) if n in order else len(order))

    def present(*baselines: str) -> list[str]:
        return [name for name in baselines if row_named(rows, name)]

    return [*present("oracle", "reference"), *scorers, *present("everything")]


def published_kept() -> Table:
    """What the paper's policies were trained on, and would have been with rows joined by name."""
    return Table(
        f"The {published.KEEP} demonstrations that the paper's policies were trained on: how many "
        "of the 20 that its files call clean.",
        ("scorer", "clean kept, as run", "clean kept, joined by name"),
        tuple(
            (name, str(one.clean_kept), str(one.clean_kept_joined))
            for name, one in published.TABLE_2.items()
            if one.clean_kept is not None
        ),
    )


def correlations(stage: JsonObject, keeps: Collection[int | None] = ()) -> Table | None:
    """Detection against success over the scorers.

    Args:
        stage: of the results.
        keeps: numbers kept to show; all if there are none.

    Returns:
        The table, or None if there is no correlation to show.
    """
    rows: list[tuple[str, ...]] = [
        (
            one["pool"],
            one["variant"],
            _AGAINST.get(one["against"], one["against"]),
            str(one["keep"]),
            str(one["n"]),
            number(one["rho"], 2),
            interval(one["interval"]),
            probability(one["p"]),
            {True: "exact", False: "drawn", None: NOTHING}[one["is_exact"]],
        )
        for one in stage["correlations"]
        if not keeps or one["keep"] in keeps
    ]
    if not rows:
        return None
    if stage["kind"] == "protocol":
        rows += _published_correlations()
    return Table(
        f"{stage_caption(stage)}: Spearman's rho with success over scorers at "
        "one number kept, with its 95 % interval and permutation p.",
        ("pool", "observations", "of", "kept", "scorers", "rho", "interval", "p", "p is"),
        tuple(rows),
        text=(0, 1, 2),
    )


def _published_correlations() -> list[tuple[str, ...]]:
    """The paper's correlation, as printed and as computed from its table."""
    paper = ("the paper", NOTHING, _AGAINST["auroc"], str(published.KEEP), "7")
    return [
        (*paper, number(published.RHO_PRINTED, 2), NOTHING, NOTHING, "as printed"),
        (
            *paper,
            number(published.RHO, 2),
            interval(published.RHO_INTERVAL),
            number(published.RHO_P, 2),
            "from its Table II",
        ),
    ]


def contrasts(stage: JsonObject) -> Table:
    """Planned contrasts: differences, intervals, p-values and what would be detectable."""
    rows = []
    for one in stage["contrasts"]:
        if "value" in one:
            difference = [cell(one) for cell in _DIFFERENCE_COLUMNS.values()]
        else:
            empty = {**dict.fromkeys(_DIFFERENCE_COLUMNS, NOTHING), "difference": "no data"}
            difference = list(empty.values())
        why = one["why"] + (" (equal sets)" if one.get("is_same_set") else "")
        rows.append((f"{one['a']} minus {one['b']}", place(one), *difference, why))
    headings = ("contrast", "where", *_DIFFERENCE_COLUMNS, "question")
    return Table(
        f"Stage {stage['name']}: planned contrasts, differences in percentage points with 95 % "
        f"intervals; p-values adjusted for all {len(rows)} by Holm's method. The floor is the "
        "smallest p that so many seeds can give; detectable is the smallest difference that "
        "would have been found four times in five.",
        headings,
        tuple(rows),
        text=(0, 1, len(headings) - 1),
    )


def all_rows(stage: JsonObject) -> Table:
    """Every training set of a stage with all its counts."""
    return rows_table(
        f"{stage_caption(stage)}: every training set. n counts trusted "
        "demonstrations, too; good and contamination are of those from the pool. sd is the sample "
        "standard deviation over seeds, percentage points. Modes: seeds with at most 20 %, in "
        "between, with at least 80 % success. The rival is the best row without a scorer that "
        "needs no more, and the difference from it in percentage points.",
        tuple(_ROW_COLUMNS),
        stage["rows"],
    )


def baselines(stage: JsonObject) -> Table:
    """The rows that need no scorer and keep no number."""
    return rows_table(
        f"{stage_caption(stage)}: what can be had without any scorer.",
        ("row", "where", "needs", "n", "good", "success", "interval", "seeds"),
        [r for r in stage["rows"] if not r["scorer"] and "@" not in r["row"]],
    )


def best_cells(stage: JsonObject) -> Table:
    """Each scorer at the number kept that did best, which is chosen after looking."""
    rows: list[JsonObject] = []
    for _, _, some in groups(stage):
        best: dict[str, JsonObject] = {}
        for row in some:
            if is_scorer_row(row) and row["rate"] is not None:
                known = best.get(row["scorer"])
                if known is None or row["rate"] > known["rate"]:
                    best[row["scorer"]] = row
        rows += sorted(best.values(), key=lambda r: -r["rate"])
    return rows_table(
        f"{stage_caption(stage)}: each scorer at the number kept that did best. "
        "Chosen after looking, so these are too good: a look, not a claim.",
        ("row", "where", "needs", "good", "AUROC", "success", "interval", "rival"),
        rows,
    )


def purity(results: JsonObject) -> Table | None:
    """The largest possible share of good demonstrations among K kept."""
    ceilings = {name: pool["purity_ceiling"] for name, pool in results["pools"].items()}
    kept = sorted({int(k) for ceiling in ceilings.values() for k in ceiling})
    if not kept:
        return None
    return Table(
        "Purity ceiling: the share of good demonstrations that a perfect ranking reaches.",
        ("pool", *(f"{k} kept" for k in kept)),
        tuple(
            (name, *(percent(ceiling.get(str(k))) for k in kept))
            for name, ceiling in ceilings.items()
        ),
    )


def mapping(caption: str, values: Mapping[str, Any]) -> Table:
    """A table of keys and values."""
    return Table(caption, ("", ""), tuple((k, str(v)) for k, v in values.items()), text=(0, 1))


def wall_times(results: JsonObject) -> Table | None:
    """Wall time of each part of each run."""
    rows = [
        (
            str(one.get("what", "")),
            str(one.get("part", "")),
            str(one.get("units", NOTHING)),
            str(one.get("steps", NOTHING)),
            number(one.get("seconds"), 1),
        )
        for one in results["seconds"]
    ]
    if not rows:
        return None
    return Table(
        "Wall time of each part of each run.",
        ("what", "part", "units", "simulation steps", "seconds"),
        tuple(rows),
        text=(0, 1),
    )
