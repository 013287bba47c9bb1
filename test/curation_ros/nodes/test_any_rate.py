"""A robot whose topics run at 30, 100 and 250 Hz, with jitter, losses and late messages.

It has no phases, and one of its topics has no header. It runs in real time, because the middleware
stamps messages without a header when they are sent.
"""

from __future__ import annotations

import contextlib
import io
import shutil
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from graph import Graph, jsonl
from naive_resampling import resample
from robot import Robot

from curation_ros.bags import open_bag
from curation_ros.cli.main import main as curation
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.nodes.messages import joints_to_ros, pose_to_ros, twist_to_ros

std_msgs = pytest.importorskip("std_msgs.msg")

pytestmark = pytest.mark.ros

ARM = ("shoulder", "elbow", "wrist")
TOOL, JOINTS, WIDTH = "tool/pose", "joints", "hand/width"
SERVO, HAND = "servo/command", "hand/command"
RATES_HZ = {TOOL: 100.0, JOINTS: 250.0, WIDTH: 30.0, SERVO: 100.0, HAND: 30.0}
EPISODE_S, AFTER_S, CLOSE_S, OPEN_S = 2.5, 0.3, 0.7, 2.2
#: Distance of stamps from their grid, in periods; share of late messages, and how late, in s.
JITTER, LATE_SHARE, LATE_S = 0.35, 0.1, 0.03
#: No gap that a busy machine causes is as long as the first. If it delays a message by more than
#: the second, the episode is played again, up to that many takes.
MAX_GAP_S, MOST_LATE_S, MOST_TAKES = 1.0, 0.15, 4
#: How long the curator waits for withheld messages, and how long DDS needs to send again.
SHORT_S, LONG_S = 0.5, 20.0
MAP = {
    "max_gap_s": MAX_GAP_S,
    "fields": {
        "tool": {
            "topic": TOOL,
            "type": "geometry_msgs/msg/PoseStamped",
            "role": "clock",
            "values": ["pose.position.x", "pose.position.y", "pose.position.z"],
            "unit": "m",
        },
        "arm": {
            "topic": JOINTS,
            "type": "sensor_msgs/msg/JointState",
            "role": "observation",
            "values": [f"position.{name}" for name in ARM],
            "unit": "rad",
            "interpolate": True,
        },
        "width": {
            "topic": WIDTH,
            "type": "std_msgs/msg/Float64",
            "role": "observation",
            "values": ["data"],
            "unit": "m",
            "stamp": "source",
        },
        "velocity": {
            "topic": SERVO,
            "type": "geometry_msgs/msg/TwistStamped",
            "role": "action",
            "values": ["twist.linear.x", "twist.linear.y", "twist.linear.z"],
        },
        "jaw": {
            "topic": HAND,
            "type": "sensor_msgs/msg/JointState",
            "role": "gripper",
            "values": ["position.jaw"],
            "unit": "m",
        },
    },
    "gripper": {
        "field": "jaw",
        "opens": 1,
        "kind": "continuous",
        "open_value": 0.08,
        "closed_value": 0.0,
        "fingers": "width",
    },
    "state": ["tool", "width"],
    "action": ["velocity", "jaw"],
}
FIELD_OF = {spec["topic"]: name for name, spec in MAP["fields"].items()}


@dataclass(frozen=True)
class Sending:
    """A message, its stamp, and when it is sent, in ns from the start of the episode."""

    topic: str
    offset_ns: int
    due_ns: int
    values: tuple[float, ...]


@dataclass
class Performance:
    """The messages of one episode, and its event."""

    name: str
    sendings: list[Sending]
    counts: dict[str, int]
    withheld: list[Sending] = field(default_factory=list)
    event: EpisodeEvent | None = None

    @property
    def id(self) -> str:
        assert self.event is not None
        return self.event.id

    def rows(self, topic: str) -> list[tuple[int, tuple[float, ...]]]:
        """Stamps and values of the messages on a topic."""
        assert self.event is not None
        sent = [s for s in (*self.sendings, *self.withheld) if s.topic == topic]
        return [(self.event.start_ns + s.offset_ns, s.values) for s in sent]


