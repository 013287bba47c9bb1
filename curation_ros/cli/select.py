"""`curation select`: from decisions or scores to a manifest, which is all that training reads."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.cli.output import print_json, say, warn
from curation_ros.core.decision.selection import KEEP_RULES
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    rules = "; ".join(f"{name}: {text}" for name, text in KEEP_RULES.items())
    parser.add_argument(
        "--rule",
        choices=tuple(KEEP_RULES),
        default="",
        help=f"default: gap with --scorer, else decisions; {rules}",
    )
    parser.add_argument("--value", type=float, help="what the rule takes")
    parser.add_argument("--scorer", default="", help="whose scores rank")
    parser.add_argument("--name", default="", help="of the selection; default: rule and time")
    parser.add_argument("--seed", type=int, default=0, help="of the order of equal scores")


def run(args: argparse.Namespace) -> int:
    """Write the manifest."""
    dataset = Dataset(args.dataset)
    manifest, path = save_selection(
        dataset,
        rule=args.rule,
        value=args.value,
        scorer=args.scorer,
        name=args.name,
        seed=args.seed,
    )
    kept = len(manifest.entries)
    if args.json:
        phases = manifest.phases
        print_json(
            {
                "manifest": str(path),
                "kept": kept,
                "of": manifest.kept_of,
                "rule": manifest.rule,
                "phases": phases.to_json() if phases is not None else None,
                "warnings": phases.warnings() if phases is not None else [],
            }
        )
    else:
        salvaged = sum(entry.span is not None for entry in manifest.entries)
        part = f", {salvaged} of them in part" if salvaged else ""
        say(f"kept {kept} of {manifest.kept_of}{part}: {path}")
        if manifest.rule != "decisions":
            decided = dataset.latest_decisions()
            doubted = sum(
                e.episode in decided and decided[e.episode].verdict in ("review", "discard")
                for e in manifest.entries
            )
            if doubted:
                say(f"{doubted} of these are decided to be reviewed or discarded")
            partly = sum(
                e.episode in decided and decided[e.episode].verdict == "salvage"
                for e in manifest.entries
            )
            if partly:
                say(
                    f"{partly} of these are decided to be kept in part: here they are whole; "
                    "--rule decisions keeps the part"
                )
        if manifest.abstained:
            say(f"{len(manifest.abstained)} could not be judged")
        if manifest.phases is not None and kept:
            say(manifest.phases.describe())
            for line in manifest.phases.warnings():
                warn(line)
    return 0
