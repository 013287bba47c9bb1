"""Tables of a report: the figures of `results.json`, written for people."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from curation_ros.reporting import published
from curation_ros.reporting.blocks import Table
from curation_ros.reporting.findings import Row, at_keep, groups, is_plain, main_keep, named

NOTHING = "-"
_AGAINST = {
    "auroc": "AUROC, length controlled",
    "auroc_raw": "AUROC, raw",
    "n_good": "good demonstrations kept",
}


def number(value: float | None, digits: int = 3) -> str:
    """Such as `0.804`."""
    return NOTHING if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    """Such as `93.3 %`."""
    return NOTHING if value is None else f"{100 * value:.1f} %"


def points(value: float | None) -> str:
    """A difference of two rates, percentage points."""
    return NOTHING if value is None else f"{100 * value:+.1f}"


def span(bounds: Sequence[float] | None, digits: int = 2) -> str:
    """An interval of figures."""
    return NOTHING if bounds is None else f"[{bounds[0]:.{digits}f}, {bounds[1]:.{digits}f}]"


def percent_span(bounds: Sequence[float] | None) -> str:
    """An interval of rates, without the sign of per cent."""
    return NOTHING if bounds is None else f"[{100 * bounds[0]:.1f}, {100 * bounds[1]:.1f}]"


def probability(p: float | None) -> str:
    """A p-value; small ones are not written as nought."""
    if p is None:
        return NOTHING
    return "<0.0001" if p < 0.0001 else f"{p:.4f}"


def rate_with_deviation(rate: float | None, sd: float | None) -> str:
    """Such as `63.3 ± 30.7`, in per cent, as the paper prints it."""
    if rate is None:
        return NOTHING
    return f"{100 * rate:.1f} ± {100 * sd:.1f}" if sd is not None else f"{100 * rate:.1f}"


def counts(row: Row) -> str:
    """Successes of each training seed's policy, such as `6, 25, 26 of 30`."""
    found = row["counts"]
    if not found:
        return NOTHING
    totals = {c["n"] for c in found}
    if len(totals) == 1:
        return ", ".join(str(c["successes"]) for c in found) + f" of {totals.pop()}"
    return ", ".join(f"{c['successes']}/{c['n']}" for c in found)


def modes(row: Row) -> str:
    """How many seeds fail, are in between, work; said where some fail and some work."""
    found = row["modes"]
    if found is None:
        return NOTHING
    text = f"{found['low']} / {found['middle']} / {found['high']}"
    return f"{text} bimodal" if found["low"] and found["high"] else text


def needs(names: Sequence[str]) -> str:
    """What somebody must have."""
    return ", ".join(names)


def good_of(row: Row) -> str:
    """How many of the pool's demonstrations in a set succeeded; those that are there whole."""
    if not row["n_pool"]:
        return NOTHING
    n_good, n_parts = row["n_good"], row.get("n_salvaged", 0)
    if n_good is None:
        return NOTHING
    text = f"{n_good:g} of {row['n_pool'] - n_parts}"
    return f"{text}, and {n_parts} parts" if n_parts else text


def rival(row: Row) -> str:
    """The best row that needs no more, and how much better than it this one is."""
    found = row["rival"]
    if found is None:
        return NOTHING
    return f"{found['row']} ({percent(found['rate'])}): {points(found['difference'])}"


def counted(found: Mapping[str, int]) -> str:
    """Such as `LIFT 12, GRASP 3`."""
    return ", ".join(f"{name} {n}" for name, n in found.items()) or NOTHING


def table_1(found: Row, pool: str) -> Table:
    """AUROC raw and with length controlled, beside the paper's."""
    facts = found["pools"][pool]
    control = facts["length_control"]
    of = f", T = {control['steps']} steps" if control.get("steps") is not None else ""
    rows = []
    for row in facts["audit"]:
        paper = row.get("paper") or {}
        rows.append(
            (
                row["scorer"],
                needs(facts["needs"].get(row["scorer"], [row["needs"]])),
                _with_span(row["auroc_raw"], row["ci_raw"]),
                number(paper.get("raw")),
                _with_span(row["auroc_controlled"], row["ci"]),
                number(paper.get("truncated")),
                number(paper.get("truncated_joined_by_name")),
                number(row.get("precision")),
                number(row.get("clean_recall")),
            )
        )
    kept = next((row["keep"] for row in facts["audit"]), None)
    return Table(
        f"Pool {pool}: {facts['n_good']} good of {facts['n']}, {facts['n_starts']} start states; "
        f"length control {control['mode']}{of} (needs {control['needs']}). Intervals are 95 %. "
        f"Precision and recall: of the best {kept}.",
        (
            "scorer", "needs", "AUROC raw", "paper raw", "AUROC controlled", "paper T = 324",
            "paper joined", "precision", "clean recall",
        ),
        tuple(rows),
        text=(0, 1),
    )  # fmt: skip