def perform(seed: int, name: str, *, open_s: float = OPEN_S) -> Performance:
    """A demonstration: the tool moves out and back, and the jaw closes and opens."""
    rng = np.random.default_rng(seed)
    reach = rng.uniform(0.1, 0.3, 3)
    pace = 2.0 * np.pi / EPISODE_S

    def values(topic: str, at_s: float) -> tuple[float, ...]:
        if topic == TOOL:
            return tuple(reach * (1.0 - np.cos(pace * at_s)))
        if topic == JOINTS:
            return tuple(2.0 * reach * (1.0 - np.cos(pace * at_s + 0.1)))
        if topic == SERVO:
            return tuple(reach * pace * np.sin(pace * at_s) + 0.01 * rng.standard_normal(3))
        is_open = not CLOSE_S <= at_s - (0.05 if topic == WIDTH else 0.0) < open_s
        return (0.08 if is_open else 0.0,)

    sendings = []
    for topic, rate_hz in RATES_HZ.items():
        period_s = 1.0 / rate_hz
        n = int((EPISODE_S + AFTER_S) * rate_hz)
        at_s = (
            np.arange(n) + rng.uniform(0.2, 0.8) + JITTER * rng.uniform(-0.5, 0.5, n)
        ) * period_s
        late = rng.uniform(0.0005, 0.004, n) + LATE_S * (rng.random(n) < LATE_SHARE)
        due_s = np.maximum.accumulate(at_s + late)  # messages of one writer keep their order
        sendings += [
            Sending(topic, int(a * 1e9), int(d * 1e9), values(topic, a))
            for a, d in zip(at_s, due_s, strict=True)
        ]
    sendings.sort(key=lambda s: s.due_ns)
    inside = [s for s in sendings if s.offset_ns <= EPISODE_S * 1e9]
    # Only the middleware knows the stamps of messages without a header.
    counts = {t: sum(s.topic == t for s in inside) for t in RATES_HZ if t != WIDTH}
    return Performance(name, sendings, counts)


def losing(one: Performance, topic: str, share: float) -> Performance:
    """Some messages are never sent, although the owner has counted them."""
    rng = np.random.default_rng(7)
    kept = [s for s in one.sendings if s.topic != topic or rng.random() >= share]
    return replace(one, sendings=kept)


def disordered(one: Performance, topic: str) -> Performance:
    """Two consecutive messages of a topic are sent in the wrong order."""
    at = [k for k, s in enumerate(one.sendings) if s.topic == topic][40:42]
    first, second = (one.sendings[k] for k in at)
    swapped = list(one.sendings)
    swapped[at[0]] = replace(second, due_ns=first.due_ns)
    swapped[at[1]] = replace(first, due_ns=second.due_ns)
    return replace(one, sendings=swapped)


def withholding(one: Performance, topic: str, last_s: float) -> Performance:
    """The last messages of a topic are withheld."""
    limit = (EPISODE_S - last_s) * 1e9
    back = [s for s in one.sendings if s.topic == topic and s.offset_ns > limit]
    return replace(one, sendings=[s for s in one.sendings if s not in back], withheld=back)


def to_message(one: Sending, start_ns: int) -> Any:
    stamp_ns, v = start_ns + one.offset_ns, one.values
    if one.topic == TOOL:
        return pose_to_ros(v, (0.0, 0.0, 0.0, 1.0), stamp_ns)
    if one.topic == JOINTS:
        return joints_to_ros(ARM, v, [0.0] * 3, [0.0] * 3, stamp_ns)
    if one.topic == SERVO:
        return twist_to_ros(v, stamp_ns)
    if one.topic == HAND:
        return joints_to_ros(["jaw"], v, [0.0], [0.0], stamp_ns)
    return std_msgs.Float64(data=v[0])


