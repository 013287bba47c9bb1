"""A synthetic robot: publishes episodes of any topic map with real messages, and spoils them.

An episode is made first, as plain data (`Take`). A fault is a function from take to take.
"""

from __future__ import annotations

import itertools
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, topic_map
from graph import Graph

from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.status import EpisodeEvent, event_to_status, phase_to_status
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.types import NS_PER_S

try:
    from geometry_msgs.msg import Vector3
    from rclpy.qos import QoSProfile

    from curation_ros.nodes.messages import (
        array_to_ros,
        joints_to_ros,
        message_type,
        pose_to_ros,
        time_from_ros,
        time_to_ros,
        twist_to_ros,
    )
    from curation_ros.nodes.qos import LATCHED, MAPPED
except ImportError as err:
    pytest.skip(f"rclpy is not installed: {err}", allow_module_level=True)

Sent = tuple[str, Any]

#: About as fast as a recorder and a curator keep up with on two cores.
MOST_STEPS_HZ = 500.0
N_STEPS, CLOSE_AT, RATE_HZ = 120, 40, 20.0
PERIOD_NS = round(NS_PER_S / RATE_HZ)
JOINTS = [f"robot0_joint{k}" for k in range(1, 8)]
FINGERS = [f"gripper0_finger_joint{k}" for k in (1, 2)]
BOWL, PLATE = "objects/akita_black_bowl_1/pose", "objects/plate_1/pose"

_numbers = itertools.count(1)
_next_start_ns = time.time_ns()


@dataclass(frozen=True)
class Take:
    """One episode as a robot publishes it: its start, its end, and the messages in order."""

    started: EpisodeEvent
    ended: EpisodeEvent
    messages: tuple[Sent, ...]

    @property
    def id(self) -> str:
        return self.started.id

    @property
    def name(self) -> str:
        return self.started.name

    def of(self, topic: str) -> list[Any]:
        """Messages of one topic."""
        return [m for t, m in self.messages if t == topic]

    def until(self, share: float) -> int:
        """Index of the message at which that share of the episode is over."""
        return int(share * len(self.messages))


def stamp_ns(message: Any) -> int:
    return time_from_ros(message.header.stamp)


def plain(value: Any) -> Any:
    """Values of a message of rclpy, rosbags or mcap_ros2, for comparing one with another."""
    if hasattr(value, "get_fields_and_field_types"):
        names = list(value.get_fields_and_field_types())
    elif hasattr(value, "__dataclass_fields__"):
        # Without the constants of its type, which are in capitals.
        names = [n for n in value.__dataclass_fields__ if n != "__msgtype__" and not n.isupper()]
    elif hasattr(value, "__slots__") and not isinstance(value, (bytes, str, np.generic)):
        names = [n for n in value.__slots__ if not n.startswith("_")]
    elif isinstance(value, bytes):
        return value[0]
    elif isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    elif isinstance(value, Iterable) and not isinstance(value, str):
        return [plain(v) for v in value]
    else:
        return value
    return {name: plain(getattr(value, name)) for name in names}


# --- takes ----------------------------------------------------------------------------------


def new_start_ns(length_s: float = 60.0) -> int:
    """Start of an episode: after all earlier episodes, and close to the current time."""
    global _next_start_ns
    start = max(_next_start_ns, time.time_ns())
    _next_start_ns = start + int(length_s * NS_PER_S)
    return start


def make_take(
    messages: Sequence[Sent],
    start_ns: int,
    name: str = "",
    *,
    end_ns: int | None = None,
    counts: bool = True,
) -> Take:
    """A take of these messages. Its owner counts them, or it ends while they continue."""
    number = next(_numbers)
    stamps: dict[str, set[int]] = {}
    for topic, message in messages:
        stamps.setdefault(topic, set()).add(stamp_ns(message))
    started = EpisodeEvent(new_episode_id(), name or f"take-{number:04d}", "started", start_ns)
    ended = replace(
        started,
        event="ended",
        end_ns=end_ns or max(max(s) for s in stamps.values()),
        counts={t: len(s) for t, s in stamps.items()} if counts else {},
    )
    return Take(started, ended, tuple(messages))


