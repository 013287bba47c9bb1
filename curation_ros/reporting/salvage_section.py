"""The section of a report on what the curator decides, and on what it salvages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.decision.balance import LEAST_SHARE
from curation_ros.core.decision.decision import VERDICTS, Decision
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.reporting import figures, tables
from curation_ros.reporting.blocks import Block, Figure, Points, Table, Text
from curation_ros.reporting.findings import Row, groups
from curation_ros.reporting.salvaged import salvage_figure
from curation_ros.study.plan import DECIDED, parse_row

_PREFIX = "decided+salvaged-"


def salvage_blocks(found: Row) -> tuple[Block, ...]:
    """What a report says of it; nothing where a study has no such row."""
    rows = [row for stage in found["stages"] for row in stage["rows"]]
    if not any(term.name in DECIDED for row in rows for term in parse_row(row["row"])):
        return ()
    return tuple(_blocks(found))


def _blocks(found: Row) -> Iterator[Block]:
    yield Text(
        "The curator decides with its defaults and without a reference: the first evidence that "
        "can tell. What it keeps is trained on whole (decided), of what it saw break the good "
        "beginning (salvaged), and as a control the same episodes cut anywhere (random_cut). "
        "Labels are used to count, here, and nowhere else."
    )
    yield _verdicts(found)
    yield from _margins(found)
    yield from _phases(found)
    example = found.get("salvaged_example")
    if example is not None:
        yield _picture(example)
    else:
        yield Text("Missing: an episode that was salvaged, to be shown.", is_warning=True)


def _verdicts(found: Row) -> Table:
    rows = []
    for name, pool in found["pools"].items():
        facts = pool.get("curator")
        if facts is None:
            continue
        counts = facts["verdicts"]
        late = facts["cut_minus_release"]
        rows.append(
            (
                name,
                *(
                    f"{counts[v]['good']} good, {counts[v]['defective']} defective"
                    for v in VERDICTS
                ),
                tables.counted(facts["decided_by"]),
                f"{late['min']:g} / {late['median']:g} / {late['max']:g}"
                if late
                else tables.NOTHING,
                str(late["n"]) if late else "0",
            )
        )
    return Table(
        "Decisions against the truth. The cut is the last step that is kept; the release is the "
        "step at which the gripper was made to open too early: smallest, middle and largest "
        "difference, and of how many.",
        ("pool", *VERDICTS, "decided by", "cut minus release, steps", "of"),
        tuple(rows),
        text=tuple(range(len(VERDICTS) + 2)),
    )


# --- margins --------------------------------------------------------------------------------


def _margin(row: Row) -> int | None:
    """Control steps of a row of the sweep; None of another row."""
    name = str(row["row"])
    return int(name.removeprefix(_PREFIX)) if name.startswith(_PREFIX) else None


def _margins(found: Row) -> Iterator[Block]:
    for stage in found["stages"]:
        swept = [
            (pool, variant, rows)
            for pool, variant, rows in groups(stage)
            if sum(_margin(r) is not None for r in rows) > 1
        ]
        if not swept:
            continue
        yield _sweep(stage, swept)
        cells = []
        for pool, variant, rows in swept:
            for row in rows:
                margin = _margin(row)
                cells.append(
                    (
                        row["row"],
                        f"{pool}, {variant}",
                        tables.NOTHING if margin is None else str(margin),
                        tables.good_of(row),
                        tables.percent(row["rate"]),
                        tables.percent_span(row["interval"]),
                        tables.counts(row),
                    )
                )
        yield Table(
            f"Stage {stage['name']} ({stage['kind']}): how far before the break a beginning ends, "
            "control steps.",
            ("row", "where", "margin", "good", "success", "interval", "seeds"),
            tuple(cells),
            text=(0, 1),
        )


def _sweep(stage: Row, swept: Sequence[tuple[str, str, Sequence[Row]]]) -> Figure:
    return figures.figure(
        f"figure-margins-{figures.safe(stage['name'])}",
        f"Stage {stage['name']} ({stage['kind']}): success against the margin. Bars: 95 % "
        "intervals over training seeds and starts; lines across: rows that have no margin.",
        [
            figures.margin_panel(
                stage,
                pool,
                variant,
                [(m, r) for r in rows if (m := _margin(r)) is not None],
                [r for r in rows if _margin(r) is None],
            )
            for pool, variant, rows in swept
        ],
    )


# --- phases ---------------------------------------------------------------------------------


def _phases(found: Row) -> Iterator[Block]:
    alike: dict[tuple[str, str], list[Row]] = {}
    for stage in found["stages"]:
        for row in stage["rows"]:
            if row.get("phases"):
                alike.setdefault((row["pool"], row["set"]), []).append(row)
    # Equal sets are one line, under all of their names.
    known = {
        ", ".join(dict.fromkeys(row["row"] for row in rows)) + f" of {pool}": rows[0]
        for (pool, _), rows in alike.items()
    }
    if not known:
        yield Text("Missing: the phases that the training sets show.", is_warning=True)
        return
    names = list(dict.fromkeys(name for row in known.values() for name in row["phases"]))
    yield Table(
        "Phases that each training set shows: in how many demonstrations, and in how many steps.",
        ("training set", "n", *(name.lower() for name in names)),
        tuple(
            (
                title,
                str(row["n"]),
                *(_shown(row["phases"].get(name)) for name in names),
            )
            for title, row in known.items()
        ),
    )
    few = []
    for title, row in known.items():
        rare = [
            f"{name} by {shown['demonstrations']:.3g}"
            for name, shown in row["phases"].items()
            if shown["demonstrations"] < LEAST_SHARE * row["n"]
        ]
        if rare:
            few.append(f"{title}: of {row['n']} demonstrations, {', '.join(rare)}")
    if few:
        yield Text("Phases that less than half of the demonstrations show:", is_warning=True)
        yield Points(tuple(few))


def _shown(found: Mapping[str, float] | None) -> str:
    if found is None:
        return tables.NOTHING
    return f"{found['demonstrations']:.3g} ({found['steps']:.0f})"


# --- the picture ----------------------------------------------------------------------------


def _picture(example: Mapping[str, Any]) -> Figure:
    """One salvaged episode, drawn from what the results hold of it.

    Raises:
        ConfigError: if they do not hold one.
    """
    try:
        decision = Decision.from_json(example["decision"])
        episode = Episode(
            id=decision.episode,
            name=decision.name,
            start_ns=int(example["start_ns"]),
            end_ns=int(example["end_ns"]),
            stamps_ns=np.asarray(example["stamps_ns"], dtype=np.int64),
            fields={str(k): np.asarray(v, dtype=np.float64) for k, v in example["fields"].items()},
            topic_map=topic_map_or_default(""),
        )
        return salvage_figure(episode, decision, "figure-salvaged")
    except (CurationError, KeyError, TypeError, ValueError, IndexError, AttributeError) as err:
        raise ConfigError(f"salvaged_example: {type(err).__name__}: {err}") from err