def _with_span(value: float | None, bounds: Sequence[float] | None) -> str:
    return NOTHING if value is None else f"{number(value)} {span(bounds)}"


def table_2(found: Row, stage: Row, pool: str) -> Table:
    """Success of all conditions at one number kept, observation variants side by side."""
    parts = {variant: rows for p, variant, rows in groups(stage) if p == pool}
    first = next(iter(parts.values()))
    keep = main_keep(found, pool, first)
    names = [r["row"] for r in at_keep(first, keep)]
    order = [f"{name}@{keep}" for name in published.TABLE_2]
    names.sort(key=lambda n: order.index(n) if n in order else len(order))
    names = [*_there(first, "oracle", "reference"), *names, *_there(first, "everything")]
    headings = [
        *("condition", "needs", "good", "AUROC", "paper AUROC", "paper joined"),
        *(f"{v}: success" for v in parts),
        "paper success",
        *(f"{v}: gap closed" for v in parts),
        "paper gap closed",
        *(f"{v}: {what}" for v in parts for what in ("interval", "seeds")),
    ]
    rows = []
    for name in names:
        some = [named(those, name) or {} for those in parts.values()]
        one = next(row for row in some if row)
        paper = published.TABLE_2.get(one["scorer"] or one["row"])
        cells = [name, needs(one["needs"]), good_of(one), number(one["auroc"])]
        cells += [number(paper.auroc if paper else None), number(paper.joined if paper else None)]
        cells += [rate_with_deviation(r.get("rate"), r.get("sd_population")) for r in some]
        cells += [rate_with_deviation(paper.success, paper.sd) if paper else NOTHING]
        cells += [percent(r.get("gap_closed")) for r in some]
        cells += [f"{100 * paper.gap_closed:.0f} %" if paper else NOTHING]
        for row in some:
            cells += [percent_span(row.get("interval")), counts(row) if row else NOTHING]
        rows.append(tuple(cells))
    return Table(
        f"Stage {stage['name']} ({stage['kind']}), pool {pool}: success in per cent, mean ± "
        "population standard deviation over training seeds (as the paper has it), 95 % interval "
        "over seeds and starts, successes of each seed's policy.",
        tuple(headings),
        tuple(rows),
        text=(0, 1),
    )


def _there(rows: Sequence[Row], *names: str) -> list[str]:
    return [name for name in names if named(rows, name)]


def published_kept() -> Table:
    """What the paper's policies were trained on, and what they would have been."""
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


def correlations(stage: Row, keeps: Collection[int | None] = ()) -> Table | None:
    """Detection against success over the scorers, at these numbers kept or at all."""
    rows = [
        (
            one["pool"],
            one["variant"],
            _AGAINST.get(one["against"], one["against"]),
            str(one["keep"]),
            str(one["n"]),
            number(one["rho"], 2),
            span(one["interval"]),
            probability(one["p"]),
            {True: "exact", False: "drawn", None: NOTHING}[one["is_exact"]],
        )
        for one in stage["correlations"]
        if not keeps or one["keep"] in keeps
    ]
    if not rows:
        return None
    if stage["kind"] == "protocol":
        paper = ("the paper", NOTHING, _AGAINST["auroc"], str(published.KEEP), "7")
        low, high = published.RHO_INTERVAL
        rows += [
            (*paper, number(published.RHO_PRINTED, 2), NOTHING, NOTHING, "as printed"),
            (
                *paper,
                number(published.RHO, 2),
                span((low, high)),
                number(published.RHO_P, 2),
                "from its Table II",
            ),
        ]
    return Table(
        f"Stage {stage['name']} ({stage['kind']}): Spearman's rho with success over scorers at "
        "one number kept, with its 95 % interval and permutation p.",
        ("pool", "observations", "of", "kept", "scorers", "rho", "interval", "p", "p is"),
        tuple(rows),
        text=(0, 1, 2),
    )


def contrasts(stage: Row) -> Table:
    """Planned contrasts with all that is to be said of them."""
    rows = []
    for one in stage["contrasts"]:
        made = "value" in one
        rows.append(
            (
                f"{one['a']} minus {one['b']}",
                f"{one['pool']}, {one['variant']}",
                points(one["value"]) if made else "no data",
                percent_span(one["interval"]) if made else NOTHING,
                probability(one["p"]) if made else NOTHING,
                probability(one["p_holm"]),
                probability(one["p_floor"]) if made else NOTHING,
                str(one["n_seeds"]) if made else NOTHING,
                str(one["n_starts"]) if made else NOTHING,
                str(one["n_unpaired"]) if made else NOTHING,
                number(_hundred(one["minimum_detectable"]), 1) if made else NOTHING,
                one["why"] + (" (equal sets)" if one.get("is_same_set") else ""),
            )
        )
    return Table(
        f"Stage {stage['name']}: planned contrasts, differences in percentage points with 95 % "
        f"intervals; p-values adjusted for all {len(rows)} by Holm's method. The floor is the "
        "smallest p that so many seeds can give; detectable is the smallest difference that "
        "would have been found four times in five.",
        (
            "contrast", "where", "difference", "interval", "p", "p (Holm)", "floor", "seeds",
            "starts", "unpaired", "detectable", "question",
        ),
        tuple(rows),
        text=(0, 1, 11),
    )  # fmt: skip


