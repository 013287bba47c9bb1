"""`curation collect`: demonstrations of the scripted expert into a dataset, without ROS."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rich.progress import Progress

from curation_ros.cli.arguments import add_workers
from curation_ros.cli.output import print_json, progress_console, say, warn

_DONE, _NOTHING = 0, 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command; those of a collection are parameters of sim_node, too."""
    parser.add_argument("out", type=Path, metavar="OUT", help="dataset; it goes on where it was")
    parser.add_argument("--episodes", type=int, required=True, metavar="N", help="how many")
    parser.add_argument(
        "--contamination", type=float, default=0.0, metavar="F", help="fraction of defective ones"
    )
    parser.add_argument("--defect", default="early_release", help="what is wrong with those")
    parser.add_argument(
        "--paired", action="store_true", help="defective ones recur on the starts of clean ones"
    )
    parser.add_argument(
        "--starts",
        default="",
        help="generated:SEED:COUNT or generated:SEED:FIRST:END; default: generated, by seed",
    )
    parser.add_argument("--seed", type=int, default=0, help="of order, expert and defects")
    parser.add_argument("--task", default="bowl", help="short names are <task>-<number>")
    parser.add_argument("--max-steps", type=int, default=500, help="then an episode ends")
    parser.add_argument(
        "--max-steps-defective", type=int, default=0, help="the same for defective ones; 0: equal"
    )
    add_workers(parser)


def run(args: argparse.Namespace) -> int:
    """Print a row an episode as it is done, then how many there are."""
    from curation_ros.study.collect import Collection, collect

    collection = Collection(
        episodes=args.episodes,
        contamination=args.contamination,
        defect=args.defect,
        paired=args.paired,
        seed=args.seed,
        starts=args.starts,
        task=args.task,
        max_steps=args.max_steps,
        max_steps_defective=args.max_steps_defective,
    )
    began_s = time.monotonic()
    known = whole = 0
    with Progress(console=progress_console, transient=True, disable=args.json) as bar:
        task = bar.add_task(f"collecting {args.episodes} episodes", total=args.episodes)
        for one in collect(args.out, collection, jobs=args.jobs, backend=args.backend):
            bar.advance(task)
            known += one.is_known
            whole += one.truth is not None and not one.problem
            if one.problem:
                warn(f"{one.name}: {one.problem}")
            if args.json and one.truth is not None and not one.is_known:
                keys = ("episode", "name", "start", "defect", "outcome", "steps")
                print_json({key: one.truth[key] for key in keys})
    seconds = time.monotonic() - began_s
    if args.json:
        print_json(
            {
                "dataset": str(args.out),
                "episodes": whole,
                "of": args.episodes,
                "known": known,
                "seconds": seconds,
            }
        )
    else:
        say(
            f"{args.out}: {whole} of {args.episodes} episodes, {known} of them known before, "
            f"{seconds:.1f} s"
        )
    return _DONE if whole == args.episodes else _NOTHING
