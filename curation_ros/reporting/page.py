"""Puts a report together: what is shown, in which order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from curation_ros.reporting import figures, published, tables
from curation_ros.reporting.answers import answers
from curation_ros.reporting.blocks import Block, Figure, Page, Points, Section, Table, Text
from curation_ros.reporting.findings import (
    Row,
    at_keep,
    groups,
    has_scorers,
    is_plain,
    is_sweep,
    main_keep,
    stages,
)
from curation_ros.reporting.salvage_section import salvage_blocks

_SCREEN = (
    "Screening: few seeds, many cells. These figures are for looking around; nothing is claimed "
    "from them. What is claimed stands among the planned contrasts."
)
_PHASES = (
    "Who supplies the phase: the simulator's phase tracker publishes it, to the recorder and to "
    "the policy alike. It is a script that reads the end-effector, the fingers, the start "
    "positions and a counter; it never reads the live pose of the object or the success."
)
_VARIANTS = {
    "relative": "effector position, start positions of object and goal, their offsets from the "
    "effector, phase; no fingers",
    "fingers": "the same and the finger positions, as the paper has them",
}


def page(found: Row) -> Page:
    """The report on a study.

    Args:
        found: results that `curation_ros.reporting.findings.check` accepts.
    """
    ranked, kept = [], []
    # A study that ranks by no scorer has nothing to show there, and nothing is missing.
    if has_scorers(found) or not found["stages"]:
        ranked = [
            Section("Detection and success", tuple(_detection(found))),
            Section("Conditions beside the paper's (Table II)", tuple(_conditions(found))),
            Section("Success against the number kept", tuple(_keep_counts(found))),
        ]
        kept = [Section("Kept and discarded demonstrations", tuple(_traces(found)))]
    salvaged = salvage_blocks(found)
    sections = (
        Section("What was asked, and the answer", (Points(tuple(answers(found))),)),
        *ranked,
        *([Section("Salvage", salvaged)] if salvaged else []),
        Section("Planned contrasts", tuple(_contrasts(found))),
        Section("Detection and length beside the paper's (Table I)", tuple(_audits(found))),
        Section("Every training set", tuple(tables.all_rows(s) for s in found["stages"])),
        *kept,
        Section("How it was done", tuple(_method(found))),
    )
    return Page(f"Study {found['name']}", found["question"], sections)


def _missing(what: str) -> Text:
    return Text(f"Missing: {what}", is_warning=True)


def _detection(found: Row) -> Iterator[Block]:
    drawings, kinds = [], set()
    for stage in found["stages"]:
        for pool, variant, rows in groups(stage):
            keep = main_keep(found, pool, rows)
            done = [r for r in at_keep(rows, keep) if r["rate"] is not None]
            # A stage of contrasts has one or two scorers: nothing to lay out.
            if keep is not None and len(done) >= 3:
                drawings.append(figures.detection_panel(stage, pool, variant, rows, keep))
                kinds.add(stage["kind"])
    if "screen" in kinds:
        yield Text(_SCREEN)
    if not drawings:
        yield _missing("no pool has outcomes of three scorers at one number kept.")
        drawings = []
    yield figures.figure(
        "figure-main",
        "AUROC against success. The AUROC is of the score that ranks: with length controlled, but "
        "for length itself. Bars: 95 % intervals, of success over training seeds and starts; "
        "dots: the policy of each training seed. Points of nearly equal AUROC are drawn beside "
        "each other. The paper's points with its standard deviations stand last. A label-free "
        "twin has an open marker.",
        [*drawings, figures.published_panel()],
    )
    for stage in found["stages"]:
        keeps = {main_keep(found, pool, rows) for pool, _, rows in groups(stage)}
        table = tables.correlations(stage, keeps)
        if table:
            yield table
        elif any(len(at_keep(rows, k)) >= 3 for _, _, rows in groups(stage) for k in keeps):
            yield _missing(f"stage {stage['name']} has no rank correlation yet.")


def _conditions(found: Row) -> Iterator[Block]:
    shown = list(stages(found, "protocol"))
    if not shown:
        yield Text("This study has no stage that follows the paper's protocol.")
    for stage in shown:
        for pool in stage["pools"]:
            yield tables.table_2(found, stage, pool)
        if stage["missing"]:
            yield _missing(f"{stage['missing']} outcomes of stage {stage['name']}.")
    if shown:
        yield Text(published.NOTE)
        yield tables.published_kept()


def _keep_counts(found: Row) -> Iterator[Block]:
    any_sweep = False
    for stage in found["stages"]:
        for pool, variant, rows in groups(stage):
            if not is_sweep(rows):
                continue
            any_sweep = True
            if stage["kind"] == "screen":
                yield Text(_SCREEN)
            if not any(r["rate"] is not None for r in rows):
                yield _missing(f"outcomes of stage {stage['name']}, {pool}, {variant}.")
            yield _sweep(found, stage, pool, variant, rows)
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
    ceilings = tables.purity(found)
    if ceilings:
        yield ceilings


def _sweep(found: Row, stage: Row, pool: str, variant: str, rows: Sequence[Row]) -> Figure:
    scorers = dict.fromkeys(r["scorer"] for r in rows if is_plain(r))
    drawings = [figures.control_panel(stage, pool, variant, rows)]
    drawings += [
        figures.keep_panel(found, stage, pool, variant, rows, scorer) for scorer in scorers
    ]
    return figures.figure(
        f"figure-keep-{figures.safe(stage['name'])}-{figures.safe(pool)}-{figures.safe(variant)}",
        f"Stage {stage['name']} ({stage['kind']}): success against the number kept. Bars: 95 % "
        "intervals; dots: the policy of each training seed; grey: mean and range of random "
        "draws; lines across: rows that keep no number. Below, the share of good demonstrations "
        "in what is kept, and the most it can be (dashed).",
        drawings,
        columns=3,
    )


def _contrasts(found: Row) -> Iterator[Block]:
    shown = [s for s in found["stages"] if s["contrasts"]]
    if not shown:
        yield Text("This study has planned no contrasts, so it claims no difference.")
    for stage in shown:
        lacking = [c for c in stage["contrasts"] if c.get("value") is None]
        if lacking:
            yield _missing(f"data for {len(lacking)} of {len(stage['contrasts'])} contrasts.")
        yield figures.figure(
            f"figure-contrasts-{figures.safe(stage['name'])}",
            f"Stage {stage['name']}: planned contrasts with 95 % intervals; filled where the "
            "adjusted p is below 0.05.",
            [figures.contrast_panel(stage)],
        )
        yield tables.contrasts(stage)


def _audits(found: Row) -> Iterator[Block]:
    for name, pool in found["pools"].items():
        yield tables.table_1(found, name)
        notes = [*pool["notes"]]
        for row in pool["audit"]:
            # The pool's own note says once what these would say in every row.
            notes += [
                f"{row['scorer']}: {note}"
                for note in row["notes"]
                if not note.startswith("not identifiable")
            ]
        if notes:
            yield Points(tuple(notes))


def _traces(found: Row) -> Iterator[Block]:
    any_traces = False
    for name, pool in found["pools"].items():
        rows = _with_episodes(found, name)
        chosen = sorted(rows, key=lambda r: (-r["auroc"], r["scorer"]))
        if not pool["traces"] or not chosen:
            continue
        any_traces = True
        ends = [chosen[0]] if len(chosen) == 1 else [chosen[0], chosen[-1]]
        yield figures.figure(
            f"figure-traces-{figures.safe(name)}",
            f"Pool {name}: what the scorers with the highest and the lowest AUROC keep and "
            "discard. Blue: succeeded, orange: failed. Every phase is drawn equally long.",
            [
                figures.traces_panel(
                    pool["traces"],
                    set(row["episodes"]),
                    f"{name}: {row['row']}, AUROC {tables.number(row['auroc'])}",
                )
                for row in ends
            ],
        )
    if not any_traces:
        yield _missing("traces, or training sets of scorers with an AUROC.")


def _with_episodes(found: Row, pool: str) -> list[Row]:
    """What each scorer keeps of a pool, at the audit's number where it is there."""
    known: dict[str, Row] = {}
    for stage in found["stages"]:
        rows = [r for r in stage["rows"] if r["pool"] == pool]
        for row in at_keep(rows, main_keep(found, pool, rows)):
            if row["episodes"] and row["auroc"] is not None and row["scorer"] != "length":
                known.setdefault(row["scorer"], row)
    return list(known.values())


