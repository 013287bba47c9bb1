"""Arguments that several commands share."""

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
    """`--config` and `--topic-map`: the files that configure scoring."""
    parser.add_argument(
        "--config", type=Path, help="YAML file of scorers and rule; default: config/curation.yaml"
    )
    parser.add_argument(
        "--topic-map", type=Path, help="YAML file of the topic map; default: the map in each bag"
    )


def add_rule(parser: argparse.ArgumentParser, default: str) -> None:
    """`--rule`, `--value` and `--method`: what decides or selects.

    Args:
        parser: of a command.
        default: which rule the command uses if none is named.
    """
    # Importing the rules takes 0.2 s, and most commands have none.
    from curation_ros.core.decision.groups import METHODS
    from curation_ros.core.decision.rules import RULES

    rules = "; ".join(f"{name}: {rule.summary}" for name, rule in RULES.items())
    parser.add_argument(
        "--rule", choices=tuple(RULES), default="", help=f"default: {default}; {rules}"
    )
    parser.add_argument("--value", type=float, help="threshold, share or number of the --rule")
    methods = "; ".join(f"{name}: {text}" for name, text in METHODS.items())
    parser.add_argument(
        "--method",
        choices=tuple(METHODS),
        default="",
        help=f"how --rule gap separates groups; {methods}",
    )


def add_workers(parser: argparse.ArgumentParser) -> None:
    """`--jobs` and `--backend`: number and kind of the workers."""
    parser.add_argument(
        "--jobs", type=int, default=1, metavar="N", help="workers; -1 takes all cores"
    )
    parser.add_argument(
        "--backend",
        choices=BACKENDS,
        default="loky",
        help="kind of the workers: processes here (loky), or a cluster (RAY_ADDRESS, "
        "DASK_SCHEDULER_ADDRESS)",
    )
