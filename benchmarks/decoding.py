"""From bags to arrays and to seven scores: ours against rosbags and the two mcap-ros2-support.

All readers take turns in one process on one core, and ratios are taken within a round. Each reader
is used as its documentation does. The benchmark checks that it gives the same arrays. None of them
has to open metadata.yaml.
"""

from __future__ import annotations

import functools
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from made_bags import ARM, N_MESSAGES, N_STEPS, STEPS_PER_CHUNK, write_episode, write_topic
from one_core import rows_of
from other_readers import LISTS, READERS, Arrays, arrays_by, episode_by
from rows import row

from curation_ros.bags import open_bag
from curation_ros.batch.published import TABLE_2
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.messages import JOINT_STATE, POSE
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.dataset.episodes import read_episode

COMMAND = "python benchmarks/decoding.py"
N_ROUNDS = 9
N_EPISODES = 24
N_REFERENCES = 10
TARGETS = {"rosbags": 10.0, "mcap-ros2-support": 10.0, "mcap-ros2-support-fast": 4.0}
SCORES_TARGET = 5.0
#: The seven scorers of the paper.
PAPER = tuple(name for name, published in TABLE_2.items() if published.auroc is not None)
_POSE_PATHS = [*(f"pose.position.{x}" for x in "xyz"), *(f"pose.orientation.{x}" for x in "xyzw")]
#: Our reader looks up every joint by its name. The others trust the order in the first message.
_PATHS = {JOINT_STATE: [f"{x}.{name}" for x in LISTS for name in ARM], POSE: _POSE_PATHS}


def arrays_by_us(path: Path, type_name: str) -> Arrays:
    """A topic as arrays, by curation_ros."""
    paths = _PATHS[type_name]
    field = {"topic": "topic", "type": type_name, "role": "clock", "values": paths}
    bag = open_bag(path)
    decoder = bag.decoder()
    blocks = list(bag.blocks(topic_map_from_json({"fields": {"values": field}})))
    columns = [decoder.decode_block(type_name, paths, block.messages) for block in blocks]
    if any(found.bad for found in columns):
        raise SystemExit("the benchmark has written a bag that cannot be read")
    return {
        "stamps": np.concatenate([block.stamps_ns for block in blocks]),
        "values": np.concatenate([found.values for found in columns]),
    }


@dataclass
class Turns:
    """Seconds of each contestant in each round."""

    seconds: dict[str, list[float]]

    def ratio(self, name: str, other: str) -> float:
        """How many times faster the first is: the median over the rounds."""
        pairs = zip(self.seconds[other], self.seconds[name], strict=True)
        return statistics.median(slow / fast for slow, fast in pairs)

    def median(self, name: str) -> float:
        """Median of the seconds per turn."""
        return statistics.median(self.seconds[name])


def take_turns(contestants: Mapping[str, Callable[[], object]], n_rounds: int) -> Turns:
    """Run each contestant once per round; a first round warms up and is not counted."""
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for round_index in range(n_rounds + 1):
        for name, run_once in contestants.items():
            started_s = time.perf_counter()
            run_once()
            if round_index:
                seconds[name].append(time.perf_counter() - started_s)
    return Turns(seconds)


def _faster(name: str, ratio: float, target: float) -> dict[str, Any]:
    """Comparison of a row with a slower one."""
    return {
        "against": name,
        "ratio": ratio,
        "target": f"ratio >= {target:g}",
        "holds": ratio >= target,
    }


def measure_decoding(folder: Path, type_name: str, n_rounds: int) -> tuple[Turns, list[Any]]:
    """Messages per second of each reader, and how much faster ours is."""
    short = type_name.split("/")[2]
    path = write_topic(folder / short, type_name)
    contestants: dict[str, Callable[[], Arrays]] = {
        name: functools.partial(arrays_by, make(), path, type_name)
        for name, make in READERS.items()
    }
    contestants["ours"] = functools.partial(arrays_by_us, path, type_name)
    truth = contestants["ours"]()
    for name, read in contestants.items():
        for key, values in read().items():
            if not np.array_equal(values, truth[key]):
                raise SystemExit(f"{name} reads different {key} of {short}")
    turns = take_turns(contestants, n_rounds)
    rows = [
        row(f"decode {short}, {name}", N_MESSAGES / turns.median(name), "messages/s", COMMAND)
        for name in READERS
    ]
    rows += [
        row(
            f"decode {short}, ours against {name}",
            N_MESSAGES / turns.median("ours"),
            "messages/s",
            COMMAND,
            **_faster(f"decode {short}, {name}", turns.ratio("ours", name), target),
        )
        for name, target in TARGETS.items()
    ]
    return turns, rows