def _hundred(value: float | None) -> float | None:
    return None if value is None else 100 * value


def all_rows(stage: Row) -> Table:
    """Every training set of a stage with all its counts."""
    rows = [
        (
            row["row"],
            f"{row['pool']}, {row['variant']}",
            needs(row["needs"]),
            str(row["n"]),
            good_of(row),
            percent(row["contamination"]),
            number(row["auroc"]),
            percent(row["rate"]),
            percent_span(row["interval"]),
            number(_hundred(row["sd"]), 1),
            counts(row),
            modes(row),
            rival(row),
            counted(row["stages_reached"]),
            counted(row["ended"]),
            f"{row['tied_at_cut']:g}" if row["tied_at_cut"] is not None else NOTHING,
            str(row["n_missing"]),
        )
        for row in stage["rows"]
    ]
    return Table(
        f"Stage {stage['name']} ({stage['kind']}): every training set. n counts trusted "
        "demonstrations, too; good and contamination are of those from the pool. sd is the sample "
        "standard deviation over seeds, percentage points. Modes: seeds with at most 20 %, in "
        "between, with at least 80 % success. The rival is the best row without a scorer that "
        "needs no more, and the difference from it in percentage points.",
        (
            "row", "where", "needs", "n", "good", "contamination", "AUROC", "success", "interval",
            "sd", "seeds", "low / middle / high", "rival", "failures reached", "ended by",
            "tied at cut", "missing",
        ),
        tuple(rows),
        text=(0, 1, 2),
    )  # fmt: skip


def baselines(stage: Row) -> Table:
    """What costs no scorer: the rows that everyone forgets."""
    rows = [r for r in stage["rows"] if not r["scorer"] and "@" not in r["row"]]
    return Table(
        f"Stage {stage['name']} ({stage['kind']}): what can be had without any scorer.",
        ("row", "where", "needs", "n", "good", "success", "interval", "seeds"),
        tuple(
            (
                row["row"],
                f"{row['pool']}, {row['variant']}",
                needs(row["needs"]),
                str(row["n"]),
                good_of(row),
                percent(row["rate"]),
                percent_span(row["interval"]),
                counts(row),
            )
            for row in rows
        ),
        text=(0, 1, 2),
    )


def best_cells(stage: Row) -> Table:
    """The best number kept of each scorer; chosen after looking."""
    rows = []
    for pool, variant, some in groups(stage):
        best: dict[str, Row] = {}
        for row in some:
            if is_plain(row) and row["rate"] is not None:
                known = best.get(row["scorer"])
                if known is None or row["rate"] > known["rate"]:
                    best[row["scorer"]] = row
        rows += [
            (
                row["row"],
                f"{pool}, {variant}",
                needs(row["needs"]),
                good_of(row),
                number(row["auroc"]),
                percent(row["rate"]),
                percent_span(row["interval"]),
                rival(row),
            )
            for row in sorted(best.values(), key=lambda r: -r["rate"])
        ]
    return Table(
        f"Stage {stage['name']} ({stage['kind']}): each scorer at the number kept that did best. "
        "Chosen after looking, so these are too good: a look, not a claim.",
        ("row", "where", "needs", "good", "AUROC", "success", "interval", "rival"),
        tuple(rows),
        text=(0, 1, 2),
    )


def purity(found: Row) -> Table | None:
    """The most that can be good among so many kept."""
    ceilings = {name: pool["purity_ceiling"] for name, pool in found["pools"].items()}
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


def mapping(caption: str, found: Mapping[str, Any]) -> Table:
    """Keys and values."""
    return Table(caption, ("", ""), tuple((k, str(v)) for k, v in found.items()), text=(0, 1))


def wall_times(found: Row) -> Table | None:
    """What took how long, in all runs."""
    rows = [
        (
            str(one.get("what", "")),
            str(one.get("part", "")),
            str(one.get("units", NOTHING)),
            str(one.get("steps", NOTHING)),
            number(one.get("seconds"), 1),
        )
        for one in found["seconds"]
    ]
    if not rows:
        return None
    return Table(
        "Wall time of each part of each run.",
        ("what", "part", "units", "simulation steps", "seconds"),
        tuple(rows),
        text=(0, 1),
    )
