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


def add_rule(parser: argparse.ArgumentParser, default: str) -> None:
    """`--rule`, `--value` and `--method`: what decides or selects.

    Args:
        parser: of a command.
        default: which rule the command uses if none is named.
    """
    # Importing the rules takes 0.2 s, which commands without rules do not wait for.
    from curation_ros.core.decision.groups import METHODS
    from curation_ros.core.decision.rules import RULES

    rules = "; ".join(f"{name}: {rule.summary}" for name, rule in RULES.items())
    parser.add_argument(
        "--rule", choices=tuple(RULES), default="", help=f"default: {default}; {rules}"
    )
    parser.add_argument("--value", type=float, help="threshold, share or number of the --rule")
    methods = "; ".join(f"{name}: {text}" for name, text in METHODS.items())
    parser.add_argument(
        "--method", choices=tuple(METHODS), default="", help=f"of --rule gap; {methods}"
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
