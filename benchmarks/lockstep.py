"""What lockstep over DDS costs a step, all nodes running, beside the same steps in one process.

A policy drives the sim while recorder and curator listen. Its trajectory is the same to the bit
without the graph, so each step on the graph has its equal in one process; the difference of their
times is the overhead. The time of a step on the graph is that between two observations, as DDS
stamped them at the sim. In the same run, the least that DDS costs: a bare loop of two processes,
seven topics out and two back, with the same messages and nobody else listening.
"""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import rclpy.context
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from mcap.reader import make_reader
from rclpy.executors import SingleThreadedExecutor
from recorded import record
from rows import row
from sensor_msgs.msg import JointState

from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.status import phase_to_status
from curation_ros.core.episode.stream import header_stamp_ns
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import read_selected, save_selection
from curation_ros.nodes.messages import (
    array_to_ros,
    joints_to_ros,
    pose_to_ros,
    time_from_ros,
    twist_to_ros,
)
from curation_ros.nodes.processes import Domain, Nodes
from curation_ros.nodes.qos import MAPPED

COMMAND = "python benchmarks/run.py lockstep"
N_ROUNDS, N_EPISODES, MAX_STEPS, N_BARE = 3, 3, 250, 500
TARGET_MS = 2.5
_OUT = {
    "joint_states": JointState,
    "bowl": PoseStamped,
    "plate": PoseStamped,
    "cookies": PoseStamped,
    "ramekin": PoseStamped,
    "phase": DiagnosticArray,
    "eef_pose": PoseStamped,
}
_BACK = {"command/twist": TwistStamped, "command/gripper": JointState}


def run() -> list[dict[str, Any]]:
    """Measure; a row a figure."""
    from curation_ros.study.units import named_variant
    from policy_node.settings import TrainingSettings
    from policy_node.train import train

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        reference = record(folder / "reference", episodes=6, seed=101)
        manifest, _ = save_selection(Dataset(reference), rule="all", name="all")
        demonstrations = read_selected(manifest, Dataset(reference))
        settings = TrainingSettings(steps=500)
        trained = train(demonstrations, named_variant("relative"), seed=0, settings=settings)
        policy = trained.policy
        policy.save(folder / "policy")
        graph, alone, bare = _rounds(folder, policy)
    figures = {
        "lockstep, a step on the graph, sim + policy_node + recorder + curator": graph,
        "lockstep, the same step in one process": alone,
        "lockstep overhead a step": graph - alone,
        "lockstep, bare loop of two processes, 7 topics out, 2 back": bare,
    }
    rows = []
    for name, times_s in figures.items():
        for part, value in (
            ("median", 1e3 * float(np.median(times_s))),
            ("p90", 1e3 * float(np.percentile(times_s, 90))),
        ):
            is_aim = (name, part) == ("lockstep overhead a step", "median")
            rows.append(
                row(
                    f"{name}, {part}",
                    value,
                    "ms",
                    COMMAND,
                    target=f"< {TARGET_MS:g} ms" if is_aim else None,
                    holds=value < TARGET_MS if is_aim else None,
                )
            )
    return rows


def _rounds(folder: Path, policy: Any) -> tuple[Any, Any, Any]:
    """Seconds of each step on the graph and of the same step alone; of each of the bare loop."""
    graph, alone, bare = [], [], []
    for k in range(N_ROUNDS):
        starts = f"generated:{k}:{N_EPISODES}"
        graph += _on_graph(folder, f"round{k}", starts)
        alone += _in_process(policy, starts)
        bare.append(_bare())
    if [len(g) for g in graph] != [len(a) for a in alone] or min(map(np.min, graph)) <= 0.0:
        raise RuntimeError("the graph went another way than one process")
    return np.concatenate(graph), np.concatenate(alone), np.concatenate(bare)


