"""`curation evaluate`: how often a policy succeeds, in this process or over the graph."""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from curation_ros.batch.workers import spread
from curation_ros.cli.arguments import add_workers
from curation_ros.cli.output import percent, print_json, progress_console, say
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.errors import ConfigError
from curation_ros.study.graph_rollouts import evaluate_on_graph, summary
from sim_node.settings import MAX_STEPS, SIMULATED_TASK
from sim_node.tasks import TASKS, start_names

_MOST_STEPS = 100_000  # the limit of sim_node


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of the command."""
    parser.add_argument("--policy", type=Path, required=True, help="folder of the policy")
    parser.add_argument(
        "--starts", default="official:0:50", help="official:FIRST:END or generated:SEED:COUNT"
    )
    parser.add_argument(
        "--simulated-task",
        default=SIMULATED_TASK,
        metavar="NAME",
        help=f"what is simulated: {', '.join(TASKS)} (default: {SIMULATED_TASK})",
    )
    parser.add_argument(
        "--max-steps",
        type=int,
        default=MAX_STEPS,
        help=f"most commands of a rollout (default: {MAX_STEPS})",
    )
    parser.add_argument(
        "--topic-map", default="", metavar="FILE", help="default: the LIBERO robot of sim_node"
    )
    parser.add_argument(
        "--graph", action="store_true", help="drive sim_node and policy_node over ROS 2"
    )
    add_workers(parser)
    parser.add_argument("--logs", type=Path, help="with --graph: folder for the nodes' output")


def run(args: argparse.Namespace) -> int:
    """Print a row per rollout, then the summary."""
    from policy_node.policy import load_policy

    if not 1 <= args.max_steps <= _MOST_STEPS:
        raise ConfigError(f"--max-steps {args.max_steps}: expected 1 to {_MOST_STEPS}")
    policy = load_policy(args.policy)
    policy.check(topic_map_or_default(args.topic_map))
    rows = []
    for row in _rollouts(args, policy.card.id):
        rows.append(row)
        if args.json:
            print_json(row)
        else:
            outcome = "success" if row["success"] else f"failed in {row['stage']}"
            say(f"{row['start']}: {outcome} after {row['steps']} steps")
    total = summary(policy.card.id, rows)
    if args.json:
        print_json(total)
    else:
        interval = (total["ci95"][0], total["ci95"][1])
        say(f"success {percent(total['successes'], total['rollouts'], interval)}")
    return 0


def _rollouts(args: argparse.Namespace, policy_id: str) -> Iterator[dict[str, Any]]:
    if args.graph:
        logs = args.logs or Path(tempfile.mkdtemp(prefix="curation_ros-logs-"))
        if progress_console.is_terminal:  # the first row takes some seconds
            text = f"starting sim_node and policy_node; their logs are in {logs}"
            progress_console.print(text, markup=False, soft_wrap=True)
        yield from evaluate_on_graph(
            args.policy,
            policy_id,
            args.starts,
            max_steps=args.max_steps,
            simulated_task=args.simulated_task,
            topic_map=args.topic_map,
            log_folder=logs,
        )
        if args.logs is None:  # after an error they stay, for its message names them
            shutil.rmtree(logs, ignore_errors=True)
        return
    from curation_ros.study.unit_work import roll_policy

    rollouts = [
        (args.policy, start, args.max_steps, args.simulated_task, args.topic_map)
        for start in start_names(args.starts, args.simulated_task)
    ]
    for done in spread(roll_policy, rollouts, jobs=args.jobs, backend=args.backend):
        yield done.to_json()
