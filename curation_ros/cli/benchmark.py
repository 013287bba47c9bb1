"""`curation benchmark`: a study from its plan to its report; the same command resumes it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from curation_ros.cli.arguments import add_workers
from curation_ros.cli.output import print_json, progress_console, say, warn
from curation_ros.configuration import share_file
from curation_ros.core.errors import CurationError
from curation_ros.files import named_errors, write_atomically

if TYPE_CHECKING:
    from curation_ros.study.running import Study

_DONE, _NOTHING = 0, 3
#: Problems that are shown; `results.json` has all of them.
_SHOWN = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument(
        "--config", type=Path, help="the plan; default config/paper.yaml, which explains the keys"
    )
    parser.add_argument(
        "--out", type=Path, default=Path("results"), help="the study is written to OUT/<name>"
    )
    parser.add_argument("--data", type=Path, help="folder of its demonstrations; default OUT/data")
    parser.add_argument(
        "--stage",
        action="append",
        default=[],
        metavar="NAME",
        help="do and report this stage alone; may be given several times",
    )
    parser.add_argument(
        "--dry-run", action="store_true", help="collect and score, then count what is done"
    )
    parser.add_argument(
        "--no-report", action="store_true", help="write results.json alone; needs no matplotlib"
    )
    add_workers(parser)
    parser.set_defaults(jobs=-1)


def run(args: argparse.Namespace) -> int:
    """Run it, and write results.json and the reports."""
    from curation_ros.study.plan import read_plan
    from curation_ros.study.results import results
    from curation_ros.study.running import run_study

    plan = read_plan(args.config or share_file("config/paper.yaml"))
    folder = args.out / plan.name
    if not args.no_report and not args.dry_run:
        _check_report()
    with named_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=progress_console,
        transient=True,
        disable=args.json,
    ) as bar:
        task = bar.add_task(plan.name, total=None)

        def log(text: str) -> None:
            if not args.json:
                bar.console.print(text, markup=False, soft_wrap=True)

        study = run_study(
            plan,
            folder,
            args.data or args.out / "data",
            jobs=args.jobs,
            backend=args.backend,
            log=log,
            ticks=lambda what, n, of: bar.update(task, description=what, completed=n, total=of),
            work=not args.dry_run,
            stages=args.stage,
        )
    if args.dry_run:
        _print_progress(study, args.json)
        return _DONE
    found = results(study)
    path = folder / "results.json"
    write_atomically(path, json.dumps(found, indent=None, allow_nan=False) + "\n")
    written = [path]
    if not args.no_report:
        from curation_ros.reporting import write_report

        written += write_report(found, folder)
    _print_results(found, written, args.json)
    return _DONE if found["budget"]["rollouts"] else _NOTHING


def _print_progress(study: Study, is_json: bool) -> None:
    """How much of a study is done."""
    wanted = {policy for cell in study.cells for policy in cell.policies.values()}
    trained = {row["policy"] for row in study.trials.rows("policy") if row["status"] == "ok"}
    rolled = sum(row["status"] == "ok" for row in study.trials.rows("rollout"))
    if is_json:
        print_json({"policies": len(wanted), "trained": len(wanted & trained), "rollouts": rolled})
    else:
        say(f"{len(wanted & trained)} of {len(wanted)} policies and {rolled} rollouts are done")


def _print_results(found: Mapping[str, Any], written: Sequence[Path], is_json: bool) -> None:
    """The files of a study, the results first, and its problems."""
    missing = sum(stage["missing"] for stage in found["stages"])
    problems = found["problems"]
    if is_json:
        print_json(
            {
                "results": str(written[0]),
                "written": [str(path) for path in written],
                "rollouts": found["budget"]["rollouts"],
                "missing": missing,
                "steps": found["budget"]["used_steps"],
                "problems": problems,
            }
        )
        return
    for problem in problems[:_SHOWN]:
        warn(problem)
    if len(problems) > _SHOWN:
        warn(f"and {len(problems) - _SHOWN} more, see {written[0]}")
    if missing:
        warn(f"{missing} rollouts are missing; run the same command again to try them")
    for path in written:
        say(str(path))


def _check_report() -> None:
    """Refuse a missing matplotlib before an hour of work, not after it."""
    import importlib.util

    if importlib.util.find_spec("matplotlib") is None:
        raise CurationError(
            "the report needs matplotlib: install the extra [report], or say --no-report"
        )
