"""`curation override`: a person's decision, which outranks the curator's."""

from __future__ import annotations

import argparse
import getpass
from pathlib import Path

from curation_ros.cli.output import print_json, say
from curation_ros.core.decision.decision import VERDICTS
from curation_ros.core.errors import ConfigError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_override


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    parser.add_argument("episode", help="short name, id, or the beginning of an id")
    parser.add_argument("verdict", choices=VERDICTS)
    parser.add_argument(
        "--until",
        type=float,
        metavar="SECONDS",
        help="with salvage: end of the part that is kept, from the start of the episode",
    )
    parser.add_argument("--reason", default="", help="in your own words")
    parser.add_argument("--by", default="", help="your name; default: the name of the user")


def run(args: argparse.Namespace) -> int:
    """Log the decision."""
    if (args.verdict == "salvage") != (args.until is not None):
        raise ConfigError("--until belongs to salvage, and salvage needs --until SECONDS")
    decision = log_override(
        Dataset(args.dataset),
        args.episode,
        args.verdict,
        args.reason,
        args.by or _user(),
        until_s=args.until,
    )
    if args.json:
        print_json(decision.to_json())
    else:
        text = f"{decision.verdict} {decision.name} (revision {decision.revision})"
        say(f"{text}: {decision.reason}")
    return 0


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return "person"