def measure_scores(folder: Path, fastest: str, pace: str, n_rounds: int) -> list[dict[str, Any]]:
    """Milliseconds from a bag to the seven scores of the paper, with two readers."""
    topic_map = topic_map_or_default("")
    events = {}
    for number in range(N_REFERENCES + N_EPISODES):
        bag = folder / f"{number:03d}-{pace}".replace(" ", "")
        events[bag / f"{bag.name}_0.mcap"] = write_episode(bag, topic_map, number, pace)
    references, scored = list(events)[:N_REFERENCES], list(events)[N_REFERENCES:]
    settings = CurationSettings(scorers=PAPER, rule="none", rule_scorer=PAPER[0])
    fitted = fit_scorers(settings, [read_episode(path.parent) for path in references])
    reader = READERS[fastest]()

    def by_us(path: Path) -> Episode:
        return read_episode(path.parent)

    def by_other(path: Path) -> Episode:
        return episode_by(reader, path, topic_map, events[path])

    for path in scored:
        check_equal(path, fitted, by_us(path), by_other(path))
    episodes = [by_us(path) for path in scored]
    turns = take_turns(
        {
            "ours": lambda: [fitted.score(by_us(path)) for path in scored],
            "other": lambda: [fitted.score(by_other(path)) for path in scored],
            "reading, ours": lambda: [by_us(path) for path in scored],
            "reading, other": lambda: [by_other(path) for path in scored],
            # A fresh copy, because an episode keeps its state and action once they are computed.
            "scores alone": lambda: [fitted.score(replace(episode)) for episode in episodes],
        },
        n_rounds,
    )
    return score_rows(turns, f"{N_STEPS} steps, {pace}", fastest)


def check_equal(path: Path, fitted: FittedScorers, ours: Episode, other: Episode) -> None:
    """Check that both episodes and their scores are equal.

    Raises:
        SystemExit: if they are not, or a scorer abstains.
    """
    scores, abstained = fitted.score(ours)
    if ours.digest != other.digest or fitted.score(other)[0] != scores or abstained:
        raise SystemExit(f"{path}: the readers differ, or a scorer abstains: {abstained}")


def score_rows(turns: Turns, shape: str, fastest: str) -> list[dict[str, Any]]:
    """Rows of `measure_scores`; `shape` describes the episodes."""

    def as_row(name: str, turn: str, **compared: Any) -> dict[str, Any]:
        ms = 1e3 * turns.median(turn) / N_EPISODES
        return row(name, ms, "ms/episode", COMMAND, **compared)

    scores, reading = f"bag to seven scores, {shape}", f"bag to episode, {shape}"
    return [
        as_row(f"{scores}, {fastest}", "other"),
        as_row(
            f"{scores}, ours",
            "ours",
            **_faster(f"{scores}, {fastest}", turns.ratio("ours", "other"), SCORES_TARGET),
        ),
        as_row(f"{reading}, {fastest}", "reading, other"),
        as_row(
            f"{reading}, ours",
            "reading, ours",
            against=f"{reading}, {fastest}",
            ratio=turns.ratio("reading, ours", "reading, other"),
        ),
        as_row(f"seven scores alone, {shape}", "scores alone"),
    ]


def measure(n_rounds: int = N_ROUNDS) -> list[dict[str, Any]]:
    """All rows, measured in this process."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        joints, rows = measure_decoding(folder, JOINT_STATE, n_rounds)
        poses, more = measure_decoding(folder, POSE, n_rounds)
        fastest = min(READERS, key=lambda name: joints.median(name) + poses.median(name))
        for pace in STEPS_PER_CHUNK:
            more += measure_scores(folder, fastest, pace, n_rounds)
        return [*rows, *more]


def run() -> list[dict[str, Any]]:
    """Measure in a process of its own, with one thread on one core, and return its rows."""
    return rows_of(__file__)


if __name__ == "__main__":
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    for result in measure():
        print(json.dumps(result))
