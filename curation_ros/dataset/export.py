"""Exports of a dataset and its decisions, for tools that do not know this package."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from curation_ros.bags import open_bag
from curation_ros.core.decision.decision import CURATOR, Decision, in_force
from curation_ros.core.decision.manifest import Entry, Manifest
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.types import NS_PER_S, Span
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_manifest
from curation_ros.files import named_errors, write_atomically

#: Format -> what it holds. The only list; the command line is made from it.
FORMATS: dict[str, str] = {
    "keep-json": 'only the kept episodes: {"episodes": [id, ...], "names", "spans", ...}',
    "csv": "one row per episode, kept or not; span_* of the decision, selected_spans as kept",
    "parquet": "the same as csv, with types; needs the extra 'parquet'",
}
#: Columns of a row and their types, before one column `score/<scorer>` for each scorer.
COLUMNS: dict[str, type] = {
    "episode": str,
    "name": str,
    "decision": str,
    "by": str,
    "revision": int,
    "reason": str,
    "span_start_ns": int,
    "span_end_ns": int,
    "selected": bool,
    "selected_spans": str,
    "steps": int,
    "duration_s": float,
    "findings": str,
    "state_hash": str,
}
SCORE_PREFIX = "score/"


def export(
    dataset: Dataset, out: Path, file_format: str, *, selection: str = "", force: bool = False
) -> dict[str, Any]:
    """Write one file about a dataset.

    Args:
        dataset: it has the decisions and bags.
        out: the file.
        file_format: one of FORMATS.
        selection: name of a selection; empty: what the decisions in force keep or salvage.
        force: overwrite a file that exists.

    Returns:
        Path, format, number of episodes in the dataset, and of those selected.

    Raises:
        ConfigError: if the format does not exist or its library is missing.
        CurationError: if the file exists already or cannot be written, the selection cannot be
            read, or there is nothing to export.
    """
    if file_format not in FORMATS:
        raise ConfigError(f"no format {file_format!r}; there are {', '.join(FORMATS)}")
    if file_format == "parquet":
        _arrow()  # a missing library is an error before the work begins
    if out.exists() and not force:
        raise CurationError(f"{out} exists: --force overwrites it")
    names = dict(dataset.names())
    if not names:
        raise CurationError(f"dataset {dataset.path}: no episode to export")
    decided = dataset.latest_decisions()
    manifest = _manifest(dataset, selection) if selection else None
    entries = manifest.entries if manifest is not None else _kept(decided)
    selected: dict[str, list[Span | None]] = {}
    for entry in entries:
        selected.setdefault(entry.episode, []).append(entry.span)
    if file_format == "keep-json":
        if manifest is None and not decided:
            raise CurationError(
                f"dataset {dataset.path}: no decision yet: run curation score {dataset.path} "
                "--write, or name a --selection"
            )
        data = json.dumps(keep_json(entries, manifest), indent=1, allow_nan=False) + "\n"
        _write(out, data, force=force)
    else:
        rows = rows_of(dataset, names, decided, selected)
        write = _parquet if file_format == "parquet" else _csv
        _write(out, write(rows), force=force)
    return {
        "out": str(out),
        "format": file_format,
        "episodes": len(names),
        "selected": len(selected),
    }


def _manifest(dataset: Dataset, selection: str) -> Manifest:
    manifest, _ = read_manifest(dataset.selection_path(selection))
    return manifest


def _kept(decided: Mapping[str, Decision]) -> tuple[Entry, ...]:
    """What the decisions in force keep, in the order of ids; salvaged episodes with their span."""
    return tuple(
        Entry(d.episode, d.name, d.span if d.verdict == "salvage" else None)
        for _, d in sorted(decided.items())
        if d.verdict in ("keep", "salvage")
    )


def keep_json(entries: Sequence[Entry], manifest: Manifest | None) -> dict[str, Any]:
    """The kept episodes as plain data.

    Args:
        entries: what is kept; an episode may appear with several spans.
        manifest: their selection; None: the decisions in force.

    Returns:
        `episodes` (ids, each once, in the order of the entries), `names` by id, `spans` by id (for
        episodes kept in part: nanoseconds from the start, inclusive), `selection` and `rule`.
    """
    spans: dict[str, list[list[int]]] = {}
    for entry in entries:
        if entry.span is not None:
            spans.setdefault(entry.episode, []).append(list(entry.span))
    return {
        "episodes": list(dict.fromkeys(entry.episode for entry in entries)),
        "names": {entry.episode: entry.name for entry in entries},
        "spans": spans,
        "selection": manifest.name if manifest is not None else None,
        "rule": {
            "name": manifest.rule if manifest is not None else "decisions",
            "scorer": manifest.scorer if manifest is not None else "",
            **(manifest.rule_params if manifest is not None else {}),
        },
    }


def rows_of(
    dataset: Dataset,
    names: Mapping[str, str],
    decided: Mapping[str, Decision],
    selected: Mapping[str, Sequence[Span | None]],
) -> list[dict[str, Any]]:
    """One row per episode, in the order of ids; None if something is not known.

    Scores are those of the curator's last decision, even if a person has overridden it.

    Args:
        dataset: it has the bags and decision logs.
        names: id -> short name of every episode.
        decided: id -> decision in force.
        selected: id of each selected episode -> the spans that are kept; None: all of it.
    """
    scored = {
        i: in_force(d for d in dataset.decisions(i) if d.by == CURATOR).get(i) or decision
        for i, decision in decided.items()
    }
    found = {name for decision in scored.values() for name in decision.scores}
    scorers = [n for n in SCORERS if n in found] + sorted(found - set(SCORERS))
    rows = []
    for episode_id, name in sorted(names.items()):
        decision = decided.get(episode_id)
        row: dict[str, Any] = dict.fromkeys(COLUMNS)
        row |= {"episode": episode_id, "name": name, "selected": episode_id in selected}
        if episode_id in selected:
            spans = selected[episode_id]
            row["selected_spans"] = " ".join(f"{s[0]}:{s[1]}" if s else "all" for s in spans)
        row["steps"], row["duration_s"] = _extent(dataset, episode_id)
        row |= dict.fromkeys(SCORE_PREFIX + s for s in scorers)
        if decision is not None:
            row |= {
                "decision": decision.verdict,
                "by": decision.by,
                "revision": decision.revision,
                "reason": decision.reason,
                "span_start_ns": decision.span[0],
                "span_end_ns": decision.span[1],
                "findings": " ".join(f.id for f in decision.findings),
                "state_hash": decision.state_hash,
            }
            row |= {SCORE_PREFIX + k: v for k, v in scored[episode_id].scores.items()}
        rows.append(row)
    return rows


def _extent(dataset: Dataset, episode_id: str) -> tuple[int | None, float | None]:
    """Steps and seconds of an episode, as its owner counted them; None if it did not."""
    try:
        bag = open_bag(dataset.bag_path(episode_id))
        event, topic_map = bag.event(), bag.topic_map()
    except CurationError:  # the bag is gone or broken: the decision still has its row
        return None, None
    if event is None or topic_map is None or event.end_ns is None:
        return None, None
    steps = event.counts.get(topic_map.clock_topic)
    return steps, (event.end_ns - event.start_ns) / NS_PER_S


def _csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Text with a header; floats by `repr`, unknown values empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().encode()


def _arrow() -> Any:
    try:
        import pyarrow as pa
        import pyarrow.parquet
    except ModuleNotFoundError as err:
        raise ConfigError(
            "format 'parquet' needs pyarrow: pip install 'curation_ros[parquet]'"
        ) from err
    return pa


def _parquet(rows: Sequence[Mapping[str, Any]]) -> bytes:
    pa = _arrow()
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64(), bool: pa.bool_()}
    schema = pa.schema([(name, kinds[COLUMNS.get(name, float)]) for name in rows[0]])
    sink = io.BytesIO()
    pa.parquet.write_table(pa.Table.from_pylist(list(rows), schema=schema), sink)
    return sink.getvalue()


def _write(path: Path, data: str | bytes, *, force: bool) -> None:
    """Write a whole file or nothing.

    Raises:
        CurationError: if it exists and must not be overwritten, or cannot be written.
    """
    with named_errors(path):
        try:
            write_atomically(path, data, replace=force)
        except FileExistsError as err:
            raise CurationError(f"{path} exists: --force overwrites it") from err
