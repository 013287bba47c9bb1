"""Demonstrations without a graph: the sim node's episodes, stepped and recorded in one process.

Stepping (`sim_node.driving`), messages (`sim_node.output`) and recording
(`curation_ros.live.recorder`) are what the nodes run; only the middleware in between is missing.
So bags and truth have the form, and the values, of those that are recorded on the graph.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from curation_ros.bags.messages import to_cdr
from curation_ros.bags.qos import MAPPED
from curation_ros.batch.workers import WorkerDiedError, spread
from curation_ros.configuration import topic_map_or_default
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.episode.messages import PlainMessage
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import BagError, ConfigError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.live.recorder import Notice, RecordedTopic, Recording, recover_partials
from sim_node.driving import Commands, Driver, DriveSettings
from sim_node.env import CONTROL_RATE_HZ, process_env
from sim_node.episodes import MAX_STEPS, STEPS_AFTER_SUCCESS, run_to_end
from sim_node.planning import EpisodePlan, plan_episodes
from sim_node.starts import start_by_name, start_names


@dataclass(frozen=True)
class Collection:
    """What is to be collected; the attributes are parameters of the sim node.

    Attributes:
        episodes: how many.
        contamination: fraction of defective ones.
        defect: what is wrong with those.
        paired: whether defective ones recur on the starts of clean ones.
        seed: of order, expert and defects.
        starts: such as generated:SEED:COUNT; empty: generated, by seed.
        task: short names are <task>-<number>, from 1 in the order of the plan.
        max_steps: steps after which an episode ends.
        max_steps_defective: the same where a defect is in; 0: max_steps.
        steps_after_success: steps recorded after success.
    """

    episodes: int
    contamination: float = 0.0
    defect: str = "early_release"
    paired: bool = False
    seed: int = 0
    starts: str = ""
    task: str = "bowl"
    max_steps: int = MAX_STEPS
    max_steps_defective: int = 0
    steps_after_success: int = STEPS_AFTER_SUCCESS

    @property
    def drive_settings(self) -> DriveSettings:
        """How the episodes are driven."""
        return DriveSettings(
            max_steps=self.max_steps,
            max_steps_defective=self.max_steps_defective,
            steps_after_success=self.steps_after_success,
        )

    def plan(self) -> dict[str, EpisodePlan]:
        """Episodes by their short names, in order.

        Raises:
            ConfigError: if a value makes no sense.
        """
        for defect in ("none", self.defect):
            self.drive_settings.limits(defect)
        plans = plan_episodes(
            self.episodes,
            self.contamination,
            self.defect,
            self.seed,
            start_names(self.starts or f"generated:{self.seed}:{self.episodes}"),
            paired=self.paired,
        )
        return {f"{self.task}-{plan.index + 1:04d}": plan for plan in plans}


@dataclass(frozen=True)
class Collected:
    """An episode of the plan.

    Attributes:
        name: short name.
        truth: its line of truth.jsonl; None where there is no bag of it.
        problem: why it was not collected, or the simulation gave it up.
        is_known: whether an earlier collection has it.
    """

    name: str
    truth: dict[str, Any] | None
    problem: str = ""
    is_known: bool = False


def collect(
    folder: Path, collection: Collection, *, jobs: int = 1, backend: str = "loky"
) -> Iterator[Collected]:
    """Collect what a dataset does not have yet, and yield every episode of the plan as it is done.

    Killed at any point, it goes on where it was: an episode with a bag and a line of truth is not
    collected again; what else was left of one of the plan moves to `quarantine/`.

    Args:
        folder: the dataset; made where it does not exist.
        collection: what to collect.
        jobs: workers, with a simulator each; see `curation_ros.batch.workers.spread`.
        backend: of the workers.

    Raises:
        ConfigError: if the collection makes no sense, or the dataset has other episodes under its
            names.
        CurationError: if the dataset cannot be written, another collection is running in it, or a
            worker died.
    """
    plan = collection.plan()
    dataset = Dataset(folder, create=True)
    with dataset.sole_collection():
        known = _known(dataset, plan)
        for name, truth in known.items():
            yield Collected(name, truth, str(truth["aborted"]), is_known=True)
        # In the order of the plan, whoever collects: ids, and stamps that do not overlap.
        most = max(collection.max_steps, collection.max_steps_defective)
        span_ns = (most + 1) * NS_PER_S // CONTROL_RATE_HZ
        now_ns = time.time_ns()
        tasks = [
            (folder, collection, name, episode, new_episode_id(), now_ns + k * span_ns)
            for k, (name, episode) in enumerate(plan.items())
            if name not in known
        ]
        try:
            yield from spread(_collect, tasks, jobs=jobs, backend=backend, in_order=False)
        except WorkerDiedError as err:
            raise CurationError(
                f"{err}: what was collected is kept, run the same command again to go on"
            ) from err


def _known(dataset: Dataset, plan: dict[str, EpisodePlan]) -> dict[str, dict[str, Any]]:
    """Truth, by name, of the episodes of a plan that are there as a whole; removes the others."""
    known: dict[str, dict[str, Any]] = {}
    for truth in dataset.truth().values():
        name = str(truth.get("name"))
        if name not in plan or not dataset.bag_path(str(truth["episode"])).is_dir():
            continue
        for key in ("start", "repetition", "expert_seed", "defect"):
            if truth.get(key) != getattr(plan[name], key):
                raise ConfigError(
                    f"dataset {dataset.path}: {name} has {key} {truth.get(key)!r}, the plan "
                    f"{getattr(plan[name], key)!r}: it was collected by another plan"
                )
        known[name] = truth
    recover_partials(dataset)
    whole = {str(truth["episode"]) for truth in known.values()}
    for episode_id, name in dataset.names():
        bag = dataset.bag_path(episode_id)
        if name in plan and episode_id not in whole and bag.is_dir():
            dataset.quarantine(bag, "untold")
    return {name: known[name] for name in plan if name in known}


def _collect(
    folder: Path,
    collection: Collection,
    name: str,
    plan: EpisodePlan,
    episode_id: str,
    stamp_ns: int,
) -> Collected:
    """One episode, in a worker."""
    try:
        dataset = Dataset(folder)
        output = BagOutput(dataset)
        driver = Driver(
            process_env(), output, Commands(), collection.drive_settings, stamp_ns=stamp_ns
        )
        episode = run_to_end(driver.drive(plan, start_by_name(plan.start), name, episode_id))
        output.check_closed()
        dataset.append_truth(episode.truth())
    except CurationError as err:
        return Collected(name, None, str(err))
    return Collected(name, episode.truth(), episode.reason)


class BagOutput:
    """Writes what the sim node would send into a dataset, as a recorder that loses nothing.

    Args:
        dataset: where the bag of each episode goes.
    """

    def __init__(self, dataset: Dataset) -> None:
        topic_map = topic_map_or_default("")
        topics = {t: RecordedTopic(f"/{t}", kind, MAPPED) for t, kind in topic_map.topics.items()}
        self._recording = Recording(dataset, topic_map, topics)
        self._seqs = dict.fromkeys(topics, 0)
        self._last: Notice | None = None

    def check_closed(self) -> None:
        """Check that the bag of the last episode is whole.

        Raises:
            BagError: with the reason if it is not.
        """
        if self._last is None or self._last.state != "closed":
            reason = self._last.reason if self._last is not None else "it never started"
            raise BagError(f"episode {self._last.name if self._last else ''}: {reason}")

    def event(self, event: EpisodeEvent) -> None:
        """Open or close a bag."""
        self._keep(self._recording.event(event, time.monotonic()))

    def send(self, message: PlainMessage) -> None:
        """Record a message if its topic is mapped."""
        if message.topic not in self._seqs:
            return
        self._seqs[message.topic] += 1
        stamp = message.content["header"]["stamp"]
        stamp_ns = stamp["sec"] * NS_PER_S + stamp["nanosec"]
        data = to_cdr(message.type, message.content)
        now_ns = time.time_ns()
        sample = Sample(message.topic, stamp_ns, self._seqs[message.topic], data, now_ns, now_ns)
        self._keep(self._recording.sample(sample, time.monotonic()))

    def _keep(self, notices: Sequence[Notice]) -> None:
        for notice in notices:
            # What failed once stays so: later notices are about its remains.
            if self._last is None or self._last.state != "failed" or notice.state == "recording":
                self._last = notice
