"""`curation report`: the results of a study as a report."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.cli.output import print_json, say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "results", type=Path, help="results.json of `curation benchmark`, or the folder of it"
    )
    parser.add_argument(
        "--out", type=Path, help="folder of the report; default: the folder of the results"
    )


def run(args: argparse.Namespace) -> int:
    """Write the report and print the paths of its files."""
    from curation_ros.reporting import read_results, write_report

    path = args.results / "results.json" if args.results.is_dir() else args.results
    found = read_results(path)
    written = write_report(found, args.out or path.parent)
    missing = sum(stage["missing"] for stage in found["stages"])
    if args.json:
        print_json(
            {"report": str(written[0]), "written": [str(p) for p in written], "missing": missing}
        )
    else:
        for path in written:
            say(str(path))
        if missing:
            say(f"{missing} outcomes are missing; the report names them")
    return 0
