"""`curation export`: decisions, scores and selections as keep.json, CSV or Parquet."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.cli.output import print_json, say
from curation_ros.core.errors import ConfigError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.export import FORMATS, export

_ENDINGS = {".json": "keep-json", ".csv": "csv", ".parquet": "parquet"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file to write")
    formats = "; ".join(f"{name}: {text}" for name, text in FORMATS.items())
    parser.add_argument(
        "--format", choices=tuple(FORMATS), help=f"default: by the ending of FILE; {formats}"
    )
    parser.add_argument(
        "--selection",
        default="",
        metavar="NAME",
        help="a selection; default: what the decisions in force keep or salvage",
    )
    parser.add_argument("--force", action="store_true", help="overwrite a file that exists")


def run(args: argparse.Namespace) -> int:
    """Write the file."""
    by_ending = _ENDINGS.get(args.out.suffix.lower())
    if args.format is None and by_ending is None:
        raise ConfigError(
            f"--out {args.out}: its ending is none of {', '.join(_ENDINGS)}; name a --format"
        )
    if args.format is not None and by_ending not in (None, args.format):
        raise ConfigError(f"--out {args.out} is not --format {args.format}: another ending")
    if not args.out.absolute().parent.is_dir():
        raise ConfigError(f"--out {args.out}: there is no folder {args.out.absolute().parent}")
    done = export(
        Dataset(args.dataset),
        args.out,
        args.format or by_ending or "",
        selection=args.selection,
        force=args.force,
    )
    if args.json:
        print_json(done)
    else:
        say(f"{done['selected']} of {done['episodes']} episodes selected: {done['out']}")
    return 0
