"""Evaluates a policy on the graph: sim_node and policy_node in lockstep, one row per rollout."""

from __future__ import annotations

import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from curation_ros.core.errors import CurationError
from curation_ros.core.statistics.intervals import wilson
from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.processes import Domain, Nodes
from sim_node.settings import MAX_STEPS, SIMULATED_TASK
from sim_node.tasks import start_names

# A step takes milliseconds: without a finished rollout for this long, something hangs.
_SILENCE_S = 120.0
# The transport sends a lost message again after 3 s, and on a busy machine a second time. A node
# that has ended is noticed at once.
_ANSWER_S = 15.0


def evaluate_on_graph(
    policy: Path,
    policy_id: str,
    starts: str,
    *,
    max_steps: int = MAX_STEPS,
    simulated_task: str = SIMULATED_TASK,
    topic_map: str = "",
    log_folder: Path,
    stop: threading.Event | None = None,
) -> Iterator[dict[str, Any]]:
    """Drive a policy over DDS from each start, on a domain of its own.

    Args:
        policy: folder of the policy.
        policy_id: for the rows.
        starts: as sim_node's parameter `starts`, such as official:0:10.
        max_steps: most commands of a rollout.
        simulated_task: key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map; empty: the default one.
        log_folder: for the nodes' logs.
        stop: ends the evaluation early when another thread sets it.

    Yields:
        A row per rollout when it ends: policy, start, success, steps, stage.

    Raises:
        CurationError: if a node ends or hangs, or a rollout was not driven to its end. None of
            these is a failure of the policy.
    """
    n = len(start_names(starts, simulated_task))
    settings = _sim_settings(simulated_task, starts, n, max_steps)
    domain = Domain()
    with (
        tempfile.TemporaryDirectory(prefix="curation_ros-evaluate-") as folder,
        Nodes(domain, log_folder) as nodes,
    ):
        truth_log = Dataset(folder, create=True).truth_log
        try:
            nodes.start("policy_node", {"policy": policy, "topic_map": topic_map})
            nodes.start("sim_node", {**settings, "dataset": folder})
            n_done, last_s = 0, time.monotonic()
            while n_done < n and not (stop is not None and stop.is_set()):
                has_ended = nodes.ended("sim_node") is not None
                _check_nodes(nodes, log_folder)
                lines = truth_log.lines()
                for line in lines[n_done:]:
                    yield _row(policy_id, line)
                if len(lines) > n_done:
                    n_done, last_s = len(lines), time.monotonic()
                    continue
                if has_ended:
                    raise CurationError(f"sim_node ended after {n_done} of {n} rollouts")
                _check_silence(time.monotonic() - last_s, log_folder)
                time.sleep(0.1)
        finally:
            domain.close()


def _sim_settings(simulated_task: str, starts: str, n: int, max_steps: int) -> dict[str, Any]:
    """Parameters of sim_node for rollouts of a policy, apart from the dataset."""
    return {
        "mode": "command",
        "simulated_task": simulated_task,
        "episodes": n,
        "starts": starts,
        "task": "rollout",
        "max_steps": max_steps,
        "steps_after_success": 0,
        "command_timeout_s": _ANSWER_S,
        "wait_for": ["policy_node"],
    }


def _check_nodes(nodes: Nodes, log_folder: Path) -> None:
    """Raise if a node has ended too early; if it refused to run, with its own message."""
    for node in ("policy_node", "sim_node"):
        code = nodes.ended(node)
        log = log_folder / f"{node}.log"
        if code is not None and code < 0:
            name = signal.Signals(-code).name
            raise CurationError(f"{node} was ended by signal {name}: its log is {log}")
        if code == 0 and node == "policy_node":
            raise CurationError(f"{node} was stopped by somebody else: its log is {log}")
    nodes.check()


def _check_silence(silence_s: float, log_folder: Path) -> None:
    """Raise if no rollout has ended for too long."""
    if silence_s > _SILENCE_S:
        raise CurationError(
            f"no rollout has ended for {_SILENCE_S:g} s: see {log_folder}/sim_node.log"
        )


def summary(policy_id: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The last row of an evaluation: successes with Wilson's 95 % interval."""
    successes = sum(bool(row["success"]) for row in rows)
    low, high = wilson(successes, len(rows))
    return {
        "policy": policy_id,
        "successes": successes,
        "rollouts": len(rows),
        "rate": successes / len(rows),
        "ci95": [low, high],
        "interval": "wilson",
    }


def _row(policy_id: str, truth: dict[str, Any]) -> dict[str, Any]:
    if truth["aborted"]:
        raise CurationError(f"rollout from {truth['start']} was aborted: {truth['aborted']}")
    return {
        "policy": policy_id,
        "start": truth["start"],
        "success": truth["outcome"] == "succeeded",
        "steps": truth["steps"],
        "stage": truth["stage"],
    }
