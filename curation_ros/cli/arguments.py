"""Arguments that several commands take, each described once."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_reference(parser: argparse.ArgumentParser) -> None:
    """`--reference`: trusted demonstrations."""
    parser.add_argument(
        "--reference",
        nargs="+",
        action="extend",
        type=Path,
        default=[],
        metavar="PATH",
        help="datasets or bags of trusted demonstrations",
    )


def add_config(parser: argparse.ArgumentParser) -> None:
    """`--config` and `--topic-map`: the files that a person configures scoring by."""
    parser.add_argument(
        "--config", type=Path, help="scorers and rule; default config/curation.yaml"
    )
    parser.add_argument(
        "--topic-map", type=Path, help="default: the one that is stored in the bag"
    )
