"""A recorder that follows `episode`: complete bags, whatever happens to it."""

from __future__ import annotations

import signal
from collections import Counter
from contextlib import suppress

import pytest
from mcap.records import Channel
from mcap_ros2.reader import read_ros2_messages
from robot import Robot, distinct, libero_take, plain, stamp_ns
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from curation_ros.bags import open_bag
from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_file import Message, walk
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.ros

RATE_HZ = 60.0
SIGNALS = {"int": signal.SIGINT, "term": signal.SIGTERM, "hup": signal.SIGHUP}
KILLED = dict.fromkeys(("killed-0", "killed-1", "killed-2"), signal.SIGKILL)
TOGETHER = ("first", "second")
#: A kill costs less than this of the episode, if the recorder gets to run.
MOST_LOST_S = 0.3
#: Messages of a third of a second. A recorder that has not flushed them loses more than that.
LAST = 140


class Sessions:
    """Eight recorders on one graph, and one episode that each of them sees differently."""

    def __init__(self, graph):
        self.graph = graph
        self.sent = {}
        self.codes = {}

    def dataset(self, key):
        return self.graph.folder / ("together" if key in TOGETHER else key)

    def bag(self, key):
        return self.dataset(key) / "episodes" / self.take.id

    def written(self, key):
        """Topic -> messages of the episode that are on disk, while it is recorded."""
        found = list((self.dataset(key) / "episodes" / ".partial" / self.take.id).glob("*.mcap"))
        topics, counts = {}, Counter()
        with suppress(TornFileError):
            for record in walk(found[0]) if found else ():
                if isinstance(record, Channel):
                    topics[record.id] = record.topic.lstrip("/")
                elif isinstance(record, Message):
                    counts[topics[record.channel_id]] += 1
        return dict(counts)

    def record(self, robot):
        keys = (*TOGETHER, *SIGNALS, *KILLED)
        for key in keys:
            self.graph.start("recorder", key, dataset=self.dataset(key))
        robot.until_found(len(keys))
        self.take = libero_take(1, 240)
        messages = self.take.messages
        robot.tell(self.take.started)
        done = 0
        # At one tenth, two tenths ... of the episode, and a little later each time, so that the
        # kills have different distances from the last flush.
        for k, (key, number) in enumerate({**KILLED, **SIGNALS}.items(), 1):
            upto = self.sent[key] = len(messages) * k // 10 + 13 * k
            # On a busy machine a recorder may be late, so it catches up just before it is killed.
            caught_up = upto if key in SIGNALS else upto - LAST
            robot.send(messages[done:caught_up], rate_hz=RATE_HZ)
            self.graph.until(
                lambda key=key, n=caught_up: self.written(key) == distinct(messages[:n]),
                f"{key} has written everything",
            )
            robot.send(messages[caught_up:upto], rate_hz=RATE_HZ)
            done = upto
            self.graph.nodes.send(key, number)
            if key in SIGNALS:
                self.graph.until(self.bag(key).exists, f"the bag of {key}")
        robot.send(messages[done:], rate_hz=RATE_HZ)
        robot.tell(self.take.ended)
        for key in (*SIGNALS, *KILLED):
            self.codes[key], _ = self.graph.expect_exit(key)
        self.graph.until(self.bag("first").exists, "the whole bag")


@pytest.fixture(scope="module")
def robot(graph):
    with Robot(graph) as robot:
        yield robot


@pytest.fixture(scope="module")
def sessions(graph, robot):
    sessions = Sessions(graph)
    sessions.record(robot)
    return sessions


def test_two_recorders_on_one_dataset_make_one_bag(graph, sessions):
    # The bag is there a moment before the recorder publishes that.
    closed = f"closed {sessions.take.name}"
    graph.until(lambda: any(closed in graph.log(key) for key in TOGETHER), closed)
    logs = {key: graph.log(key) for key in TOGETHER}
    idle = [key for key in TOGETHER if "another recorder has this episode" in logs[key]]
    assert len(idle) == 1
    assert [key for key in TOGETHER if closed in logs[key]] == [
        key for key in TOGETHER if key not in idle
    ]
    assert all(graph.nodes.ended(key) is None for key in TOGETHER)
    assert list(Dataset(sessions.dataset("first")).bags()) == [sessions.bag("first")]
    assert read_episode(sessions.bag("first")).findings == ()


