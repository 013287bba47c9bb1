"""`curation score`: bags to scores and decisions, the same ones as live."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from pathlib import Path

from rich.progress import track

from curation_ros.batch.examine import Examined
from curation_ros.batch.score import Scoring, score_recordings
from curation_ros.batch.scored import Scored, ScoringResult, Unreadable
from curation_ros.cli.arguments import add_config, add_reference, add_rule, add_workers
from curation_ros.cli.output import console, print_json, progress_console, warn
from curation_ros.cli.score_table import score_table
from curation_ros.configuration import read_reference, settings_of
from curation_ros.core.decision.decision import VERDICTS
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.topic_map import read_topic_map

_DONE, _FINDINGS, _NOTHING = 0, 1, 3
#: Fewer bags need no progress bar and no summary; more names than this are not listed.
_FEW = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "paths", nargs="+", type=Path, metavar="PATH", help="datasets, bags, .mcap"
    )
    add_reference(parser)
    parser.add_argument(
        "--scorers",
        help="comma separated, in addition to the one that decides; see `curation scorers`",
    )
    add_rule(parser, default="that of the config")
    parser.add_argument("--rule-scorer", help="the scorer that decides; default: of the config")
    add_config(parser)
    parser.add_argument(
        "--write", action="store_true", help="log the decisions in the dataset (one PATH)"
    )
    parser.add_argument("--check", action="store_true", help="exit with 1 if there are findings")
    add_workers(parser)
    parser.add_argument(
        "--fresh", action="store_true", help="score again what has been scored already"
    )


def run(args: argparse.Namespace) -> int:
    """Score, print, and report what could not be scored."""
    topic_map = read_topic_map(args.topic_map) if args.topic_map else None
    scoring = score_recordings(
        args.paths,
        _settings(args),
        read_reference(args.reference, topic_map) if args.reference else [],
        topic_map=topic_map,
        write=args.write,
        fresh=args.fresh,
        jobs=args.jobs,
        backend=args.backend,
    )
    rows: list[Scored] = []
    for result in _with_progress(scoring):
        if isinstance(result, Scored) and result.warning:
            warn(result.warning)
        if args.json:
            print_json(result.to_json())
        elif isinstance(result, Unreadable):
            warn(result.error)
        else:
            rows.append(result)
    if rows:
        for line in scoring.curation.describe().splitlines():
            # The settings of a scorer are in the configuration; only that it abstains is news.
            if not line.startswith("scorer ") or "; abstains: " in line:
                progress_console.print(line, style="dim", markup=False)
        console.print(score_table(rows))
    _report(scoring, args.json)
    counts = scoring.counts
    if not counts.n_scored:
        return _NOTHING
    is_flawed = counts.n_with_findings or counts.n_unreadable
    return _FINDINGS if args.check and is_flawed else _DONE


def _settings(args: argparse.Namespace) -> CurationSettings:
    return settings_of(
        args.config,
        scorers=[n.strip() for n in args.scorers.split(",")] if args.scorers else (),
        rule=args.rule or "",
        rule_scorer=args.rule_scorer or "",
        value=args.value,
        method=args.method or "",
    )


def _with_progress(scoring: Scoring) -> Iterator[ScoringResult]:
    """The results, with a bar on a terminal."""
    n = len(scoring.paths)

    def bar(results: Iterable[Examined]) -> Iterable[Examined]:
        return track(
            results,
            "scoring",
            total=n,
            console=progress_console,
            transient=True,
            disable=n < _FEW or not progress_console.is_terminal,
        )

    try:
        yield from scoring.run(bar)
    except KeyboardInterrupt:
        warn("finished scores are kept: the same command resumes")
        raise


def _report(scoring: Scoring, is_json: bool) -> None:
    """Print on stderr what the rows do not show."""
    counts = scoring.counts
    if counts.n_in_reference:
        warn(
            f"{counts.n_in_reference} of the {counts.n_scored} episodes are in the reference: "
            "they are partly compared with themselves"
        )
    if scoring.problem:
        warn(f"results could not be kept for the next run: {scoring.problem}")
    if len(scoring.paths) >= _FEW and (progress_console.is_terminal or not is_json):
        verdicts = [f"{counts.verdicts[v]} {v}" for v in VERDICTS if counts.verdicts[v]]
        totals = (
            f"{counts.n_scored} scored ({counts.n_known} cached), {counts.n_unreadable} unreadable"
        )
        progress_console.print("; ".join(filter(None, [", ".join(verdicts), totals])), style="dim")
    if counts.replaced:
        changes = counts.replaced.most_common()
        listed = ", ".join(f"{n} from {old} to {new}" for (old, new), n in changes)
        warn(f"earlier decisions were replaced: {listed}")
    if counts.overridden:
        names = [_overridden(one) for one in counts.overridden[:_FEW]]
        rest = len(counts.overridden) - len(names)
        more = f" and {rest} more" if rest else ""
        warn(f"overridden by a person (their decision stands): {', '.join(names)}{more}")


def _overridden(one: Scored) -> str:
    held = one.overridden_by
    assert held is not None, "only such results are counted"
    name = one.decision.name or one.decision.episode[:8]
    return f"{name} ({held.verdict}, by {held.by})"
