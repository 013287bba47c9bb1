"""How often the scripted expert of a task succeeds, and how long it takes; with a defect, too.

Not part of `make bench`: the official starts are for final measurements, so say what to run.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from sim_node.defects import DEFECTS
from sim_node.episodes import EpisodeResult, run_episode
from sim_node.planning import EpisodePlan
from sim_node.settings import SIMULATED_TASK
from sim_node.tasks import TASKS, process_environment, start_names


def run_part(job: tuple[str, list[tuple[int, str]], str, int]) -> list[EpisodeResult]:
    """Episodes of one worker: the task, (number, start) pairs, the defect, the first seed."""
    name, part, defect, seed = job
    task, env = TASKS[name], process_environment(name)
    results = []
    for number, start in part:
        plan = EpisodePlan(number, start, 0, defect, seed + number, seed + number)
        results.append(run_episode(env, task, task.start(start), plan.controller(task)))
    return results


def main() -> int:
    """Run and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("starts", help="such as generated:5:0:100 or official:0:50")
    parser.add_argument("--simulated-task", choices=tuple(TASKS), default=SIMULATED_TASK)
    parser.add_argument("--defect", choices=tuple(DEFECTS), default="none")
    parser.add_argument("--seed", type=int, default=20000, help="of the first episode")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    task = args.simulated_task
    numbered = list(enumerate(start_names(args.starts, task)))
    jobs = [(task, numbered[k :: args.jobs], args.defect, args.seed) for k in range(args.jobs)]
    with ProcessPoolExecutor(args.jobs) as pool:
        results = [r for part in pool.map(run_part, jobs) for r in part]
    lengths = np.array([r.n_steps for r in results], dtype=np.float64)
    print(
        f"{task}, {args.starts}, defect {args.defect}: {sum(r.is_success for r in results)} of "
        f"{len(results)} succeed; steps {lengths.mean():.1f} "
        f"(CV {lengths.std() / lengths.mean():.1%}, {lengths.min():.0f} to {lengths.max():.0f})"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
