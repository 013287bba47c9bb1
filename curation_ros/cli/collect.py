"""`curation collect`: demonstrations of the scripted expert into a dataset, without ROS."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from rich.progress import Progress

from curation_ros.cli.arguments import add_workers
from curation_ros.cli.output import print_json, progress_console, say, warn
from sim_node.defects import DEFECTS
from sim_node.settings import MAX_STEPS, SIMULATED_TASK
from sim_node.tasks import TASKS

_DONE, _NOTHING = 0, 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command; those of a collection are parameters of sim_node, too."""
    parser.add_argument("out", type=Path, metavar="OUT", help="dataset; resumed if it exists")
    parser.add_argument("--episodes", type=int, required=True, metavar="N", help="how many")
    parser.add_argument(
        "--simulated-task",
        default=SIMULATED_TASK,
        metavar="NAME",
        help=f"what is simulated: {', '.join(TASKS)} (default: {SIMULATED_TASK})",
    )
    parser.add_argument(
        "--contamination", type=float, default=0.0, metavar="F", help="fraction of defective ones"
    )
    kinds = "; ".join(f"{d.name}, {d.description}" for d in DEFECTS.values() if d.name != "none")
    parser.add_argument(
        "--defect",
        default="early_release",
        metavar="KIND",
        help=f"kind of the defect: {kinds} (default: early_release)".replace("%", "%%"),
    )
    parser.add_argument(
        "--paired", action="store_true", help="defective ones reuse the starts of clean ones"
    )
    parser.add_argument(
        "--starts",
        default="",
        help="generated:SEED:COUNT or generated:SEED:FIRST:END (default: generated, by seed)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of order, expert and defects")
    parser.add_argument("--task", default="bowl", help="short names are <task>-<number>")
    parser.add_argument(
        "--max-steps",
        type=int,
        default=MAX_STEPS,
        help=f"most commands of an episode (default: {MAX_STEPS})",
    )
    parser.add_argument(
        "--max-steps-defective",
        type=int,
        default=0,
        help="the same for defective ones (default: as --max-steps)",
    )
    parser.add_argument(
        "--topic-map", default="", metavar="FILE", help="default: the LIBERO robot of sim_node"
    )
    add_workers(parser)


def run(args: argparse.Namespace) -> int:
    """Print a row for each episode when it is done, then the number of episodes."""
    from curation_ros.study.collect import Collection, collect

    collection = Collection(
        episodes=args.episodes,
        contamination=args.contamination,
        defect=args.defect,
        paired=args.paired,
        seed=args.seed,
        starts=args.starts,
        name_prefix=args.task,
        simulated_task=args.simulated_task,
        topic_map=args.topic_map,
        max_steps=args.max_steps,
        max_steps_defective=args.max_steps_defective,
    )
    began_s = time.monotonic()
    known = whole = 0
    with Progress(console=progress_console, transient=True, disable=args.json) as bar:
        row = bar.add_task(f"collecting {args.episodes} episodes", total=args.episodes)
        for one in collect(args.out, collection, jobs=args.jobs, backend=args.backend):
            bar.advance(row)
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
