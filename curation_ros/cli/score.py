"""`curation score`: bags to scores and decisions, the same ones as live."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.progress import track
from rich.table import Table
from rich.text import Text

from curation_ros.bags.reader import find_bags, read_episode
from curation_ros.cli.output import VERDICT_STYLE, console, print_json, progress_console, warn
from curation_ros.configuration import read_curation, read_reference, share_file
from curation_ros.core.decisions import Decision
from curation_ros.core.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.scoring import Curation
from curation_ros.core.topic_map import TopicMap, read_topic_map
from curation_ros.curating import log_decision
from curation_ros.dataset import Dataset

_DONE, _FINDINGS, _NOTHING = 0, 1, 3
_FIXED_WIDTH, _SCORE_WIDTH = 64, 12


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="datasets, bags, .mcap"
    )
    parser.add_argument(
        "--reference",
        nargs="+",
        action="extend",
        type=Path,
        default=[],
        metavar="PATH",
        help="datasets or bags of trusted demonstrations",
    )
    parser.add_argument(
        "--scorers",
        help=f"comma separated, beside the one that decides: {', '.join(SCORERS)}",
    )
    parser.add_argument("--rule", help="decision rule, where not that of the config")
    parser.add_argument(
        "--config", type=Path, help="scorers and rule; default config/curation.yaml"
    )
    parser.add_argument(
        "--topic-map", type=Path, help="default: the one that is stored in the bag"
    )
    parser.add_argument(
        "--write", action="store_true", help="log the decisions in the dataset (one PATH)"
    )
    parser.add_argument(
        "--check", action="store_true", help="exit with 1 where there are findings"
    )


def run(args: argparse.Namespace) -> int:
    """Score everything that can be read; say what could not."""
    config = args.config or share_file("config/curation.yaml")
    names = [n.strip() for n in args.scorers.split(",")] if args.scorers else None
    curation = read_curation(config, {"scorers": names, "rule": args.rule})
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    dataset = _dataset(args) if args.write else None
    curation.fit(read_reference(args.reference, topic_map) if args.reference else [])
    rows, flawed = [], False
    for path, result in _score(args.paths, curation, topic_map, quiet=args.json):
        if isinstance(result, CurationError):
            flawed = True
            if args.json:
                print_json({"path": str(path), "error": str(result)})
            else:
                warn(result)
            continue
        episode, decision = result
        if dataset is not None:
            # A person's decision stays in force, beside the scores and findings of now.
            decision = replace(
                log_decision(dataset, decision),
                scores=decision.scores,
                findings=decision.findings,
            )
        flawed = flawed or bool(decision.findings)
        row = decision_row(path, episode, decision)
        rows.append(row)
        if args.json:
            print_json(row)
    if not args.json:
        for line in curation.describe().splitlines():
            progress_console.print(line, style="dim", markup=False)
        console.print(_table(rows, curation))
    if not rows:
        return _NOTHING
    return _FINDINGS if args.check and flawed else _DONE


def _dataset(args: argparse.Namespace) -> Dataset:
    if len(args.paths) != 1:
        raise ConfigError(f"--write takes one dataset, found {len(args.paths)} paths")
    return Dataset(args.paths[0])


def _score(
    paths: list[Path], curation: Curation, topic_map: TopicMap | None, *, quiet: bool
) -> Iterator[tuple[Path, tuple[Episode, Decision] | CurationError]]:
    bags: list[Path] = []
    for path in paths:
        try:
            bags += find_bags([path])
        except CurationError as err:
            yield path, err
    shown = track(
        bags, "scoring", console=progress_console, transient=True, disable=quiet or len(bags) < 5
    )
    for bag in shown:
        try:
            episode = read_episode(bag, topic_map)
            yield bag, (episode, curation.decide(episode))
        except CurationError as err:
            yield bag, err


def decision_row(path: Path, episode: Episode, decision: Decision) -> dict[str, Any]:
    """The JSON of one scored episode."""
    return {
        "episode": decision.episode,
        "name": decision.name,
        "path": str(path),
        "length": len(episode),
        "scores": dict(decision.scores),
        "decision": decision.verdict,
        "reason": decision.reason,
        "span": list(decision.span),
        "findings": [f.to_json() for f in decision.findings],
    }


def _table(rows: list[dict[str, Any]], curation: Curation) -> Table:
    """All scores where the terminal is wide enough, else the one that decides."""
    scorers = list(curation.scorers)
    if console.width < _FIXED_WIDTH + _SCORE_WIDTH * len(scorers):
        scorers = [curation.rule_scorer]
        progress_console.print("a wider terminal, or --json, shows all scores", style="dim")
    table = Table(box=None, pad_edge=False)
    table.add_column("episode", no_wrap=True)
    table.add_column("decision", no_wrap=True)
    for heading in ("steps", *(s.replace("_", " ") for s in scorers)):
        table.add_column(heading, justify="right")
    table.add_column("reason", ratio=1)
    for row in rows:
        scores = [row["scores"][s] for s in scorers]
        table.add_row(
            Text(row["name"] or row["episode"][:8]),
            Text(row["decision"], VERDICT_STYLE[row["decision"]]),
            str(row["length"]),
            *("-" if v is None else f"{v:.3g}" for v in scores),
            Text(row["reason"]),
        )
    return table