def libero_take(
    seed: int,
    n_steps: int = N_STEPS,
    *,
    open_at: int | None = -1,
    name: str = "",
    counts: bool = True,
) -> Take:
    """A pick and place of the LIBERO robot. `open_at` in the middle is an early release."""
    start = new_start_ns(n_steps / RATE_HZ + 30.0)
    episode = make_episode(
        np.random.default_rng(seed),
        n_steps,
        close_at=min(CLOSE_AT, n_steps // 3),
        open_at=open_at,
        rate_hz=RATE_HZ,
        start_ns=start,
    )
    return make_take(libero_messages(episode), start, name, counts=counts)


def libero_messages(episode: Episode) -> list[Sent]:
    """The messages of an episode, step by step, as sim_node sends them."""
    f = episode.fields
    labels = episode.topic_map.fields["phase"].labels
    upright = (1.0, 0.0, 0.0, 0.0)
    out: list[Sent] = []
    for k, ns in enumerate(episode.stamps_ns.tolist()):
        position = [*f["joint_position"][k], *f["finger_position"][k]]
        phase = int(f["phase"][k, 0])
        progress = k / len(episode)
        out += [
            ("joint_states", joints_to_ros([*JOINTS, *FINGERS], position, [0.1] * 9, [k] * 9, ns)),
            (BOWL, pose_to_ros(f["bowl_position"][k], upright, ns)),
            (PLATE, pose_to_ros(f["plate_position"][k], upright, ns)),
            ("phase", array_to_ros([phase_to_status("", labels[phase], phase, progress)], ns)),
            ("eef_pose", pose_to_ros(f["eef_position"][k], f["eef_quat_xyzw"][k], ns)),
            ("command/twist", twist_to_ros(f["twist"][k], ns)),
            ("command/gripper", joints_to_ros(["gripper"], f["gripper"][k], [0.0], [0.0], ns)),
        ]
    return out


def other_robot_messages(
    rng: np.random.Generator, start_ns: int, arm: Sequence[str], *, open_at: int | None = None
) -> list[Sent]:
    """The robot of test_any_robot: joints in a new order per episode, a continuous jaw.

    Each topic has a rate and a phase of its own, so only the map joins them. The messages continue
    for three steps after the end of the episode.
    """
    order = list(rng.permutation([*arm, "jaw"]))
    out: list[tuple[int, Sent]] = []
    width = 0.08
    for k in range(N_STEPS + 3):
        ns = start_ns + 1_000_000 + k * PERIOD_NS
        is_open = k < CLOSE_AT or (open_at is not None and k >= open_at)
        wanted = 0.08 if is_open else 0.0
        motion = 0.2 * np.sin(0.05 * k + np.arange(6)) + 0.01 * rng.standard_normal(6)
        pose = pose_to_ros(0.1 * motion[:3] + [0.4, 0.0, 0.3], (0.0, 0.0, 0.0, 1.0), ns)
        twist = twist_to_ros(motion[:3], ns + 4_000_000)
        twist.twist.angular = Vector3(x=motion[3], y=motion[4], z=motion[5])
        for sub in (0, PERIOD_NS // 2):  # the joints come twice as often as the tool
            position = dict(zip(arm, motion, strict=False)) | {"jaw": width}
            joints = joints_to_ros(order, [position[j] for j in order], [0.0] * 4, [0.0] * 4, ns)
            _restamp(joints, ns - 500_000 + sub)
            out.append((ns - 500_000 + sub, ("driver/joint_states", joints)))
        hand = joints_to_ros(["jaw"], [wanted], [0.0], [0.0], ns + 5_000_000)
        out += [
            (ns, ("tool/pose", pose)),
            (ns + 4_000_000, ("servo/command", twist)),
            (ns + 5_000_000, ("hand/command", hand)),
        ]
        width = wanted  # by the next step
    return [sent for _, sent in sorted(out, key=lambda o: o[0])]


# --- faults ---------------------------------------------------------------------------------


def without(take: Take, topic: str, first: int = 0, last: int | None = None) -> Take:
    """Messages [first, last) of a topic are not sent, although the owner has counted them."""
    gone = {id(m) for m in take.of(topic)[first:last]}
    return replace(take, messages=tuple(s for s in take.messages if id(s[1]) not in gone))


def repeated(take: Take, every: int = 3) -> Take:
    """All messages of every third step are sent again, as sim_node does."""
    out: list[Sent] = []
    for k, (_, step) in enumerate(itertools.groupby(take.messages, lambda s: stamp_ns(s[1]))):
        messages = list(step)
        out += messages * (2 if k % every == 0 else 1)
    return replace(take, messages=tuple(out))


def interleaved(take: Take, rng: np.random.Generator, reach: int = 8) -> Take:
    """Topics overtake each other by up to `reach` messages. Each keeps its own order."""
    keys = np.arange(len(take.messages)) + reach * rng.random(len(take.messages))
    last: dict[str, float] = {}
    for k, (topic, _) in enumerate(take.messages):
        keys[k] = last[topic] = max(keys[k], last.get(topic, 0.0))
    order = np.argsort(keys, kind="stable")
    return replace(take, messages=tuple(take.messages[k] for k in order))


def disordered(take: Take, topic: str, at: int) -> Take:
    """Two consecutive messages of a topic change places."""
    first, second = take.of(topic)[at : at + 2]
    swap = {id(first): second, id(second): first}
    return replace(take, messages=tuple((t, swap.get(id(m), m)) for t, m in take.messages))


def jumped_back(take: Take, at: float, by_ns: int) -> Take:
    """From that share of the episode on, every stamp is lower by `by_ns`."""
    limit = take.started.start_ns + int(at * (take.ended.end_ns - take.started.start_ns))
    back = changed(take, lambda _, ns: ns > limit, lambda m: _restamp(m, stamp_ns(m) - by_ns))
    return replace(
        back,
        ended=replace(
            take.ended,
            end_ns=max(stamp_ns(m) for _, m in back.messages),
            counts=distinct(back.messages),
        ),
    )


def conflicting(take: Take, topic: str, at: int) -> Take:
    """One message is sent again with the same stamp and another value."""
    twin = deepcopy(take.of(topic)[at])
    twin.pose.position.x += 0.5
    out: list[Sent] = []
    for sent in take.messages:
        out.append(sent)
        if sent[0] == topic and stamp_ns(sent[1]) == stamp_ns(twin):
            out.append((topic, twin))
    return replace(take, messages=tuple(out))


def changed(take: Take, which: Callable[[str, int], bool], change: Callable[[Any], None]) -> Take:
    """Some messages are changed."""
    out = []
    for topic, message in take.messages:
        if which(topic, stamp_ns(message)):
            message = deepcopy(message)
            change(message)
        out.append((topic, message))
    return replace(take, messages=tuple(out))


def _restamp(message: Any, ns: int) -> None:
    message.header.stamp = time_to_ros(ns)


# --- the robot ------------------------------------------------------------------------------


class Robot:
    """A node with one publisher per topic. It owns `episode`, unless told not to."""

    def __init__(
        self,
        graph: Graph,
        map_: TopicMap | None = None,
        *,
        types: Mapping[str, str] | None = None,
        name: str = "robot",
        namespace: str = "",
        owner: bool = True,
        qos: Mapping[str, QoSProfile] | None = None,
    ) -> None:
        """Join the graph.

        Args:
            graph: the graph.
            map_: its topics are published; None: those of the LIBERO robot.
            types: topic -> type, to replace the types of the map.
            name: name of the node.
            namespace: namespace of the node.
            owner: whether it owns the episodes.
            qos: topic -> QoS, to replace the QoS of mapped topics.
        """
        import rclpy

        self._graph = graph
        self.node = rclpy.create_node(
            name, context=graph.context, namespace=namespace, enable_rosout=False
        )
        types = (map_ or topic_map()).topics if types is None else types
        self.publishers = {
            topic: self.node.create_publisher(
                message_type(kind), topic, (qos or {}).get(topic, MAPPED)
            )
            for topic, kind in types.items()
        }
        self._episode = None
        if owner:
            kind = message_type("diagnostic_msgs/msg/DiagnosticArray")
            self._episode = self.node.create_publisher(kind, "episode", LATCHED)

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None:
        self.node.destroy_node()

    def until_found(self, n: int = 1, *, topics: Sequence[str] | None = None) -> None:
        """Wait until n nodes subscribe to these topics, or all, and have found the publishers.

        Discovery is one-sided: a subscriber that is found may not yet have found the publisher.
        """
        for topic, publisher in self.publishers.items():
            if topics is None or topic in topics:
                self._graph.until(
                    lambda p=publisher: p.get_subscription_count() >= n,
                    f"{n} subscribers on {topic}",
                )
        if self._episode is not None:
            self._graph.until(
                lambda: self._episode.get_subscription_count() >= n + 1,
                f"{n} subscribers on episode",
            )
        self._graph.quiet(0.1)  # reports that wait here may come from a node that has ended
        since = len(self._graph.health)
        self._graph.until(lambda: self._is_found(n, since, topics), f"{n} nodes have found {self}")

    def _is_found(self, n: int, since: int, topics: Sequence[str] | None) -> bool:
        """Whether the newest reports of n nodes count all publishers of these topics.

        Nodes may share a name. Then as many reports as two rounds of them suffice.
        """
        publishers = [p for t, p in self.publishers.items() if topics is None or t in topics]
        names = [p.topic_name for p in (*publishers, self._episode) if p is not None]
        count = self.node.count_publishers
        wanted = {f"publishers/{name.lstrip('/')}": str(count(name)) for name in names}
        found: list[str] = []
        for status in reversed(self._graph.health[since:]):
            counted = {key: status.values[key] for key in wanted if key in status.values}
            if any(counted[key] != wanted[key] for key in counted):
                break
            if counted:
                found.append(status.name)
        return len(set(found)) >= n or len(found) >= 2 * n

    def tell(self, event: EpisodeEvent) -> None:
        """Publish an event of an episode."""
        assert self._episode is not None
        self._episode.publish(array_to_ros([event_to_status(event)], time.time_ns()))

    def send(self, messages: Iterable[Sent], *, rate_hz: float = MOST_STEPS_HZ) -> None:
        """Publish messages, at this number of stamps per second.

        It does not wait for acknowledgements: Fast DDS asks for them every 3 s.
        """
        began_s, steps, last_ns = time.monotonic(), -1, None
        for topic, message in messages:
            if stamp_ns(message) != last_ns:
                last_ns = stamp_ns(message)
                steps += 1
                time.sleep(max(0.0, began_s + steps / rate_hz - time.monotonic()))
            self.publishers[topic].publish(message)

    def play(self, take: Take, *, rate_hz: float = MOST_STEPS_HZ) -> Take:
        """Publish a whole episode, much faster than real time."""
        self.tell(take.started)
        self.send(take.messages, rate_hz=rate_hz)
        self.tell(take.ended)
        return take


def distinct(messages: Iterable[Sent]) -> dict[str, int]:
    """Topic -> number of distinct stamps."""
    return dict(Counter(topic for topic, _ in {(t, stamp_ns(m)) for t, m in messages}))
