"""A trained policy drives whole episodes over DDS, and goes the same way as in one process."""

from __future__ import annotations

import functools
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from demonstrations import RELATIVE
from graph import PATIENCE_S
from pausing import PAUSE, RESUME, pausable

from curation_ros.cli.main import main as curation
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from sim_node.tasks.pick_and_place import PHASES

pytestmark = [pytest.mark.ros, pytest.mark.sim, pytest.mark.policy]
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from curation_ros.study.collect import Collection, collect  # noqa: E402 - needs LIBERO
from policy_node.policy import load_policy  # noqa: E402 - needs safetensors
from policy_node.rollouts import SimController  # noqa: E402 - needs LIBERO
from policy_node.settings import TrainingSettings  # noqa: E402 - as its neighbours
from policy_node.train import train  # noqa: E402 - needs torch
from sim_node.episodes import run_episode  # noqa: E402 - needs LIBERO
from sim_node.fields import ObservedFields  # noqa: E402 - needs LIBERO
from sim_node.settings import EpisodeLimits  # noqa: E402 - needs LIBERO
from sim_node.tasks import start_names  # noqa: E402 - needs LIBERO
from sim_node.tasks.bowl_on_plate import TASK  # noqa: E402 - needs LIBERO

START = "generated:5:1"
TOPIC_MAP = topic_map_or_default("")
#: Every field that is no command.
OBSERVED = [n for n, s in TOPIC_MAP.fields.items() if s.role not in ("action", "gripper")]
MAX_STEPS = 400
PERIOD_NS = 50_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A policy that has learned one start by heart: it succeeds there."""
    made = tmp_path_factory.mktemp("trained")
    shown = Collection(episodes=3, seed=1, starts=START)
    assert [one.problem for one in collect(made / "shown", shown)] == [""] * 3
    episodes = [(read_episode(bag), None) for bag in Dataset(made / "shown").bags()]
    trained = train(episodes, RELATIVE, seed=0, settings=TrainingSettings(steps=300))
    return trained.policy.save(made / "policy")


@dataclass
class Driven:
    """An episode as it was recorded on the graph."""

    event: EpisodeEvent
    truth: dict[str, Any]
    episode: Episode


@pytest.fixture(scope="module")
def driven(graph, folder):
    """A whole episode; recorder and policy discover each other only when it has begun.

    The sim has found both by then. A recorder that is stopped is on the graph without answering.
    """
    dataset = graph.folder / "driven"
    graph.start("recorder", dataset=dataset)
    graph.start(
        "sim_node",
        dataset=dataset,
        mode="command",
        starts=START,
        max_steps=MAX_STEPS,
        steps_after_success=0,
        wait_for=["policy_node", "recorder"],
    )
    graph.ready("recorder", "sim_node")
    # Until their announcements, which begin close together, have become rare: who is stopped while
    # it takes a message may hold up the others (see pausing.py).
    graph.quiet(4.0)
    graph.nodes.send("recorder", signal.SIGSTOP)
    graph.start("policy_node", policy=folder)
    graph.until(lambda: graph.events, "the episode is announced")
    assert not [s for s in graph.recorders if s.message.startswith("recording")]
    graph.nodes.send("recorder", signal.SIGCONT)
    code, log = graph.expect_exit("sim_node")
    assert code == 0, log
    graph.stop("policy_node", "recorder")
    [event] = [e for e in graph.events if e.event != "started"]
    truth = Dataset(dataset).truth()[event.id]
    return Driven(event, truth, read_episode(dataset / "episodes" / event.id))


@pytest.fixture(scope="module")
def in_process(folder):
    """Steps and commands of the same policy from the same start, fields, and how it went."""
    steps = []
    [start] = start_names(START)
    with TASK.environment() as env:
        result = run_episode(
            env,
            TASK,
            TASK.start(start),
            SimController(load_policy(folder), env, TOPIC_MAP),
            EpisodeLimits(MAX_STEPS, steps_after_success=0),
            on_step=lambda step, command: steps.append((step, command)),
        )
        observed = ObservedFields(env, TOPIC_MAP, OBSERVED)
        return steps, [observed.values(step) for step, _ in steps], result


def test_bag_has_every_command_of_a_policy_that_the_recorder_met_late(driven):
    n = driven.truth["steps"]
    assert (driven.event.event, driven.event.reason) == ("ended", "")
    assert set(driven.event.counts.values()) == {n}
    assert driven.episode.findings == ()
    first, last = driven.event.start_ns, driven.event.end_ns
    assert driven.episode.stamps_ns.tolist() == list(range(first, last + 1, PERIOD_NS))


def test_graph_and_one_process_go_the_same_way(driven, in_process):
    """Equal observations and commands over the whole episode, to the last bit."""
    steps, seen, result = in_process
    episode = driven.episode
    assert len(episode) == len(steps)
    np.testing.assert_array_equal(episode.field("twist"), [c.action_xyz for _, c in steps])
    np.testing.assert_array_equal(episode.field("gripper")[:, 0], [c.gripper for _, c in steps])
    np.testing.assert_array_equal(episode.field("phase")[:, 0], [s.phase_index for s, _ in steps])
    for name in OBSERVED:
        np.testing.assert_array_equal(episode.field(name), [values[name] for values in seen])
    # It grasped and let go: what is compared is more than a reach into the air.
    assert result.is_success
    assert set(np.unique(episode.field("phase"))) == set(range(len(PHASES)))
    assert {-1.0, 1.0} <= set(np.unique(episode.field("gripper")))


def test_graph_and_one_process_end_the_same_way(driven, in_process):
    _, _, result = in_process
    truth = driven.truth
    assert truth["outcome"] == ("succeeded" if result.is_success else "failed")
    assert (truth["steps"], truth["stage"]) == (result.n_steps, result.stage)
    assert truth["success_step"] == result.success_step


# --- curation evaluate --graph --------------------------------------------------------------


def test_evaluate_on_the_graph_prints_rows_as_in_one_process(folder, capsys):
    words = ["evaluate", "--policy", str(folder), "--starts", "generated:5:2", "--json"]
    words += ["--max-steps", "300"]
    assert curation([*words, "--graph"]) == 0
    on_graph = capsys.readouterr().out
    assert curation(words) == 0
    assert on_graph == capsys.readouterr().out
    *rows, summary = (json.loads(line) for line in on_graph.splitlines())
    assert [row["start"] for row in rows] == ["generated-5-000", "generated-5-001"]
    for row in rows:
        assert set(row) == {"policy", "start", "success", "steps", "stage"}
    assert rows[0]["success"]
    assert rows[0]["stage"] == "RELEASE"
    assert (summary["rollouts"], summary["interval"]) == (2, "wilson")


@dataclass
class Running:
    """`curation evaluate --graph` as a process of its own, from more starts than it will reach."""

    process: subprocess.Popen[str]
    logs: Path

    @property
    def nodes(self) -> dict[str, int]:
        """Process ids of its nodes, by name."""
        task = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        found = {}
        for pid in map(int, task.read_text().split()):
            words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
            found[words[2].partition(".")[0]] = pid
        return found

    def ends(self) -> tuple[int, str]:
        """Exit code and stderr."""
        _, err = self.process.communicate(timeout=60.0)
        return self.process.returncode, err


@pytest.fixture
def running(folder, tmp_path):
    """It has printed its first rollout, and is in the middle of the next one."""
    words = [sys.executable, "-m", "curation_ros.cli.main", "evaluate", "--graph"]
    words += ["--policy", str(folder), "--starts", "generated:5:8", "--logs", str(tmp_path)]
    with (
        pausable(),
        subprocess.Popen(
            words,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            # Whoever runs the tests in the background has them ignore it.
            preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        ) as process,
    ):
        first = process.stdout.readline()
        assert first.startswith("generated-5-000: success after "), process.communicate()
        yield Running(process, tmp_path)
        process.kill()


def nodes_of(pids):
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


@pytest.mark.parametrize("node", ["policy_node", "sim_node"])
def test_killed_node_ends_the_evaluation_with_one_line(running, node):
    pids = running.nodes
    os.kill(pids[node], signal.SIGKILL)
    code, err = running.ends()
    log = running.logs / f"{node}.log"
    assert (code, err) == (3, f"error: {node} was ended by signal SIGKILL: its log is {log}\n")
    assert nodes_of(pids.values()) == []


def test_policy_node_that_somebody_stops_is_no_failure_of_the_policy(running):
    pids = running.nodes
    os.kill(pids["policy_node"], signal.SIGTERM)
    code, err = running.ends()
    assert code == 3
    assert err.startswith("error: policy_node was stopped by somebody else: ")
    assert len(err.splitlines()) == 1
    assert nodes_of(pids.values()) == []


def test_rollout_that_is_given_up_is_no_failure_of_the_policy(running):
    """A policy node that hangs: the sim gives up after its patience of 15 s."""
    pids = running.nodes
    os.kill(pids["policy_node"], PAUSE)
    log, deadline_s = running.logs / "sim_node.log", time.monotonic() + PATIENCE_S
    while "no answer on " not in log.read_text():
        assert time.monotonic() < deadline_s, log.read_text()
        time.sleep(0.1)
    # It must run again to be stopped in good order.
    os.kill(pids["policy_node"], RESUME)
    code, err = running.ends()
    assert code == 3
    assert err.startswith("error: rollout from generated-5-0")
    # It may have hung between the two topics of a command.
    answer = r"was aborted: no answer on (command/twist and )?command/gripper within 15 s"
    assert re.search(answer, err), err
    assert len(err.splitlines()) == 1
    assert nodes_of(pids.values()) == []


def test_interrupt_leaves_no_process_behind(running):
    pids = running.nodes
    running.process.send_signal(signal.SIGINT)
    code, err = running.ends()
    assert (code, err) == (130, "error: interrupted\n")
    assert nodes_of(pids.values()) == []


# --- policies that do not fit ---------------------------------------------------------------


def other_columns(card):
    card["columns"] = card["columns"][1:]


def other_width(card):
    card["settings"]["hidden"][0] += 1


def other_scale(card):
    card["action"][0]["scale"] = [-1.0, 0.2, 0.2]


def other_kind(card):
    card["kind"] = "cnn"


def other_phases(card):
    [labels] = [field["labels"] for field in card["observation"]["fields"] if field["labels"]]
    labels[0], labels[1] = labels[1], labels[0]
    card["columns"] = [
        name.replace(labels[0], "x").replace(labels[1], labels[0]).replace("x", labels[1])
        for name in card["columns"]
    ]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (other_columns, "columns: found "),
        (other_width, "expected float32 (257, 21)"),
        (other_scale, "command 'twist': scale is -1.0, expected a finite number above 0"),
        (other_kind, "kind 'cnn' of policy is none of mlp"),
        (other_phases, "the topic map's phases are PREGRASP, DESCEND, "),
        (None, "No such file or directory"),
    ],
)
@pytest.mark.parametrize("how", [["--graph"], []])
def test_policy_that_does_not_fit_is_one_line_and_no_process(
    folder, tmp_path, capsys, change, words, how
):
    spoiled = tmp_path / "policy"
    if change is not None:
        shutil.copytree(folder, spoiled)
        card = json.loads((spoiled / "card.json").read_text())
        change(card)
        (spoiled / "card.json").write_text(json.dumps(card))
    logs = tmp_path / "logs"
    code = curation(["evaluate", "--policy", str(spoiled), "--logs", str(logs), *how])
    out, err = capsys.readouterr()
    assert (code, out) == (3, "")
    assert err.startswith("error: ")
    assert words in err
    assert len(err.splitlines()) == 1
    assert not logs.exists()  # no node was started
