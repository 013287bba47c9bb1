"""How often a rollout that is given up as lost would have succeeded after all.

    python benchmarks/giving_up.py [--starts N] [--jobs N]

Policies of all kinds (trained on everything, on few, on half bad demonstrations, with and without
fingers) are rolled out in full while `policy_node.rollouts.GiveUp` only watches. Ratios are of
simulation steps, so they are the same on every machine.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

from curation_ros.batch.workers import spread
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.statistics.intervals import clopper_pearson
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.collect import Collection, collect
from curation_ros.study.units import named_variant
from policy_node.policy import load_policy
from policy_node.rollouts import GiveUp, SimController
from policy_node.train_many import FailedTraining, TrainingJob, train_many
from sim_node.environment import Command
from sim_node.episodes import run_episode
from sim_node.settings import SIMULATED_TASK, EpisodeLimits
from sim_node.tasks import TASKS, process_environment
from sim_node.tasks.task import Step

#: How many good and how many bad demonstrations a policy learns from.
SETS = ((16, 64), (16, 16), (16, 4), (16, 0), (6, 0), (9, 3))
VARIANTS = ("relative", "fingers")


def train(data: Path, out: Path, good: int, bad: int, variant: str) -> Path:
    """A policy of the first so many good and bad demonstrations."""
    dataset = Dataset(data)
    truth = dataset.truth()
    bags = sorted(dataset.bags(), key=lambda bag: truth[bag.name]["name"])
    chosen = [bag for bag in bags if truth[bag.name]["defect"] == "none"][:good]
    chosen += [bag for bag in bags if truth[bag.name]["defect"] != "none"][:bad]
    key = f"{good}-{bad}-{variant}"
    episodes = [(read_episode(bag), None) for bag in chosen]
    job = TrainingJob(key, episodes, named_variant(variant), seed=0)
    [made] = train_many([job])
    if isinstance(made, FailedTraining):
        raise SystemExit(made.reason)
    made.policy.save(out / key)
    return out / key


def watch(policy: Path, start: str) -> dict[str, Any]:
    """A whole rollout, and when and why it would have been given up."""
    task = TASKS[SIMULATED_TASK]
    give_up = GiveUp(task)
    said: list[tuple[int, str]] = []

    def look(step: Step, _: Command) -> None:
        why = give_up(step)
        if why and not said:
            said.append((step.index, why))

    env = process_environment(task.name)
    controller = SimController(load_policy(policy), env, topic_map_or_default(""))
    ended = run_episode(
        env,
        task,
        task.start(start),
        controller,
        EpisodeLimits(steps_after_success=0),
        on_step=look,
    )
    step, why = said[0] if said else (ended.n_steps, "")
    return {
        "policy": policy.name,
        "success": ended.is_success,
        "steps": ended.n_steps,
        "given_up": why,
        "steps_then": step,
    }


def measure(n_starts: int, jobs: int) -> list[dict[str, Any]]:
    """Every policy from every start."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plan = Collection(80, 0.8, seed=13, starts="generated:13:80")
        for one in collect(folder / "data", plan, jobs=jobs):
            if one.problem:
                raise SystemExit(one.problem)
        tasks: list[tuple[Any, ...]] = [
            (folder / "data", folder / "policies", good, bad, variant)
            for good, bad in SETS
            for variant in VARIANTS
        ]
        policies = list(spread(train, tasks, jobs=jobs))
        starts = [f"generated-777-{k:03d}" for k in range(n_starts)]
        return list(spread(watch, [(p, s) for p in policies for s in starts], jobs=jobs))


def main() -> None:
    """Print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=20, help="for each of the 12 policies")
    parser.add_argument("--jobs", type=int, default=-1)
    args = parser.parse_args()
    rows = measure(args.starts, args.jobs)
    given_up = [row for row in rows if row["given_up"]]
    wrong = [row for row in given_up if row["success"]]
    for row in wrong:
        print(json.dumps(row))
    steps, fewer = (sum(row[key] for row in rows) for key in ("steps", "steps_then"))
    print(
        json.dumps(
            {
                "rollouts": len(rows),
                "successes": sum(row["success"] for row in rows),
                "given_up": len(given_up),
                "lost": sum(row["given_up"] == "lost" for row in given_up),
                "wrong": len(wrong),
                "wrong_ci95": clopper_pearson(len(wrong), len(given_up)) if given_up else None,
                "steps": steps,
                "steps_with_rule": fewer,
                "share_of_steps": fewer / steps,
            }
        )
    )


if __name__ == "__main__":
    main()
