"""Demonstrations without a graph: the sim node's episodes, stepped and recorded in one process.

Stepping (`sim_node.driving`), messages (`sim_node.messages`) and recording
(`curation_ros.live.recorder`) are those of the nodes; only the middleware is missing. Bags and
truth therefore have the same form and the same values as those recorded on the graph.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
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
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import BagError, ConfigError, CurationError
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.dataset import Dataset
from curation_ros.live.recorder import Notice, RecordedTopic, Recording, recover_partials
from sim_node.driving import Commands, Driver
from sim_node.episodes import run_to_end
from sim_node.planning import EpisodePlan, plan_episodes
from sim_node.settings import MAX_STEPS, SIMULATED_TASK, STEPS_AFTER_SUCCESS, DriveSettings
from sim_node.tasks import process_environment, start_names, task_named


@dataclass(frozen=True)
class Collection:
    """What is to be collected; most attributes are parameters of the sim node, too.

    Attributes:
        episodes: number of episodes.
        contamination: fraction of defective ones.
        defect: kind of the defect, a key of `sim_node.defects.DEFECTS`.
        paired: whether defective ones reuse the starts of clean ones.
        seed: seed of order, expert and defects.
        starts: such as generated:SEED:COUNT; empty: generated, by seed.
        name_prefix: short names are <prefix>-<number>, from 1 in the order of the plan.
        max_steps: most commands of an episode.
        max_steps_defective: the same for defective ones; 0: max_steps.
        steps_after_success: commands after the one that succeeded.
        simulated_task: what is simulated, a key of `sim_node.tasks.TASKS`.
        topic_map: YAML file of the topic map; empty: the default one.
    """

    episodes: int
    contamination: float = 0.0
    defect: str = "early_release"
    paired: bool = False
    seed: int = 0
    starts: str = ""
    name_prefix: str = "bowl"
    max_steps: int = MAX_STEPS
    max_steps_defective: int = 0
    steps_after_success: int = STEPS_AFTER_SUCCESS
    simulated_task: str = SIMULATED_TASK
    topic_map: str = ""

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> Collection:
        """A collection from parameters by the names of the sim node, as a study's YAML has them.

        Raises:
            ConfigError: if a parameter is unknown or missing.
        """
        given = {"name_prefix" if key == "task" else key: v for key, v in settings.items()}
        try:
            return cls(**given)
        except TypeError as err:
            raise ConfigError(str(err)) from err

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
        for is_defective in (False, True):
            self.drive_settings.limits(is_defective=is_defective)
        starts = self.starts or f"generated:{self.seed}:{self.episodes}"
        plans = plan_episodes(
            self.episodes,
            self.contamination,
            self.defect,
            self.seed,
            start_names(starts, self.simulated_task),
            paired=self.paired,
        )
        return {f"{self.name_prefix}-{plan.index + 1:04d}": plan for plan in plans}


@dataclass(frozen=True)
class Collected:
    """An episode of the plan.

    Attributes:
        name: short name.
        truth: its line of truth.jsonl; None if it has no bag.
        problem: why it was not collected or was aborted; empty if it is whole.
        is_known: whether an earlier collection has it.
    """

    name: str
    truth: dict[str, Any] | None
    problem: str = ""
    is_known: bool = False


def collect(
    folder: Path, collection: Collection, *, jobs: int = 1, backend: str = "loky"
) -> Iterator[Collected]:
    """Collect what a dataset lacks, and yield every episode of the plan when it is done.

    A collection that was killed is resumed: an episode with a bag and a line of truth is not
    collected again. Any other remains of an episode of the plan move to `quarantine/`.

    Args:
        folder: the dataset; created if it does not exist.
        collection: what to collect.
        jobs: number of workers, each with a simulator; see `curation_ros.batch.workers.spread`.
        backend: backend of the workers.

    Raises:
        ConfigError: if the collection makes no sense, or the dataset has other episodes under its
            names.
        CurationError: if the dataset cannot be written, another collection is running in it, or a
            worker died.
    """
    plan = collection.plan()
    topic_map_or_default(collection.topic_map)  # one that cannot be read is refused at once
    dataset = Dataset(folder, create=True)
    with dataset.sole_collection():
        known = _known(dataset, collection, plan)
        for name, truth in known.items():
            yield Collected(name, truth, str(truth["aborted"]), is_known=True)
        tasks = _tasks(folder, collection, {n: e for n, e in plan.items() if n not in known})
        try:
            yield from spread(_collect, tasks, jobs=jobs, backend=backend, in_order=False)
        except WorkerDiedError as err:
            raise CurationError(
                f"{err}: what was collected is kept, run the same command again to go on"
            ) from err


def _tasks(
    folder: Path, collection: Collection, missing: Mapping[str, EpisodePlan]
) -> list[tuple[Any, ...]]:
    """Arguments of `_collect`: ids and stamps are in the order of the plan for any workers."""
    if not missing:
        return []
    most = max(collection.max_steps, collection.max_steps_defective)
    period_ns = process_environment(collection.simulated_task).control_period_ns
    now_ns = time.time_ns()
    return [
        (folder, collection, name, plan, new_episode_id(), now_ns + k * (most + 1) * period_ns)
        for k, (name, plan) in enumerate(missing.items())
    ]


def _known(
    dataset: Dataset, collection: Collection, plan: Mapping[str, EpisodePlan]
) -> dict[str, dict[str, Any]]:
    """Truth, by name, of the episodes of a plan that are complete; removes remains of others."""
    known: dict[str, dict[str, Any]] = {}
    benchmark_id = task_named(collection.simulated_task).benchmark_id
    for truth in dataset.truth().values():
        name = str(truth.get("name"))
        if name not in plan or not dataset.bag_path(str(truth["episode"])).is_dir():
            continue
        planned = {
            "task": benchmark_id,
            **{
                key: getattr(plan[name], key)
                for key in ("start", "repetition", "expert_seed", "defect")
            },
        }
        for key, value in planned.items():
            if truth.get(key) != value:
                raise ConfigError(
                    f"dataset {dataset.path}: {name} has {key} {truth.get(key)!r}, the plan "
                    f"{value!r}: it was collected by another plan"
                )
        known[name] = truth
    recover_partials(dataset)
    complete = {str(truth["episode"]) for truth in known.values()}
    for episode_id, name in dataset.names():
        bag = dataset.bag_path(episode_id)
        if name in plan and episode_id not in complete and bag.is_dir():
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
    """Collect one episode, in a worker."""
    try:
        dataset = Dataset(folder)
        output = BagOutput(dataset, topic_map_or_default(collection.topic_map))
        task = task_named(collection.simulated_task)
        driver = Driver(
            process_environment(task.name),
            task,
            output,
            Commands(),
            collection.drive_settings,
            stamp_ns=stamp_ns,
        )
        episode = run_to_end(driver.drive(plan, task.start(plan.start), name, episode_id))
        output.check_closed()
        dataset.append_truth(episode.truth())
    except CurationError as err:
        return Collected(name, None, str(err))
    return Collected(name, episode.truth(), episode.reason)


class BagOutput:
    """Writes what the sim node would send into a dataset, as a recorder that loses nothing.

    Args:
        dataset: where the bag of each episode goes.
        topic_map: which topics are recorded.
    """

    def __init__(self, dataset: Dataset, topic_map: TopicMap) -> None:
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
