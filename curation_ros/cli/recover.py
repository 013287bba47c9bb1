"""`curation recover`: saves what an interrupted or damaged bag still holds, in a new bag."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.bags.recovery import recover_bag
from curation_ros.cli.output import print_json, say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("bag", type=Path, help="a bag, or its .mcap file; it is not changed")
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the new bag")


def run(args: argparse.Namespace) -> int:
    """Copy every whole message."""
    report = recover_bag(args.bag, args.out)
    if args.json:
        print_json(
            {"path": str(report.path), "messages": dict(report.messages), "tail": report.tail}
        )
    else:
        n = sum(report.messages.values())
        say(f"{report.path}: {n} messages of {len(report.messages)} topics; {report.tail}")
    return 0