def test_rosbags_reads_all_messages(sessions):
    sent = iter_sent(sessions.take)
    with AnyReader(
        [sessions.bag("first")], default_typestore=get_typestore(Stores.ROS2_JAZZY)
    ) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            assert plain(message) == next(sent[connection.topic])
    assert not any(list(rest) for rest in sent.values())


def test_mcap_reads_all_messages(sessions):
    sent = iter_sent(sessions.take)
    path = next(sessions.bag("first").glob("*.mcap"))
    for read in read_ros2_messages(path):
        assert plain(read.ros_msg) == next(sent[read.channel.topic])
        assert read.sequence_count > 0
        assert read.publish_time_ns <= read.log_time_ns
    assert not any(list(rest) for rest in sent.values())


def bag_counts(bag):
    return {name.lstrip("/"): topic.count for name, topic in bag.topics.items()}


def iter_sent(take):
    return {
        f"/{topic}": iter([plain(m) for m in take.of(topic)]) for topic in distinct(take.messages)
    }


@pytest.mark.parametrize("key", SIGNALS)
def test_signal_during_an_episode_leaves_a_complete_bag(sessions, key):
    assert sessions.codes[key] == 0
    bag = open_bag(sessions.bag(key))
    assert (bag.path / "metadata.yaml").exists()
    event = bag.event()
    assert (event.event, event.reason) == ("aborted", "aborted: the recorder was stopped")
    assert bag_counts(bag) == distinct(sessions.take.messages[: sessions.sent[key]])
    assert {f.id for f in read_episode(bag.path).findings} == {"aborted"}


def test_kill_costs_a_fraction_of_a_second(graph, robot, sessions):
    """Each recorder is started again on its dataset, and recovers the partial bag."""
    for key in KILLED:
        assert sessions.codes[key] == -signal.SIGKILL
        assert not sessions.bag(key).exists()
        graph.start("recorder", f"{key}-again", dataset=sessions.dataset(key))
    lost_s = {}
    for key in KILLED:
        graph.until(sessions.bag(key).exists, f"{key} is recovered")
        episode = read_episode(sessions.bag(key))
        assert "recovered" in {f.id for f in episode.findings}
        sent_ns = stamp_ns(sessions.take.messages[sessions.sent[key] - 1][1])
        # Played faster than real time.
        speed = 20.0 / RATE_HZ
        lost_s[key] = speed * (sent_ns - int(episode.stamps_ns[-1])) / 1e9
        kept = sessions.dataset(key) / "quarantine" / f"{sessions.take.id}.partial"
        graph.until(kept.is_dir, "the torn original")  # moved after the new bag is there
    print(f"lost by kill -9: {', '.join(f'{1e3 * s:.0f} ms' for s in lost_s.values())}")
    # Messages on disk are never lost. On a busy machine one recorder may lose all others. An
    # incomplete step is lost, too.
    n_topics = len(distinct(sessions.take.messages))
    assert max(lost_s.values()) < (LAST / n_topics + 1.0) / RATE_HZ + 1e-6
    assert min(lost_s.values()) < MOST_LOST_S


def test_latched_past_of_a_restarted_recorder_is_no_fault(graph, sessions):
    for key in KILLED:
        graph.ready(f"{key}-again")
        log = graph.log(f"{key}-again")
        assert "closed" in log
        assert "[ERROR]" not in log
        assert not list((sessions.dataset(key) / "episodes" / ".partial").iterdir())
    graph.stop(*(f"{key}-again" for key in KILLED))


def test_known_id_is_refused(graph, robot, sessions):
    """An episode that the dataset has already is played again. Its bag does not change."""
    bag = sessions.bag("int")
    before = {path.name: path.read_bytes() for path in bag.iterdir()}
    graph.start("recorder", "refusing", dataset=sessions.dataset("int"))
    graph.ready("refusing")
    # The killed recorders still count as subscribers, so the owner cannot tell when this one has
    # found it. It plays until it has.
    line = "the dataset already has this episode"
    for _ in range(5):
        robot.play(sessions.take)
        with suppress(AssertionError):
            graph.until(lambda: line in graph.log("refusing"), line, timeout_s=3.0)
            break
    graph.ready("refusing", line=line)
    graph.stop("refusing", *TOGETHER)
    assert {path.name: path.read_bytes() for path in bag.iterdir()} == before
