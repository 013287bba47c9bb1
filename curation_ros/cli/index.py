"""`curation index`: lists a dataset; rebuilds its index, which is only a cache."""

from __future__ import annotations

import argparse
from pathlib import Path

from rich.table import Table
from rich.text import Text

from curation_ros.cli.output import VERDICT_STYLE, console, print_json, warn
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    parser.add_argument(
        "--rebuild", action="store_true", help="rebuild the index from bags and decision logs"
    )


def run(args: argparse.Namespace) -> int:
    """Refresh or rebuild, then list the episodes with the decisions in force."""
    dataset = Dataset(args.dataset)
    if dataset.index.elsewhere:
        warn(f"{dataset.index.elsewhere}; its index is {dataset.index.path}")
    for problem in dataset.rebuild() if args.rebuild else dataset.refresh():
        warn(problem)
    decided = dataset.latest_decisions()
    table = Table(box=None, pad_edge=False)
    for heading in ("episode", "decision", "by"):
        table.add_column(heading, no_wrap=True)
    table.add_column("seconds", justify="right")
    table.add_column("reason", ratio=1)
    for episode in dataset.index.episodes():
        decision = decided.get(episode.id)
        verdict = decision.verdict if decision is not None else None
        by = decision.by if decision is not None else None
        reason = decision.reason if decision is not None else ""
        seconds = episode.duration_ns / NS_PER_S
        if args.json:
            print_json(
                {
                    "episode": episode.id,
                    "name": episode.name,
                    "path": str(dataset.path / episode.path),
                    "decision": verdict,
                    "by": by,
                    "reason": reason,
                    "recovered": episode.is_recovered,
                }
            )
        else:
            shown = Text(verdict or "undecided", VERDICT_STYLE.get(verdict or "", "dim"))
            name = Text(episode.name or episode.id[:8])
            table.add_row(name, shown, Text(by or ""), f"{seconds:.1f}", Text(reason))
    if not args.json:
        console.print(table)
    return 0
