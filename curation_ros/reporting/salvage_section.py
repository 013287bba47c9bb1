"""The section of a report on the decisions of the curator and on salvage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.decision.balance import LEAST_SHARE
from curation_ros.core.decision.decision import VERDICTS, Decision
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import JsonObject
from curation_ros.reporting import panels
from curation_ros.reporting.blocks import Block, Figure, Points, Table, Text, missing
from curation_ros.reporting.cells import NOTHING, tally
from curation_ros.reporting.drawing import figure
from curation_ros.reporting.plotting import file_name
from curation_ros.reporting.rows import groups
from curation_ros.reporting.salvage_picture import salvage_figure
from curation_ros.reporting.tables import rows_table, stage_caption
from curation_ros.study.terms import DECIDED, parse_row

_PREFIX = "decided+salvaged-"


def salvage_blocks(results: JsonObject) -> tuple[Block, ...]:
    """The section; empty if no row of the study rests on decisions of the curator."""
    rows = [row for stage in results["stages"] for row in stage["rows"]]
    if not any(term.name in DECIDED for row in rows for term in parse_row(row["row"])):
        return ()
    return tuple(_blocks(results))


def _blocks(results: JsonObject) -> Iterator[Block]:
    yield Text(
        "The curator decides with its defaults and without a reference: the first evidence that "
        "can tell. What it keeps is trained on whole (decided), of what it saw break the good "
        "beginning (salvaged), and as a control the same episodes cut anywhere (random_cut). "
        "Labels are used to count, here, and nowhere else."
    )
    yield _verdicts(results)
    yield from _margins(results)
    yield from _phases(results)
    example = results.get("salvaged_example")
    if example is not None:
        yield _picture(example)
    else:
        yield missing("an episode that was salvaged, to be shown.")


def _verdicts(results: JsonObject) -> Table:
    rows = []
    for name, pool in results["pools"].items():
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
                tally(facts["decided_by"]),
                f"{late['min']:g} / {late['median']:g} / {late['max']:g}" if late else NOTHING,
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


def _margin(row: JsonObject) -> int | None:
    """Margin of a row of the sweep in control steps; None for any other row."""
    name = str(row["row"])
    return int(name.removeprefix(_PREFIX)) if name.startswith(_PREFIX) else None


def _margins(results: JsonObject) -> Iterator[Block]:
    for stage in results["stages"]:
        swept = [
            (pool, variant, rows)
            for pool, variant, rows in groups(stage)
            if sum(_margin(r) is not None for r in rows) > 1
        ]
        if not swept:
            continue
        yield _sweep(stage, swept)
        yield rows_table(
            f"{stage_caption(stage)}: how far before the break a beginning ends, control steps.",
            ("row", "where", "margin", "good", "success", "interval", "seeds"),
            [row for _, _, rows in swept for row in rows],
            {"margin": _margin_text},
        )


def _margin_text(row: JsonObject) -> str:
    margin = _margin(row)
    return NOTHING if margin is None else str(margin)


def _sweep(stage: JsonObject, swept: Sequence[tuple[str, str, Sequence[JsonObject]]]) -> Figure:
    return figure(
        f"figure-margins-{file_name(stage['name'])}",
        f"{stage_caption(stage)}: success against the margin. Bars: 95 % "
        "intervals over training seeds and starts; lines across: rows that have no margin.",
        [
            panels.margin_panel(
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


def _phases(results: JsonObject) -> Iterator[Block]:
    alike: dict[tuple[str, str], list[JsonObject]] = {}
    for stage in results["stages"]:
        for row in stage["rows"]:
            if row.get("phases"):
                alike.setdefault((row["pool"], row["set"]), []).append(row)
    # Equal sets share a line, which has all of their names.
    known = {
        ", ".join(dict.fromkeys(row["row"] for row in rows)) + f" of {pool}": rows[0]
        for (pool, _), rows in alike.items()
    }
    if not known:
        yield missing("the phases that the training sets show.")
        return
    names = list(dict.fromkeys(name for row in known.values() for name in row["phases"]))
    yield Table(
        "Phases that each training set shows: in how many demonstrations, and in how many steps.",
        ("training set", "n", *(name.lower() for name in names)),
        tuple(
            (
                sets,
                str(row["n"]),
                *(_shown(row["phases"].get(name)) for name in names),
            )
            for sets, row in known.items()
        ),
    )
    few = []
    for sets, row in known.items():
        rare = [
            f"{name} by {shown['demonstrations']:.3g}"
            for name, shown in row["phases"].items()
            if shown["demonstrations"] < LEAST_SHARE * row["n"]
        ]
        if rare:
            few.append(f"{sets}: of {row['n']} demonstrations, {', '.join(rare)}")
    if few:
        yield Text("Phases that less than half of the demonstrations show:", is_warning=True)
        yield Points(tuple(few))


def _shown(counts: Mapping[str, float] | None) -> str:
    if counts is None:
        return NOTHING
    return f"{counts['demonstrations']:.3g} ({counts['steps']:.0f})"


# --- the picture ----------------------------------------------------------------------------


def _picture(example: Mapping[str, Any]) -> Figure:
    """Draw a salvaged episode from the data of it in the results.

    Raises:
        ConfigError: if these data are no episode with a decision.
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