def _on_graph(folder: Path, name: str, starts: str) -> list[Any]:
    dataset = folder / name
    domain = Domain()
    with Nodes(domain, folder / "logs" / name) as nodes:
        nodes.start("recorder", {"dataset": dataset})
        nodes.start("curator", {"dataset": dataset, "reference": [folder / "reference"]})
        nodes.start("policy_node", {"policy": folder / "policy"})
        nodes.start(
            "sim_node",
            {
                "mode": "command",
                "episodes": N_EPISODES,
                "starts": starts,
                "max_steps": MAX_STEPS,
                "steps_after_success": 0,
                "dataset": dataset,
                "wait_for": ["policy_node", "recorder", "curator"],
            },
        )
        nodes.wait("sim_node", 600.0)
    domain.close()
    times = []
    # Truth is in the order of the starts, and has one line an episode.
    for episode_id in Dataset(dataset).truth():
        [path] = Dataset(dataset).bag_path(episode_id).glob("*.mcap")
        published: dict[int, int] = {}  # by stamp: an observation may be sent again
        with path.open("rb") as file:
            for _, _, message in make_reader(file).iter_messages(topics=["/eef_pose"]):
                stamp_ns = header_stamp_ns(message.data)
                published[stamp_ns] = min(
                    message.publish_time, published.get(stamp_ns, message.publish_time)
                )
        # Not the first step: that one waits until the recorder hears the commands.
        times.append(np.diff([published[s] for s in sorted(published)])[1:] / NS_PER_S)
    return times


def _in_process(policy: Any, starts: str) -> list[Any]:
    from policy_node.rollouts import SimController
    from sim_node.episodes import run_episode
    from sim_node.settings import SIMULATED_TASK, EpisodeLimits
    from sim_node.tasks import TASKS, process_environment, start_names

    times = []
    task = TASKS[SIMULATED_TASK]
    env = process_environment(task.name)
    for start in start_names(starts):
        clock: list[float] = []
        run_episode(
            env,
            task,
            task.start(start),
            SimController(policy, env, topic_map_or_default("")),
            EpisodeLimits(MAX_STEPS, steps_after_success=0),
            on_step=lambda *_, clock=clock: clock.append(time.perf_counter()),
        )
        times.append(np.diff(clock)[1:])
    return times


# --- the bare loop ------------------------------------------------------------------------------


def _bare() -> Any:
    """Seconds of each round trip."""
    domain = Domain()
    environment = {**os.environ, **domain.environment}
    words = [sys.executable, __file__]
    with subprocess.Popen([*words, "answer"], env=environment) as answering:
        try:
            asking = subprocess.run(
                [*words, "ask"], env=environment, check=True, capture_output=True, timeout=300.0
            )
        finally:
            answering.terminate()
    domain.close()
    return np.array(json.loads(asking.stdout))


class _Side:
    """One of the two processes."""

    def __init__(self, name: str, out: dict[str, type], heard: dict[str, type]) -> None:
        self._context = rclpy.context.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self.stamps = dict.fromkeys(heard, 0)
        self.out = {t: self.node.create_publisher(kind, t, MAPPED) for t, kind in out.items()}
        for topic, kind in heard.items():
            self.node.create_subscription(kind, topic, self._taker(topic), MAPPED)

    def _taker(self, topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            self.stamps[topic] = time_from_ros(message.header.stamp)

        return take

    def wait(self, stamp_ns: int) -> None:
        while any(stamp != stamp_ns for stamp in self.stamps.values()):
            self._executor.spin_once(timeout_sec=0.02)


def _ask() -> None:
    """Send observations; print the seconds until each was answered."""
    side = _Side("asking", _OUT, _BACK)
    while any(p.get_subscription_count() < 1 for p in side.out.values()):
        time.sleep(0.02)
    time.sleep(1.0)  # the other side discovers us on its own
    numbers = [0.1 * k for k in range(9)]
    names = [f"joint{k}" for k in range(9)]
    times = []
    for k in range(1, N_BARE + 1):
        began_s = time.perf_counter()
        for topic, kind in _OUT.items():
            if kind is JointState:
                message = joints_to_ros(names, numbers, numbers, numbers, k)
            elif kind is PoseStamped:
                message = pose_to_ros(numbers[:3], numbers[:4], k)
            else:
                message = array_to_ros([phase_to_status("", "PREGRASP", 0, 0.5)], k)
            side.out[topic].publish(message)
        side.wait(k)
        times.append(time.perf_counter() - began_s)
    print(json.dumps(times))


def _answer() -> None:
    """Answer observations until terminated."""
    side = _Side("answering", _BACK, _OUT)
    for k in itertools.count(1):
        side.wait(k)
        side.out["command/twist"].publish(twist_to_ros([0.1, 0.2, 0.3], k))
        side.out["command/gripper"].publish(joints_to_ros(["gripper"], [1.0], [0.0], [0.0], k))


if __name__ == "__main__":
    if sys.argv[1:] == ["ask"]:
        _ask()
    elif sys.argv[1:] == ["answer"]:
        _answer()
    else:
        for result in run():
            print(json.dumps(result))