def play(
    graph: Graph, robot: Robot, make: Callable[[], Performance], dataset: Path
) -> Performance:
    """Run an episode in real time, and again if a busy machine has delayed the robot.

    Messages without a header are stamped when they are sent, so a delay changes the episode.
    """
    for last in (*[False] * (MOST_TAKES - 1), True):
        one = make()
        late_s = play_once(robot, one)
        if last or late_s <= MOST_LATE_S:
            break
        assert graph.recorded(one.id).message.startswith("closed ")
        shutil.rmtree(dataset / "episodes" / one.id)
    return one


def play_once(robot: Robot, one: Performance) -> float:
    """Run an episode. Returns the largest delay of a message without a header, in s."""
    late_ns = 0
    start_ns = time.time_ns()
    started = EpisodeEvent(new_episode_id(), one.name, "started", start_ns)
    end_ns = start_ns + int(EPISODE_S * NS_PER_S)
    one.event = replace(started, event="ended", end_ns=end_ns, counts=one.counts)
    robot.tell(started)
    for sending in one.sendings:
        time.sleep(max(0, start_ns + sending.due_ns - time.time_ns()) / NS_PER_S)
        if sending.topic == WIDTH:
            late_ns = max(late_ns, time.time_ns() - start_ns - sending.due_ns)
        robot.publishers[sending.topic].publish(to_message(sending, start_ns))
    robot.tell(one.event)
    return late_ns / NS_PER_S


def send_withheld(robot: Robot, one: Performance) -> None:
    assert one.event is not None
    for sending in one.withheld:
        robot.publishers[sending.topic].publish(to_message(sending, one.event.start_ns))


#: Name -> (the episode, its expected findings of the recording).
PERFORMANCES = {
    "good": (lambda: perform(10, "good"), set()),
    "early": (lambda: perform(11, "early", open_s=1.3), set()),
    "lossy": (lambda: losing(perform(12, "lossy"), JOINTS, 0.15), {"incomplete"}),
    "lossy_clock": (lambda: losing(perform(13, "lossy_clock"), TOOL, 0.05), {"incomplete"}),
    "disordered": (lambda: disordered(perform(14, "disordered"), SERVO), {"clock-back"}),
}
LATE = "late"


@dataclass
class Session:
    """Everything that was recorded."""

    dataset: Any
    reference: Any
    played: dict[str, Performance]
    decided: dict[str, list[Any]]

    def live(self, name: str) -> list[Any]:
        """Decisions on an episode after its curator had compared it with its bag."""
        return self.decided[name]

    def bag(self, name: str) -> Any:
        return self.dataset / "episodes" / self.played[name].id


@pytest.fixture(scope="module")
def session(graph):
    map_file = graph.folder / "robot.yaml"
    map_file.write_text(yaml.safe_dump(MAP))
    reference, dataset = graph.folder / "reference", graph.folder / "dataset"
    played, decided = {}, {}
    with Robot(graph, topic_map_from_json(MAP)) as robot:
        graph.start("recorder", "reference", dataset=reference, topic_map=map_file)
        robot.until_found()
        for k in range(3):
            one = play(graph, robot, partial(perform, k, f"reference-{k}"), reference)
            assert graph.recorded(one.id).message.startswith("closed ")
        graph.stop("reference")
        options = {"dataset": dataset, "topic_map": map_file}
        graph.start("recorder", "recorder", drain_timeout_s=LONG_S, **options)
        graph.start("curator", "curator", reference=[reference], **options)
        robot.until_found(2)
        for name, (make, _) in PERFORMANCES.items():
            played[name] = play(graph, robot, make, dataset)
            graph.settled(dataset, played[name].id)
            decided[name] = Dataset(dataset).decisions(played[name].id)
        graph.stop("curator")
        graph.start(
            "curator", "impatient", reference=[reference], drain_timeout_s=SHORT_S, **options
        )
        robot.until_found(2)
        one = played[LATE] = play(
            graph, robot, lambda: withholding(perform(15, LATE), JOINTS, 0.4), dataset
        )
        graph.decided(one.id)  # its gate has closed; the gate of the recorder still waits
        send_withheld(robot, one)
        graph.settled(dataset, one.id)
        decided[LATE] = Dataset(dataset).decisions(one.id)
    return Session(dataset, reference, played, decided)


