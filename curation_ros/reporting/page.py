"""Puts a report together: what it shows, and in which order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.batch import published
from curation_ros.batch.audit_rows import NOT_IDENTIFIABLE
from curation_ros.core.types import JsonObject
from curation_ros.reporting import panels, tables
from curation_ros.reporting.answers import answers
from curation_ros.reporting.blocks import Block, Figure, Page, Points, Section, Text, missing
from curation_ros.reporting.cells import number
from curation_ros.reporting.drawing import figure
from curation_ros.reporting.method_section import method_blocks
from curation_ros.reporting.plotting import file_name
from curation_ros.reporting.rows import (
    groups,
    has_scorers,
    is_scorer_row,
    is_sweep,
    kept_by_scorers,
    main_keep,
    stages_of_kind,
)
from curation_ros.reporting.salvage_section import salvage_blocks

#: Phases of a pool in results that do not name them: those of the first task.
_FIRST_PHASES = ("PREGRASP", "DESCEND", "GRASP", "LIFT", "TRANSPORT", "RELEASE")
_SCREEN = (
    "Screening: few seeds, many cells. These figures are for looking around; nothing is claimed "
    "from them. What is claimed stands among the planned contrasts."
)


def build_page(results: JsonObject) -> Page:
    """Build the report on a study.

    Args:
        results: as `curation_ros.study.results_format.check_results` accepts them.
    """
    ranked, kept = [], []
    # A study that uses no scorer has nothing to show in these sections, and nothing is missing.
    if has_scorers(results) or not results["stages"]:
        ranked = [
            Section("Detection and success", tuple(_detection(results))),
            Section("Conditions beside the paper's (Table II)", tuple(_conditions(results))),
            Section("Success against the number kept", tuple(_keep_counts(results))),
        ]
        kept = [Section("Kept and discarded demonstrations", tuple(_traces(results)))]
    salvaged = salvage_blocks(results)
    sections = (
        Section("What was asked, and the answer", (Points(tuple(answers(results))),)),
        *ranked,
        *([Section("Salvage", salvaged)] if salvaged else []),
        Section("Planned contrasts", tuple(_contrasts(results))),
        Section("Detection and length beside the paper's (Table I)", tuple(_audits(results))),
        Section("Every training set", tuple(tables.all_rows(s) for s in results["stages"])),
        *kept,
        Section("How it was done", tuple(method_blocks(results))),
    )
    return Page(f"Study {results['name']}", results["question"], sections)


def _detection(results: JsonObject) -> Iterator[Block]:
    drawings, kinds = [], set()
    for stage in results["stages"]:
        for pool, variant, rows in groups(stage):
            keep = main_keep(results, pool, rows)
            done = [r for r in kept_by_scorers(rows, keep) if r["rate"] is not None]
            # A stage of contrasts has one or two scorers, too few for this figure.
            if keep is not None and len(done) >= 3:
                drawings.append(panels.detection_panel(stage, pool, variant, rows, keep))
                kinds.add(stage["kind"])
    if "screen" in kinds:
        yield Text(_SCREEN)
    if not drawings:
        yield missing("no pool has outcomes of three scorers at one number kept.")
        drawings = []
    yield figure(
        "figure-main",
        "AUROC against success. The AUROC is of the score that ranks: with length controlled, but "
        "for length itself. Bars: 95 % intervals, of success over training seeds and starts; "
        "dots: the policy of each training seed. Points of nearly equal AUROC are drawn beside "
        "each other. The paper's points with its standard deviations stand last. A label-free "
        "twin has an open marker.",
        [*drawings, panels.published_panel()],
    )
    for stage in results["stages"]:
        keeps = {main_keep(results, pool, rows) for pool, _, rows in groups(stage)}
        table = tables.correlations(stage, keeps)
        if table:
            yield table
        elif any(
            len(kept_by_scorers(rows, k)) >= 3 for _, _, rows in groups(stage) for k in keeps
        ):
            yield missing(f"stage {stage['name']} has no rank correlation yet.")


def _conditions(results: JsonObject) -> Iterator[Block]:
    shown = list(stages_of_kind(results, "protocol"))
    if not shown:
        yield Text("This study has no stage that follows the paper's protocol.")
    for stage in shown:
        for pool in stage["pools"]:
            yield tables.table_2(results, stage, pool)
        if stage["missing"]:
            yield missing(f"{stage['missing']} outcomes of stage {stage['name']}.")
    if shown:
        yield Text(published.NOTE)
        yield tables.published_kept()


def _keep_counts(results: JsonObject) -> Iterator[Block]:
    any_sweep = False
    for stage in results["stages"]:
        for pool, variant, rows in groups(stage):
            if not is_sweep(rows):
                continue
            any_sweep = True
            if stage["kind"] == "screen":
                yield Text(_SCREEN)
            if not any(r["rate"] is not None for r in rows):
                yield missing(f"outcomes of stage {stage['name']}, {pool}, {variant}.")
            yield _sweep(results, stage, pool, variant, rows)
        if any(r["scorer"] for r in stage["rows"]) and any(
            is_sweep(rows) for _, _, rows in groups(stage)
        ):
            yield tables.best_cells(stage)
            yield tables.baselines(stage)
            table = tables.correlations(stage)
            if table:
                yield table
    if not any_sweep:
        yield Text("This study keeps fewer than three different numbers: there is no curve.")
    ceilings = tables.purity(results)
    if ceilings:
        yield ceilings


def _sweep(
    results: JsonObject, stage: JsonObject, pool: str, variant: str, rows: Sequence[JsonObject]
) -> Figure:
    scorers = dict.fromkeys(r["scorer"] for r in rows if is_scorer_row(r))
    drawings = [panels.control_panel(stage, pool, variant, rows)]
    drawings += [
        panels.keep_panel(results, stage, pool, variant, rows, scorer) for scorer in scorers
    ]
    return figure(
        f"figure-keep-{file_name(stage['name'])}-{file_name(pool)}-{file_name(variant)}",
        f"{tables.stage_caption(stage)}: success against the number kept. Bars: 95 % "
        "intervals; dots: the policy of each training seed; grey: mean and range of random "
        "draws; lines across: rows that keep no number. Below, the share of good demonstrations "
        "in what is kept, and the most it can be (dashed).",
        drawings,
        columns=3,
    )


def _contrasts(results: JsonObject) -> Iterator[Block]:
    shown = [s for s in results["stages"] if s["contrasts"]]
    if not shown:
        yield Text("This study has planned no contrasts, so it claims no difference.")
    for stage in shown:
        lacking = [c for c in stage["contrasts"] if c.get("value") is None]
        if lacking:
            yield missing(f"data for {len(lacking)} of {len(stage['contrasts'])} contrasts.")
        yield figure(
            f"figure-contrasts-{file_name(stage['name'])}",
            f"Stage {stage['name']}: planned contrasts with 95 % intervals; filled where the "
            "adjusted p is below 0.05.",
            [panels.contrast_panel(stage)],
        )
        yield tables.contrasts(stage)


def _audits(results: JsonObject) -> Iterator[Block]:
    for name, pool in results["pools"].items():
        yield tables.table_1(results, name)
        notes = [*pool["notes"]]
        for row in pool["audit"]:
            # The notes of the pool say this once for all rows.
            notes += [
                f"{row['scorer']}: {note}"
                for note in row["notes"]
                if not note.startswith(NOT_IDENTIFIABLE)
            ]
        if notes:
            yield Points(tuple(notes))


def _traces(results: JsonObject) -> Iterator[Block]:
    any_traces = False
    for name, pool in results["pools"].items():
        rows = _with_episodes(results, name)
        chosen = sorted(rows, key=lambda r: (-r["auroc"], r["scorer"]))
        if not pool["traces"] or not chosen:
            continue
        any_traces = True
        ends = [chosen[0]] if len(chosen) == 1 else [chosen[0], chosen[-1]]
        yield figure(
            f"figure-traces-{file_name(name)}",
            f"Pool {name}: what the scorers with the highest and the lowest AUROC keep and "
            "discard. Blue: succeeded, orange: failed. Every phase is drawn equally long.",
            [
                panels.traces_panel(
                    pool["traces"],
                    pool.get("phases", _FIRST_PHASES),
                    set(row["episodes"]),
                    f"{name}: {row['row']}, AUROC {number(row['auroc'])}",
                )
                for row in ends
            ],
        )
    if not any_traces:
        yield missing("traces, or training sets of scorers with an AUROC.")


def _with_episodes(results: JsonObject, pool: str) -> list[JsonObject]:
    """The rows with the episodes that each scorer keeps of a pool, one row per scorer."""
    known: dict[str, JsonObject] = {}
    for stage in results["stages"]:
        rows = [r for r in stage["rows"] if r["pool"] == pool]
        for row in kept_by_scorers(rows, main_keep(results, pool, rows)):
            if row["episodes"] and row["auroc"] is not None and row["scorer"] != "length":
                known.setdefault(row["scorer"], row)
    return list(known.values())
