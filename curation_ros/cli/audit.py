"""`curation audit`: how well scores tell good from bad, and how much of that is length."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

from rich.console import JustifyMethod
from rich.table import Table

from curation_ros.batch.audit import Audit, AuditSettings, audit_dataset
from curation_ros.batch.audit_length import LENGTHS
from curation_ros.batch.audit_rows import NOT_IDENTIFIABLE
from curation_ros.cli.arguments import add_config, add_reference
from curation_ros.cli.output import console, print_json, say, warn
from curation_ros.configuration import read_settings, share_file
from curation_ros.core.episode.topic_map import read_topic_map
from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.types import JsonObject
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.labels import LABELS
from curation_ros.reporting.cells import interval, number, with_interval

Column: TypeAlias = Callable[[JsonObject], str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    add_reference(parser)
    parser.add_argument(
        "--labels",
        choices=tuple(LABELS),
        default="success",
        help="kind of label in truth.jsonl to compare with. "
        + ". ".join(f"{name}: {text}" for name, text in LABELS.items()),
    )
    parser.add_argument(
        "--scorers", help=f"names separated by commas; default: all ({', '.join(SCORERS)})"
    )
    parser.add_argument(
        "--length",
        default="",
        metavar="MODE[:VALUE]",
        help="length control; default: shortest-reference, or percentile:5 without a reference. "
        + ". ".join(f"{name}: {text}" for name, text in LENGTHS.items()),
    )
    parser.add_argument(
        "--keep",
        default="0.75",
        metavar="FRACTION|K",
        help="how many to keep: a share with a decimal point, or a number; default: 0.75",
    )
    parser.add_argument(
        "--permutations", type=int, default=9999, help="permutations in each test; default: 9999"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of permutations and bootstrap; default: 0"
    )
    add_config(parser)


def run(args: argparse.Namespace) -> int:
    """Audit and print."""
    configured = read_settings(args.config or share_file("config/curation.yaml"), {})
    length, value = _length(args.length)
    settings = AuditSettings(
        labels=args.labels,
        scorers=tuple(n.strip() for n in (args.scorers or ",".join(SCORERS)).split(",")),
        scorer_params=configured.scorer_params,
        length=length,
        length_value=value,
        keep=_keep(args.keep),
        n_permutations=args.permutations,
        seed=args.seed,
    )
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    audited = audit_dataset(Dataset(args.dataset), args.reference, settings, topic_map)
    for problem in audited.problems:
        warn(problem)
    if args.json:
        for row in audited.to_json():
            print_json(row)
    else:
        _print(audited)
    return 0


def _length(text: str) -> tuple[str, float | None]:
    mode, colon, value = text.partition(":")
    if not colon:
        return mode, None
    try:
        return mode, float(value)
    except ValueError:
        raise ConfigError(f"--length {text!r}: {value!r} is no number") from None


def _keep(text: str) -> float | int:
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    raise ConfigError(f"--keep {text!r}: expected a share or a number of episodes")


# --- tables for people --------------------------------------------------------------------------


def _print(audited: Audit) -> None:
    _print_facts(audited)
    _print_detection(audited.rows)
    _print_paper([row for row in audited.rows if row["paper"] is not None])
    _print_kept(audited.rows)
    _print_length(audited)
    for row in audited.rows:
        for note in row["notes"]:
            if not note.startswith(NOT_IDENTIFIABLE):  # the table shows these
                say(f"- {row['scorer']}: {note}")


def _print_facts(audited: Audit) -> None:
    facts = audited.facts
    control = facts["length_control"]
    mode = control["mode"] + (f":{control['value']:g}" if control["value"] is not None else "")
    per = " per phase" if control["needs"] == "phases" else ""
    steps = f", {control['steps']} steps{per}" if control["steps"] is not None else ""
    say(
        f"{facts['n_good']} good and {facts['n_bad']} bad by the label {facts['labels']!r}; "
        f"{facts['reference']} reference episodes"
    )
    say(f"length control: {mode}{steps} (needs {control['needs']})")
    for note in audited.notes:
        say(f"- {note}")


def _print_detection(rows: Sequence[JsonObject]) -> None:
    columns: dict[str, Column] = {
        "needs": lambda r: str(r["needs"]),
        "raw": lambda r: with_interval(r["auroc_raw"], r["ci_raw"]),
        "controlled": lambda r: with_interval(r["auroc_controlled"], r["ci"]),
    }
    if any(row["ci_starts"] is not None for row in rows):
        columns["over starts"] = lambda r: interval(r["ci_starts"])
    _print_table(
        "AUROC with 95 % interval (Newcombe's score method; over starts: bootstrap)", rows, columns
    )


def _print_paper(rows: Sequence[JsonObject]) -> None:
    if not rows:
        return
    _print_table(
        "Table I of the paper; joined: its released scores, with rows joined by name",
        rows,
        {
            "raw": lambda r: number(r["auroc_raw"]),
            "paper raw": lambda r: number(r["paper"]["raw"]),
            "controlled": lambda r: number(r["auroc_controlled"]),
            "paper T = 324": lambda r: number(r["paper"]["truncated"]),
            "joined": lambda r: number(r["paper"]["truncated_joined_by_name"]),
        },
    )


def _print_kept(rows: Sequence[JsonObject]) -> None:
    n_kept, ceiling = (
        next((row[key] for row in rows if row[key] is not None), None)
        for key in ("n_kept", "purity_ceiling")
    )
    _print_table(
        f"The best {n_kept} kept, with length controlled; a perfect ranking has a precision of "
        f"{number(ceiling)} (pAUROC: up to 0.2 of the bad ones accepted, standardised)",
        rows,
        {
            "scored": lambda r: str(r["n_scored"]),
            "precision": lambda r: number(r["precision"]),
            "clean recall": lambda r: number(r["clean_recall"]),
            "tied at cut": lambda r: number(r["tied_at_cut"]),
            "pAUROC": lambda r: number(r["pauroc"]),
        },
    )


def _print_length(audited: Audit) -> None:
    _print_table(
        "Length: Spearman's correlation of score and steps, raw, controlled, and controlled "
        "within a label; AUROC of the controlled score within fifths of length (the last two p "
        f"by {audited.facts['permutations']} permutations, seed {audited.facts['seed']})",
        audited.rows,
        {
            "raw (p)": lambda r: _with_p(r["spearman_length"], r["spearman_length_p"]),
            "controlled (p)": lambda r: _with_p(
                r["spearman_length_controlled"], r["spearman_length_controlled_p"]
            ),
            "label held (p)": lambda r: _with_p(
                r["spearman_within_label"], r["p_length_label_held"]
            ),
            "at equal length (p)": lambda r: (
                NOT_IDENTIFIABLE
                if r["auroc_within_length"] is None
                else _with_p(r["auroc_within_length"], r["p_label_length_held"])
            ),
        },
    )


def _print_table(title: str, rows: Sequence[JsonObject], columns: Mapping[str, Column]) -> None:
    say("")
    say(title)
    table = Table(box=None, pad_edge=False)
    table.add_column("scorer")
    for heading in columns:
        side: JustifyMethod = "left" if heading == "needs" else "right"
        table.add_column(heading, justify=side, no_wrap=True)
    for row in rows:
        table.add_row(row["scorer"].replace("_", " "), *(text(row) for text in columns.values()))
    console.print(table)


def _with_p(value: float | None, p: float | None) -> str:
    if value is None or p is None:
        return "-"
    return f"{value:.2f} ({'<0.001' if p < 0.001 else f'{p:.3f}'})"