@pytest.fixture(scope="module")
def offline(session):
    """Rows of `curation score`, by episode."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = curation(
            ["score", str(session.dataset), "--reference", str(session.reference), "--json"]
        )
    assert code == 0
    return {row["episode"]: row for row in jsonl(out.getvalue())}


@pytest.mark.parametrize("name", [*PERFORMANCES, LATE])
def test_live_equals_offline(session, offline, name):
    last = session.live(name)[-1].to_json()
    row = offline[session.played[name].id]
    shared = ("name", "scores", "reason", "span", "findings")
    assert {k: row[k] for k in shared} == {k: last[k] for k in shared}
    assert row["decision"] == last["verdict"]


@pytest.mark.parametrize("name", PERFORMANCES)
def test_bag_adds_nothing_to_the_live_episode(session, name):
    [*_, last] = session.live(name)
    assert (last.revision, last.evidence["bag"]) == (1, "equal")


@pytest.mark.parametrize("name", PERFORMANCES)
def test_each_fault_of_the_recording_is_found_and_no_other(session, name):
    found = {f.id for f in session.live(name)[-1].findings if f.kind == "recording"}
    assert found == PERFORMANCES[name][1]


def test_verdicts_follow_from_the_performances(session):
    verdicts = {name: session.live(name)[-1].verdict for name in session.played}
    assert verdicts["good"] == "keep"
    assert verdicts["early"] == "discard"
    assert verdicts["lossy"] == verdicts["disordered"] == "review"


@pytest.mark.parametrize("name", [*PERFORMANCES, LATE])
def test_episode_is_the_sent_data_resampled_by_the_rule(session, name):
    one, bag = session.played[name], open_bag(session.bag(name))
    rows = {FIELD_OF[topic]: one.rows(topic) for topic in RATES_HZ}
    rows["width"] = [
        (m.publish_time_ns, struct.unpack_from("<d", m.data, 4))
        for m in bag.messages([f"/{WIDTH}"])
    ]
    map_ = topic_map_from_json(MAP)
    assert one.event is not None
    stamps, fields = resample(rows, map_, one.event.start_ns, one.event.end_ns)
    episode = read_episode(session.bag(name))
    assert episode.stamps_ns.tolist() == stamps
    for field_name in ("tool", "width", "velocity", "jaw"):
        np.testing.assert_array_equal(episode.field(field_name), fields[field_name])
    np.testing.assert_allclose(episode.field("arm"), fields["arm"], rtol=1e-9, atol=1e-12)
    assert episode.rate_hz == pytest.approx(RATES_HZ[TOOL], rel=0.1)
    assert np.ptp(np.diff(episode.stamps_ns)) > 1_000_000  # the clock keeps its jitter


def test_topic_without_a_header_has_the_stamps_of_its_sender(session):
    one = session.played["good"]
    messages = list(open_bag(session.bag("good")).messages([f"/{WIDTH}"]))
    stamps = [m.publish_time_ns for m in messages]
    assert stamps == sorted(set(stamps))
    assert one.event is not None
    assert all(one.event.start_ns <= ns for ns in stamps)
    # The robot wrote no stamps: they come from the clock of the sending process.
    assert (stamps[-1] - stamps[0]) / NS_PER_S == pytest.approx(EPISODE_S, abs=1.0)
    sent = [v for _, (v,) in one.rows(WIDTH)]
    values = [struct.unpack_from("<d", m.data, 4)[0] for m in messages]
    assert values == sent[: len(values)]


def test_data_after_the_gate_has_closed_lead_to_revision_2(session):
    first, *_, last = session.live(LATE)
    assert first.revision == 1
    assert "incomplete" in {f.id for f in first.findings}
    assert (first.verdict, "bag" in first.evidence) == ("review", False)
    assert (last.revision, last.evidence["bag"]) == (2, "differs")
    assert not [f for f in last.findings if f.kind == "recording"]
    assert last.verdict == "keep"


def test_scorers_without_a_score_abstain(session):
    last = session.live("good")[-1]
    for scorer, score in last.scores.items():
        assert (score is None) == (scorer in last.abstained)
    assert last.scores["gripper_timing"] is not None
