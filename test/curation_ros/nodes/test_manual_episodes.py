"""Episodes that a person starts and stops: services, the owner of `episode`, and the bag."""

from __future__ import annotations

import json
import signal

import pytest
from episodes import topic_map
from graph import PATIENCE_S
from pausing import pausable
from robot import PERIOD_NS, Robot, libero_take, stamp_ns
from std_srvs.srv import SetBool, Trigger

from curation_ros.bags import open_bag
from curation_ros.cli.main import main as curation
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.ros

STEP = 7  # messages of one step of the LIBERO robot


class Stream:
    """A robot that publishes without an end. It owns no episode."""

    def __init__(self, graph, robot):
        self.graph = graph
        self.robot = robot
        self.messages = libero_take(0, 400, counts=False).messages
        self.sent = 0

    def continue_for(self, steps):
        """Publish more steps, and give all nodes time to take them."""
        chunk = self.messages[self.sent : self.sent + steps * STEP]
        self.sent += len(chunk)
        self.robot.send(chunk)
        self.graph.quiet(0.4)
        return chunk

    @property
    def last_ns(self):
        return stamp_ns(self.messages[self.sent - 1][1])


@pytest.fixture(scope="module")
def dataset(graph):
    path = graph.folder / "dataset"
    graph.start("recorder", dataset=path, auto=False, task="pour")
    graph.start("curator", dataset=path)
    graph.ready("recorder", "curator")
    return path


@pytest.fixture(scope="module")
def stream(graph, dataset):
    with Robot(graph, owner=False) as robot:
        robot.until_found(2)
        stream = Stream(graph, robot)
        stream.continue_for(1)
        yield stream


def by_hand(graph, service):
    return graph.call(Trigger, f"recorder/{service}", Trigger.Request())


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    """Each command joins the graph again, which takes seconds on a busy machine."""
    monkeypatch.setattr("curation_ros.cli.record._PATIENCE_S", PATIENCE_S)


def command_line(capsys, *words):
    code = curation(["record", *words, "--json"])
    out, err = capsys.readouterr()
    return code, json.loads(out) if out else err


def test_start_without_a_clock_is_refused(graph, dataset):
    answer = by_hand(graph, "start")
    assert not answer.success
    assert "/eef_pose" in answer.message


def test_episode_by_command_line(graph, dataset, stream, capsys):
    stream.continue_for(20)
    start_ns = stream.last_ns + 1
    code, started = command_line(capsys, "start")
    assert (code, started["name"]) == (0, "pour-0001")
    inside = stream.continue_for(60)
    end_ns = stream.last_ns
    code, stopped = command_line(capsys, "stop")
    assert (code, stopped) == (0, started)
    stream.continue_for(5)
    decision = graph.settled(dataset, started["episode"])
    assert (decision.evidence["bag"], decision.verdict) == ("equal", "review")
    assert decision.reason.startswith("object_coupling cannot tell: it ends in LIFT")
    assert decision.reason.endswith("; no reference")

    bag = open_bag(dataset / "episodes" / started["episode"])
    event = bag.event()
    assert (event.start_ns, event.end_ns, event.event) == (start_ns, end_ns, "ended")
    assert {t: topic.count for t, topic in bag.topics.items()} == {
        f"/{topic}": 60 for topic, _ in inside
    }
    episode = read_episode(bag.path)
    assert len(episode) == 60
    assert episode.stamps_ns.tolist() == list(
        range(start_ns - 1 + PERIOD_NS, end_ns + 1, PERIOD_NS)
    )
    assert episode.findings == ()


def test_recorder_owns_the_episode(graph, dataset, stream):
    mine = [e for e in graph.events if e.name == "pour-0001"]
    assert [(e.event, e.source) for e in mine] == [("started", "live"), ("ended", "live")]
    owners = graph.node.get_publishers_info_by_topic("episode")
    assert [info.node_name for info in owners] == ["recorder"]


def test_a_person_finalizes(graph, dataset, stream, capsys):
    episode_id = next(e.id for e in graph.events if e.name == "pour-0001")
    code, _ = command_line(capsys, "keep")
    assert code == 0
    published = graph.decided(episode_id, revision=2)
    assert published.values["verdict"] == "keep"
    last = Dataset(dataset).decisions(episode_id)[-1]
    assert (last.by, last.verdict, last.revision) == ("person", "keep", 2)
    answer = graph.call(SetBool, "recorder/finalize", SetBool.Request(data=False))
    assert answer.success
    assert graph.decided(episode_id, revision=3).values["verdict"] == "discard"
    assert Dataset(dataset).truth()[episode_id]["button"] == "discard"


