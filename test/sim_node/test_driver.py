"""Episodes of the toy task, driven without ROS: events, messages, aborts, and whole bags."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from toy import COASTER, CUP, ToyEnvironment, ToyTask
from toy_map import RAW, TOY_MAP

from curation_ros.core.errors import SimError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.study.collect import Collection, collect
from sim_node.driving import Commands, Driver, NoPeers
from sim_node.episodes import run_episode, run_to_end
from sim_node.fields import CommandedFields, ObservedFields
from sim_node.messages import COMMAND_TOPICS, command_messages
from sim_node.planning import EpisodePlan
from sim_node.settings import DriveSettings
from sim_node.tasks import TASKS, process_environment
from sim_node.tasks.task import Step

TASK = ToyTask()
START = TASK.start("generated-0-000")
PERIOD_NS = ToyEnvironment.control_period_ns


class Sink:
    """Keeps what is sent."""

    def __init__(self):
        self.events, self.messages = [], []

    def send(self, message):
        self.messages.append(message)

    def event(self, event):
        self.events.append(event)

    def stamps(self, topic="eef_pose"):
        stamps = [m.content["header"]["stamp"] for m in self.messages if m.topic == topic]
        return [s["sec"] * 10**9 + s["nanosec"] for s in stamps]


class Peers(NoPeers):
    """A recorder that confirms the first step after some questions."""

    def __init__(self, unconfirmed=0, commanders=""):
        self.unconfirmed_left, self.commanders = unconfirmed, commanders

    def unconfirmed(self, episode_id):
        self.unconfirmed_left -= 1
        return "recorder" if self.unconfirmed_left >= 0 else ""

    def several_commanders(self):
        return self.commanders


def plan(defect="none"):
    return EpisodePlan(0, START.name, 0, defect, expert_seed=5, seed=6)


def driver(sink, peers=None, env=None, **settings):
    commands = Commands()
    made = Driver(
        env or ToyEnvironment(), TASK, sink, commands, DriveSettings(**settings), peers, stamp_ns=0
    )
    return made, commands


def answer(commands, stamp_ns, gripper="gripper"):
    """Put a command into the mailbox, as subscriptions do."""
    twist = SimpleNamespace(twist=SimpleNamespace(linear=SimpleNamespace(x=0.1, y=0.0, z=0.0)))
    joints = SimpleNamespace(name=[gripper], position=[-1.0])
    for topic, message in zip(COMMAND_TOPICS, (twist, joints), strict=True):
        commands.take(topic, stamp_ns, message)


@pytest.fixture
def fast_clock(monkeypatch):
    """Half a second passes at each look at the clock."""
    now = [0.0]

    def tick():
        now[0] += 0.5
        return now[0]

    monkeypatch.setattr("sim_node.driving.time.monotonic", tick)


# --- the expert ---------------------------------------------------------------------------------


def test_driven_episode_equals_the_one_in_process():
    sink = Sink()
    drive, _ = driver(sink)
    episode = run_to_end(drive.drive(plan(), START, "cup-0001"))
    result = run_episode(ToyEnvironment(), TASK, START, TASK.expert(5))
    assert episode.run.result() == result
    assert (result.is_success, episode.outcome, episode.reason) == (True, "succeeded", "")
    started, ended = sink.events
    assert (started.event, ended.event) == ("started", "ended")
    assert ended.start_ns == started.start_ns == PERIOD_NS
    assert sink.stamps() == list(range(PERIOD_NS, ended.end_ns + 1, PERIOD_NS))
    assert set(ended.counts.values()) == {result.n_steps}
    assert set(ended.counts) == set(TOY_MAP.topics)
    truth = json.loads(json.dumps(episode.truth()))
    assert (truth["task"], truth["defect"], truth["stage"]) == ("toy/0", "none", "LEAVE")


def test_stamps_never_go_back_over_episodes():
    sink = Sink()
    drive, _ = driver(sink, max_steps=3)
    for name in ("cup-0001", "cup-0002"):
        run_to_end(drive.drive(plan(), START, name))
    assert sink.stamps() == [k * PERIOD_NS for k in range(1, 7)]


def test_first_step_is_repeated_with_its_command_until_the_recorder_has_it(fast_clock):
    sink = Sink()
    drive, _ = driver(sink, Peers(unconfirmed=6), max_steps=2, command_timeout_s=5.0)
    episode = run_to_end(drive.drive(plan(), START, "cup-0001"))
    assert episode.reason == ""
    for topic in ("eef_pose", *COMMAND_TOPICS):
        stamps = sink.stamps(topic)
        assert stamps.count(PERIOD_NS) > 1
        assert stamps.count(2 * PERIOD_NS) == 1


def test_recorder_that_never_has_the_first_step_aborts_the_episode(fast_clock):
    sink = Sink()
    drive, _ = driver(sink, Peers(unconfirmed=10**6), command_timeout_s=1.0)
    episode = run_to_end(drive.drive(plan(), START, "cup-0001"))
    assert episode.reason == "the first step does not reach recorder"
    assert episode.outcome == "failed"
    ended = sink.events[-1]
    assert (ended.event, ended.reason) == ("aborted", f"aborted: {episode.reason}")
    assert ended.end_ns == ended.start_ns


def test_diverged_simulation_aborts_the_episode():
    class Diverges(ToyEnvironment):
        def step(self, action_xyz, gripper):
            if self.n_steps == 4:
                raise SimError("the simulation diverged in step 5")
            return super().step(action_xyz, gripper)

    sink = Sink()
    drive, _ = driver(sink, env=Diverges())
    episode = run_to_end(drive.drive(plan(), START, "cup-0001"))
    assert (episode.reason, episode.run.n_steps) == ("the simulation diverged in step 5", 4)
    assert sink.events[-1].end_ns == 4 * PERIOD_NS


def test_script_that_is_closed_says_that_the_node_was_stopped():
    sink = Sink()
    drive, _ = driver(sink)
    script = drive.drive(plan(), START, "cup-0001")
    for _ in range(3):
        next(script)
    script.close()
    assert sink.events[-1].reason == "aborted: the sim node was stopped"


# --- commands by messages -----------------------------------------------------------------------


def test_lockstep_waits_for_both_topics_of_each_stamp():
    sink = Sink()
    drive, commands = driver(sink, mode="command", max_steps=2)
    script = drive.drive(plan(), START, "cup-0001")
    assert not next(script)
    commands.take(COMMAND_TOPICS[0], PERIOD_NS, None)
    assert not next(script)
    answer(commands, PERIOD_NS)
    assert not next(script)  # the next observation
    assert sink.stamps() == [PERIOD_NS, 2 * PERIOD_NS]
    answer(commands, 2 * PERIOD_NS)
    episode = run_to_end(script)
    assert (episode.run.n_steps, episode.reason) == (2, "")
    assert sink.events[-1].counts["command/twist"] == 2


def test_command_that_never_comes_aborts(fast_clock):
    drive, commands = driver(Sink(), mode="command", command_timeout_s=3.0)
    script = drive.drive(plan(), START, "cup-0001")
    next(script)
    commands.take(COMMAND_TOPICS[0], PERIOD_NS, None)
    episode = run_to_end(script)
    assert episode.reason == "no answer on command/gripper within 3 s"


@pytest.mark.parametrize(
    ("peers", "joint", "reason"),
    [
        (Peers(commanders="a and b"), "gripper", "commands come from a and b: stop all but one"),
        (None, "thumb", "command/gripper has no position of joint 'gripper'"),
    ],
)
def test_commands_that_cannot_be_executed_abort(peers, joint, reason):
    drive, commands = driver(Sink(), peers, mode="command")
    script = drive.drive(plan(), START, "cup-0001")
    next(script)
    answer(commands, PERIOD_NS, joint)
    assert run_to_end(script).reason == reason


def test_reset_that_is_asked_for_aborts():
    drive, _ = driver(Sink(), mode="command")
    script = drive.drive(plan(), START, "cup-0001")
    next(script)
    drive.reset_wanted = True
    assert run_to_end(script).reason == "reset was asked for"


def test_free_episode_rests_without_commands(fast_clock):
    sink = Sink()
    drive, _ = driver(sink, mode="command", sync="free", max_steps=4)
    assert run_to_end(drive.drive(plan(), START, "cup-0001")).run.n_steps == 4
    assert sink.messages[-1].content["pose"]["position"] == {"x": 0.0, "y": 0.0, "z": 0.2}


# --- a task of one file and a topic map ---------------------------------------------------------


@pytest.fixture
def toy(monkeypatch, tmp_path):
    """The toy task as one more line of the table, and its topic map as a file."""
    monkeypatch.setitem(TASKS, TASK.name, TASK)
    process_environment.cache_clear()
    path = tmp_path / "toy.yaml"
    path.write_text(json.dumps(RAW))
    yield {"simulated_task": TASK.name, "topic_map": str(path)}
    process_environment.cache_clear()


def test_demonstrations_of_a_new_task_are_collected(toy, tmp_path):
    wanted = Collection(6, contamination=0.5, seed=4, name_prefix="cup", **toy)
    assert [one.problem for one in collect(tmp_path / "data", wanted)] == [""] * 6
    dataset = Dataset(tmp_path / "data")
    truth = {t["name"]: t for t in dataset.truth().values()}
    assert {t["task"] for t in truth.values()} == {"toy/0"}
    for bag in dataset.bags():
        episode = read_episode(bag)
        assert episode.findings == ()
        line = truth[episode.name]
        is_clean = line["defect"] == "none"
        assert line["outcome"] == ("succeeded" if is_clean else "failed")
        away_m = episode.field("cup")[-1] - episode.field("coaster")[0]
        assert (np.linalg.norm(away_m) < 0.03) == is_clean
        if not is_clean:
            release = line["release_step"]
            assert episode.phase_labels[int(episode.phase[release])] == "CARRY"
            assert set(episode.field("grip")[release:, 0]) == {-1.0}


def test_policy_of_a_new_task_sees_and_commands_by_its_map():
    env = ToyEnvironment()
    step = Step(0, env.reset(START.state), 1, "CARRY", 0.5)
    values = ObservedFields(env, TOY_MAP, ["hand", "cup", "phase"]).values(step)
    assert values["cup"].tolist() == step.observation.objects[CUP][0].tolist()
    assert values["phase"].tolist() == [1.0]
    command = CommandedFields(TOY_MAP, ["motion", "grip"]).command(
        {"motion": np.array([0.1, 0.2, 0.3]), "grip": np.array([1.0])}
    )
    linear = next(command_messages(0, command)).content["twist"]["linear"]
    assert (linear["y"], command.gripper) == (0.2, 1.0)
    assert COASTER in step.observation.objects
