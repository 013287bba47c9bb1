"""`curation score`: bags to scores and decisions, the same ones as live."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from rich.progress import track
from rich.table import Table
from rich.text import Text

from curation_ros.bags.reader import find_bags
from curation_ros.cli.arguments import add_config, add_reference, add_workers
from curation_ros.cli.output import VERDICT_STYLE, console, print_json, progress_console, warn
from curation_ros.configuration import read_curation, read_reference, share_file
from curation_ros.core.decisions import VERDICTS, Decision
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.examination import Examination
from curation_ros.core.rules import RULES
from curation_ros.core.scorers import SCORERS
from curation_ros.core.scoring import Curation
from curation_ros.core.selection import TieKey
from curation_ros.core.topic_map import read_topic_map
from curation_ros.curating import log_decision
from curation_ros.dataset import Dataset
from curation_ros.examining import EpisodesOf, Examined, Examiner, judge_bags

_DONE, _FINDINGS, _NOTHING = 0, 1, 3
_FIXED_WIDTH, _SCORE_WIDTH = 64, 12
_FEW = 5
_Judged: TypeAlias = "tuple[Examined, Decision | None]"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="datasets, bags, .mcap"
    )
    add_reference(parser)
    parser.add_argument(
        "--scorers",
        help=f"comma separated, beside the one that decides: {', '.join(SCORERS)}",
    )
    parser.add_argument(
        "--rule", help=f"decision rule, where not that of the config: {', '.join(RULES)}"
    )
    parser.add_argument("--rule-scorer", help="the scorer that decides, likewise")
    parser.add_argument("--value", type=float, help="of --rule: a threshold, share or number")
    add_config(parser)
    parser.add_argument(
        "--write", action="store_true", help="log the decisions in the dataset (one PATH)"
    )
    parser.add_argument(
        "--check", action="store_true", help="exit with 1 where there are findings"
    )
    add_workers(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="score again what has been scored already"
    )


def run(args: argparse.Namespace) -> int:
    """Score everything that can be read; say what could not."""
    curation = _curation(args)
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    dataset = _dataset(args) if args.write else None
    curation.fit(read_reference(args.reference, topic_map) if args.reference else [])
    rows: list[dict[str, Any]] = []
    n_bad, n_twice = 0, 0
    n_known: Counter[bool] = Counter()
    verdicts: Counter[str] = Counter()
    flawed = False
    bags, missing = _find(args.paths)
    for path, problem in missing:
        n_bad += 1
        _report(args, path, problem)
    if curation.needs_dataset:
        curation.fit_dataset(EpisodesOf(bags, topic_map))
    examiner = Examiner(
        curation, topic_map, jobs=args.jobs, backend=args.backend, fresh=args.fresh
    )

    def bar(results: Iterable[Examined]) -> Iterator[Examined]:
        shown = track(
            results,
            "scoring",
            total=len(bags),
            console=progress_console,
            transient=True,
            disable=len(bags) < _FEW or not progress_console.is_terminal,
        )
        # A rule over the dataset goes over all bags twice; what is known counts the first time.
        for one in shown:
            n_known.update([one.is_known])
            yield one

    judged = judge_bags(examiner, curation, bags, tie=_tie(dataset), progress=bar)
    for one, decision in _resumable(judged):
        if decision is None or not isinstance(one.result, Examination):
            n_bad += 1
            _report(args, one.path, one.result)
            continue
        if dataset is not None:
            decision = _logged(dataset, one.path, decision)
        verdicts[decision.verdict] += 1
        n_twice += decision.episode in curation.reference_ids_
        flawed = flawed or bool(decision.findings)
        row = decision_row(one.path, one.result, decision)
        if args.json:
            print_json(row)
        else:
            rows.append(row)
    if rows:
        for line in curation.describe().splitlines():
            # What a scorer is set to stands in the configuration; that it is silent, nowhere else.
            if not line.startswith("scorer ") or "; abstains: " in line:
                progress_console.print(line, style="dim", markup=False)
        console.print(_table(rows, curation))
    n_read = sum(verdicts.values())
    if n_twice:
        warn(
            f"{n_twice} of the {n_read} episodes are in the reference: what they are compared "
            "with is partly themselves"
        )
    if examiner.problem:
        warn(f"results could not be kept for the next time: {examiner.problem}")
    if len(bags) >= _FEW and (progress_console.is_terminal or not args.json):
        found = ", ".join(f"{verdicts[v]} {v}" for v in VERDICTS if verdicts[v])
        text = f"scored {n_read}, of which {n_known[True]} were known; {n_bad} could not be read"
        progress_console.print(f"{found}; {text}" if found else text, style="dim")
    if not n_read:
        return _NOTHING
    return _FINDINGS if args.check and (flawed or n_bad) else _DONE


def _resumable(judged: Iterator[_Judged]) -> Iterator[_Judged]:
    """The same; who stops it is told that nothing is lost."""
    try:
        yield from judged
    except KeyboardInterrupt:
        warn("what has been scored is kept: the same command goes on from there")
        raise


def _logged(dataset: Dataset, path: Path, decision: Decision) -> Decision:
    """Log a decision; a person's stays in force, beside the scores and findings of now."""
    if path.name != decision.episode:
        warn(
            f"{path}: not logged: its folder is not named after its episode; "
            f"rename it to {decision.episode}"
        )
        return decision
    return replace(
        log_decision(dataset, decision), scores=decision.scores, findings=decision.findings
    )


def _curation(args: argparse.Namespace) -> Curation:
    config = args.config or share_file("config/curation.yaml")
    names = [n.strip() for n in args.scorers.split(",")] if args.scorers else None
    settings: dict[str, Any] = {
        "scorers": names,
        "rule": args.rule,
        "rule_scorer": args.rule_scorer,
    }
    if args.value is not None:
        if args.rule is None:
            raise ConfigError(f"--value {args.value:g} belongs to a --rule: name one")
        key = "threshold" if args.rule == "threshold" else "value"
        settings["rule_params"] = {key: args.value}
    return read_curation(config, settings)


def _find(paths: list[Path]) -> tuple[list[Path], list[tuple[Path, CurationError]]]:
    """Bags that are meant, each once, and paths that lead to none."""
    bags: dict[Path, Path] = {}
    missing = []
    for path in paths:
        try:
            for bag in find_bags([path]):
                bags.setdefault(bag.resolve(), bag)
        except CurationError as err:
            missing.append((path, err))
    return list(bags.values()), missing


def _report(args: argparse.Namespace, path: Path, problem: object) -> None:
    if args.json:
        finding = getattr(problem, "finding", "")
        print_json({"path": str(path), "error": str(problem), "finding": finding})
    else:
        warn(problem)


def _dataset(args: argparse.Namespace) -> Dataset:
    if len(args.paths) != 1:
        raise ConfigError(f"--write takes one dataset, found {len(args.paths)} paths")
    return Dataset(args.paths[0])


def _tie(dataset: Dataset | None) -> TieKey | None:
    return dataset.tie(0) if dataset is not None else None


def decision_row(path: Path, seen: Examination, decision: Decision) -> dict[str, Any]:
    """The JSON of one scored episode."""
    return {
        "episode": decision.episode,
        "name": decision.name,
        "path": str(path),
        "length": seen.steps,
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