def test_start_twice_and_stop_twice_are_refused(graph, dataset, stream, capsys):
    assert by_hand(graph, "start").success
    again = by_hand(graph, "start")
    assert (again.success, again.message) == (
        False,
        "episode pour-0002 is running: stop it first",
    )
    stream.continue_for(10)
    assert by_hand(graph, "stop").success
    # The next episode may begin while the last one still waits for late samples.
    assert json.loads(by_hand(graph, "start").message)["name"] == "pour-0003"
    stream.continue_for(10)
    assert by_hand(graph, "stop").success
    assert not by_hand(graph, "stop").success
    code, complaint = command_line(capsys, "stop")
    assert (code, complaint) == (3, "error: recorder: no episode was started by ~/start\n")
    stream.continue_for(5)
    for name in ("pour-0002", "pour-0003"):
        episode_id = next(e.id for e in graph.events if e.name == name)
        graph.settled(dataset, episode_id)
        assert len(read_episode(dataset / "episodes" / episode_id)) == 10


def test_recorder_stopped_during_an_episode_publishes_its_end(graph, dataset, stream):
    started = json.loads(by_hand(graph, "start").message)
    stream.continue_for(15)
    # The curator has all messages. The recorder takes its pending messages before it ends.
    everything = {f"count/{topic}": "15" for topic in topic_map().topics}

    def has_everything():
        mine = [s.values for s in graph.health if s.hardware_id == started["episode"]]
        return any(everything.items() <= values.items() for values in mine)

    graph.until(has_everything, "the curator has 15 steps")
    graph.nodes.send("recorder", signal.SIGINT)
    code, log = graph.expect_exit("recorder")
    assert code == 0, log
    event = graph.until(
        lambda: next(
            (e for e in graph.events if e.id == started["episode"] and e.event != "started"), None
        ),
        "the end of the episode",
    )
    assert (event.event, event.reason) == ("aborted", "aborted: the recorder was stopped")
    assert event.end_ns == stream.last_ns
    decision = graph.settled(dataset, started["episode"])
    assert (decision.verdict, decision.evidence["bag"]) == ("review", "equal")
    # The gripper was not open at the start, and the task was not finished.
    assert {f.id for f in decision.findings} == {"aborted", "clipped-start", "unfinished"}
    assert decision.reason.startswith("aborted: the recorder was stopped")
    assert len(read_episode(dataset / "episodes" / started["episode"])) == 15


def test_numbers_continue_after_a_restart(graph, dataset, stream):
    with pausable():
        graph.start("recorder", dataset=dataset, auto=False, task="pour")
    stream.robot.until_found(2)
    stream.continue_for(3)
    assert json.loads(by_hand(graph, "start").message)["name"] == "pour-0005"
    assert by_hand(graph, "stop").success


@pytest.mark.parametrize("pressed", ["start", "stop"])
def test_messages_sent_before_a_request_come_before_it(graph, dataset, stream, pressed):
    """The recorder is behind, and finds the request together with earlier messages."""
    if pressed == "stop":
        assert by_hand(graph, "start").success
    client = graph.node.create_client(Trigger, f"recorder/{pressed}")
    graph.until(client.service_is_ready, "the service")
    graph.pause("recorder")
    stream.continue_for(30)
    button = client.call_async(Trigger.Request())
    graph.quiet(0.2)
    graph.resume("recorder")
    graph.until(button.done, "the answer")
    answer = json.loads(button.result().message)
    graph.node.destroy_client(client)
    if pressed == "start":
        event = graph.until(
            lambda: next((e for e in graph.events if e.id == answer["episode"]), None), "its start"
        )
        assert event.start_ns == stream.last_ns + 1
        assert by_hand(graph, "stop").success
    else:
        stream.continue_for(5)
        graph.recorded(answer["episode"])
        assert len(read_episode(dataset / "episodes" / answer["episode"])) == 30


def test_missing_recorder_is_one_line(graph, dataset, stream, capsys, monkeypatch):
    monkeypatch.setattr("curation_ros.cli.record._PATIENCE_S", 0.3)
    code, complaint = command_line(capsys, "start", "--recorder", "nobody")
    assert code == 3
    assert complaint == "error: no nobody/start within 0.3 s: is it running?\n"


def test_recorder_that_follows_refuses_to_start(graph, dataset, stream):
    graph.start("recorder", "follower", {"__node": "follower"}, dataset=graph.folder / "follower")
    answer = graph.call(Trigger, "follower/start", Trigger.Request())
    assert (answer.success, answer.message) == (
        False,
        "the recorder follows the episode topic (auto is true)",
    )
