"""`curation select`: from decisions or scores to a manifest, which is all that training reads."""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path

from curation_ros.cli.arguments import add_rule
from curation_ros.cli.output import print_json, say, warn
from curation_ros.core.decision.manifest import Manifest
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    add_rule(parser, default="gap with --scorer, else decisions")
    parser.add_argument("--scorer", default="", help="the scorer to rank by")
    parser.add_argument("--name", default="", help="name of the selection; default: rule and time")
    parser.add_argument("--seed", type=int, default=0, help="orders equal scores; default 0")


def run(args: argparse.Namespace) -> int:
    """Write the manifest, and print what it holds."""
    dataset = Dataset(args.dataset)
    manifest, path = save_selection(
        dataset,
        rule=args.rule,
        value=args.value,
        method=args.method,
        scorer=args.scorer,
        name=args.name,
        seed=args.seed,
    )
    if args.json:
        phases = manifest.phases
        print_json(
            {
                "manifest": str(path),
                "kept": len(manifest.entries),
                "of": manifest.kept_of,
                "rule": manifest.rule,
                "phases": phases.to_json() if phases is not None else None,
                "warnings": manifest.warnings(),
            }
        )
        return 0
    _print(manifest, path, dataset)
    return 0


def _print(manifest: Manifest, path: Path, dataset: Dataset) -> None:
    kept = len(manifest.entries)
    salvaged = sum(entry.span is not None for entry in manifest.entries)
    part = f", {salvaged} of them in part" if salvaged else ""
    say(f"kept {kept} of {manifest.kept_of}{part}: {path}")
    if manifest.rule != "decisions":
        decided = dataset.latest_decisions()
        verdicts = Counter(
            decided[e.episode].verdict for e in manifest.entries if e.episode in decided
        )
        if doubted := verdicts["review"] + verdicts["discard"]:
            say(f"{doubted} of these are marked review or discard")
        if verdicts["salvage"]:
            say(
                f"{verdicts['salvage']} of these are marked salvage: this selection keeps them "
                "whole; --rule decisions keeps the good part"
            )
    if manifest.abstained:
        say(f"{len(manifest.abstained)} could not be decided on")
    if manifest.phases is not None and kept:
        say(manifest.phases.describe())
    for line in manifest.warnings():
        warn(line)
