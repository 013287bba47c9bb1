"""`curation export`: decisions, scores and selections as keep.json, CSV or Parquet."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.cli.output import print_json, say
from curation_ros.dataset import Dataset
from curation_ros.exporting import FORMATS, export


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write")
    formats = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
    parser.add_argument("--format", choices=tuple(FORMATS), default="keep-json", help=formats)
    parser.add_argument(
        "--selection",
        default="",
        metavar="NAME",
        help="a selection; default: what the decisions in force keep or salvage",
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that is there")


def run(args: argparse.Namespace) -> int:
    """Write the file."""
    done = export(
        Dataset(args.dataset),
        args.out,
        args.format,
        selection=args.selection,
        force=args.force,
    )
    if args.json:
        print_json(done)
    else:
        say(f"{done['selected']} of {done['episodes']} episodes selected: {done['out']}")
    return 0