def _method(found: Row) -> Iterator[Block]:
    if found["problems"]:
        yield _missing(f"{len(found['problems'])} problems:")
        yield Points(tuple(str(p) for p in found["problems"]))
    else:
        yield Text("The last run reported no problem.")
    if found.get("stages_left_out"):
        yield _missing(
            f"the last run was not asked for stages {', '.join(found['stages_left_out'])}."
        )
    yield Text(
        "Every figure here, the paper's excepted, stands in results.json, with the outcome of "
        "every rollout and the plan."
    )
    yield Text(_PHASES)
    yield Table(
        "Observations of the policies.",
        ("variant", "what a policy sees"),
        tuple(
            (v, _VARIANTS.get(v, tables.NOTHING))
            for v in dict.fromkeys(v for s in found["stages"] for v in s["variants"])
        ),
        text=(0, 1),
    )
    yield Table(
        "Stages. The same training seeds and starts for every training set of a stage; the "
        "training seed is the unit of every interval and p-value.",
        ("stage", "kind", "pools", "observations", "training seeds", "starts", "missing"),
        tuple(
            (
                s["name"],
                s["kind"],
                ", ".join(s["pools"]),
                ", ".join(s["variants"]),
                ", ".join(str(seed) for seed in s["seeds"]),
                _starts(s["starts"]),
                str(s["missing"]),
            )
            for s in found["stages"]
        ),
        text=(0, 1, 2, 3, 4, 5),
    )
    yield _demonstrations(found)
    yield _scorer_needs(found)
    looks = found["official_looks"]
    n_looks = len(looks["before"]) + len(looks["here"])
    yield Text(f"Looks at the official starts: {n_looks}" + (", namely" if n_looks else "."))
    if n_looks:
        here = [f"stage {name} of this study" for name in looks["here"]]
        yield Points((*(f"before: {text}" for text in looks["before"]), *here))
    yield _budget(found)
    yield tables.mapping("Versions.", {**found["versions"], **found["machine"]})
    times = tables.wall_times(found)
    yield times if times else _missing("wall times.")


