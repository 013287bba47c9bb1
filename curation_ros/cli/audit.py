"""`curation audit`: how well scores tell good from bad, and how much of that is length."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from rich.console import JustifyMethod
from rich.table import Table

from curation_ros.batch.audit import LENGTHS, Audit, AuditSettings, audit
from curation_ros.cli.arguments import add_config, add_reference
from curation_ros.cli.output import console, print_json, say, warn
from curation_ros.configuration import read_reference, read_settings, share_file
from curation_ros.core.episode.topic_map import read_topic_map
from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import SCORERS
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episodes
from curation_ros.dataset.labels import LABELS

Column: TypeAlias = Callable[[Mapping[str, Any]], str]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    add_reference(parser)
    parser.add_argument(
        "--labels",
        choices=tuple(LABELS),
        default="success",
        help="labels of truth.jsonl to compare with; "
        + "; ".join(f"{name}: {text}" for name, text in LABELS.items()),
    )
    parser.add_argument(
        "--scorers", help=f"names with commas; default: all ({', '.join(SCORERS)})"
    )
    parser.add_argument(
        "--length",
        default="",
        metavar="MODE[:VALUE]",
        help="length control; default shortest-reference, without a reference percentile:5; "
        + "; ".join(f"{name}: {text}" for name, text in LENGTHS.items()),
    )
    parser.add_argument(
        "--keep",
        default="0.75",
        metavar="FRACTION|K",
        help="how many would be kept: a share with a point, or a number; default 0.75",
    )
    parser.add_argument("--permutations", type=int, default=9999, help="default 9999")
    parser.add_argument("--seed", type=int, default=0, help="of permutations and bootstrap")
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
    dataset = Dataset(args.dataset)
    reference = read_reference(args.reference, topic_map) if args.reference else []
    episodes, problems = read_episodes(dataset, topic_map)
    for problem in problems:
        warn(problem)
    audited = audit(dataset, episodes, reference, settings)
    if args.json:
        for row in audited.rows:
            print_json({**row, "notes": [*row["notes"], *audited.notes]})
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
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise ConfigError(f"--keep {text!r}: expected a share or a number of episodes") from None


def _print(audited: Audit) -> None:
    facts = audited.facts
    control = facts["length_control"]
    mode = control["mode"] + (f":{control['value']:g}" if control["value"] is not None else "")
    of = " a phase" if control["needs"] == "phases" else ""
    steps = f", {control['steps']} steps{of}" if control["steps"] is not None else ""
    say(
        f"{facts['n_good']} good and {facts['n_bad']} bad by the label {facts['labels']!r}; "
        f"{facts['reference']} reference episodes"
    )
    say(f"length control: {mode}{steps} (needs {control['needs']})")
    for note in audited.notes:
        say(f"- {note}")
    say("")
    say("AUROC with 95 % interval (Newcombe's score method; over starts: bootstrap)")
    columns: dict[str, Column] = {
        "needs": lambda r: r["needs"],
        "raw": lambda r: _estimate(r["auroc_raw"], r["ci_raw"]),
        "controlled": lambda r: _estimate(r["auroc_controlled"], r["ci"]),
    }
    if any(row["ci_starts"] is not None for row in audited.rows):
        columns["over starts"] = lambda r: _interval(r["ci_starts"])
    _show(audited.rows, columns)
    compared = [row for row in audited.rows if row["paper"] is not None]
    if compared:
        say("")
        say("Table I of the paper; joined: its released scores, rows joined by name")
        _show(
            compared,
            {
                "raw": lambda r: _number(r["auroc_raw"]),
                "paper raw": lambda r: _number(r["paper"]["raw"]),
                "controlled": lambda r: _number(r["auroc_controlled"]),
                "paper T = 324": lambda r: _number(r["paper"]["truncated"]),
                "joined": lambda r: _number(r["paper"]["truncated_joined_by_name"]),
            },
        )
    n_kept = next((r["n_kept"] for r in audited.rows if r["n_kept"] is not None), None)
    ceiling = next(
        (r["purity_ceiling"] for r in audited.rows if r["purity_ceiling"] is not None), None
    )
    say("")
    say(
        f"The best {n_kept} kept, length controlled; a perfect ranking reaches a precision of "
        f"{_number(ceiling)} (pAUROC: up to 0.2 of the bad let through, standardised)"
    )
    _show(
        audited.rows,
        {
            "scored": lambda r: str(r["n_scored"]),
            "precision": lambda r: _number(r["precision"]),
            "clean recall": lambda r: _number(r["clean_recall"]),
            "tied at cut": lambda r: _number(r["tied_at_cut"]),
            "pAUROC": lambda r: _number(r["pauroc"]),
        },
    )
    say("")
    say(
        "Length: Spearman of score and steps, raw, controlled, and controlled within a label; "
        "AUROC of the controlled score within fifths of length (the last two p by "
        f"{facts['permutations']} permutations, seed {facts['seed']})"
    )
    _show(
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
                "not identifiable"
                if r["auroc_within_length"] is None
                else _with_p(r["auroc_within_length"], r["p_label_length_held"])
            ),
        },
    )
    for row in audited.rows:
        for note in row["notes"]:
            if not note.startswith("not identifiable"):  # the table says so
                say(f"- {row['scorer']}: {note}")


def _show(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, Column]) -> None:
    table = Table(box=None, pad_edge=False)
    table.add_column("scorer")
    for heading in columns:
        side: JustifyMethod = "left" if heading == "needs" else "right"
        table.add_column(heading, justify=side, no_wrap=True)
    for row in rows:
        table.add_row(row["scorer"].replace("_", " "), *(text(row) for text in columns.values()))
    console.print(table)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def _interval(bounds: Sequence[float] | None) -> str:
    return "-" if bounds is None else f"[{bounds[0]:.2f}, {bounds[1]:.2f}]"


def _estimate(value: float | None, bounds: Sequence[float] | None) -> str:
    return "-" if value is None else f"{value:.3f} {_interval(bounds)}"


def _with_p(value: float | None, p: float | None) -> str:
    if value is None or p is None:
        return "-"
    return f"{value:.2f} ({'<0.001' if p < 0.001 else f'{p:.3f}'})"
