"""Arguments that several commands take, each described once."""

from __future__ import annotations

import argparse
from pathlib import Path

from curation_ros.batch.workers import BACKENDS


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


def add_workers(parser: argparse.ArgumentParser) -> None:
    """`--jobs` and `--backend`: over how many workers, of which kind, work is spread."""
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="workers; -1 takes all cores"
    )
    parser.add_argument(
        "--backend",
        choices=BACKENDS,
        default="loky",
        help="of the workers: processes here, or a cluster (RAY_ADDRESS, DASK_SCHEDULER_ADDRESS)",
    )