def _demonstrations(found: Row) -> Table:
    plan = found["plan"]
    more = {"more": plan["more"]} if plan.get("more") else {}
    collected = {"reference": plan.get("reference", {}), **more, **plan.get("pools", {})}
    rows = []
    for name, settings in collected.items():
        pool = found["pools"].get(name, {})
        n = pool.get("n", tables.NOTHING)
        if name == "reference":
            n = found["reference"].get("n", tables.NOTHING)
        steps, released = pool.get("steps"), pool.get("release_steps")
        rows.append(
            (
                name,
                ", ".join(f"{key} {value}" for key, value in settings.items()),
                str(n),
                str(pool.get("n_good", tables.NOTHING)),
                f"{min(steps)} to {max(steps)}" if steps else tables.NOTHING,
                f"{min(released)} to {max(released)}" if released else tables.NOTHING,
            )
        )
    return Table(
        "Demonstrations of the scripted expert.",
        ("dataset", "collected with", "n", "good", "steps", "release at step"),
        tuple(rows),
        text=(0, 1),
    )


def _scorer_needs(found: Row) -> Table:
    scorers = dict.fromkeys(s for pool in found["pools"].values() for s in pool["needs"])
    return Table(
        "What each scorer needed, its length control included.",
        ("scorer", *found["pools"]),
        tuple(
            (
                scorer,
                *(
                    tables.needs(pool["needs"].get(scorer, [tables.NOTHING]))
                    for pool in found["pools"].values()
                ),
            )
            for scorer in scorers
        ),
        text=tuple(range(1 + len(found["pools"]))),
    )


def _budget(found: Row) -> Table:
    budget, plan = found["budget"], found["plan"]
    gives_up = (
        "yes: the object lost, or too long in one phase; such a rollout counts as failed"
        if budget.get("gives_up")
        else "no"
    )
    return tables.mapping(
        "Budget and settings.",
        {
            "simulation steps declared": budget["declared_steps"],
            "simulation steps used": budget["used_steps"],
            "steps of a rollout, at most": budget["max_steps"],
            "ended early when as good as lost": gives_up,
            "rollouts": budget["rollouts"],
            "policies": budget["policies"],
            "gradient steps of a training": plan.get("gradient_steps", tables.NOTHING),
            "selection seed": plan.get("selection_seed", tables.NOTHING),
            "hash of the plan": found["plan_hash"],
            "written": found["created_at"],
        },
    )


def _starts(names: Sequence[str]) -> str:
    if len(names) < 3:
        return ", ".join(names)
    return f"{len(names)}: {names[0]} to {names[-1]}"
