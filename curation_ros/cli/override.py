"""`curation override`: a person's decision, which outranks the curator's."""

from __future__ import annotations

import argparse
import getpass
from pathlib import Path

from curation_ros.cli.output import print_json, say
from curation_ros.curating import OVERRIDES, override
from curation_ros.dataset import Dataset


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("dataset", type=Path)
    parser.add_argument("episode", help="short name, id, or the beginning of an id")
    parser.add_argument("verdict", choices=OVERRIDES)
    parser.add_argument("--reason", default="", help="in your words")
    parser.add_argument("--by", default="", help="who decides; default: the user's name")


def run(args: argparse.Namespace) -> int:
    """Log the decision."""
    by = args.by or _user()
    decision = override(
        Dataset(args.dataset), args.episode, args.verdict, args.reason, by, state_hash=""
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
