"""Collects the datasets of a study, and checks that they share no start state with rollouts."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.study.plan import StudyPlan

if TYPE_CHECKING:
    from curation_ros.study.collect import Collection


def collect_datasets(
    folder: Path, plan: StudyPlan, *, jobs: int, backend: str, log: Callable[[str], None]
) -> tuple[dict[str, Dataset], int]:
    """Collect the missing demonstrations of all datasets of a plan.

    Args:
        folder: holds a folder for each dataset.
        plan: of the study.
        jobs: number of workers.
        backend: kind of the workers.
        log: called with a line about each dataset.

    Returns:
        Datasets by name, and the number of newly collected demonstrations.

    Raises:
        ConfigError: if datasets and rollouts share a start state.
        CurationError: if a dataset cannot be completed.
    """
    from curation_ros.study.collect import collect

    check_starts(plan)
    datasets, n_new = {}, 0
    for name, settings in plan.collections.items():
        collection = _collection(plan, settings, name)
        problems, n_known, n = [], 0, 0
        for one in collect(folder / name, collection, jobs=jobs, backend=backend):
            n += 1
            n_known += one.is_known
            if one.problem:
                problems.append(f"{one.name}: {one.problem}")
        if problems:
            raise CurationError(f"dataset {folder / name}: {'; '.join(problems)}")
        log(f"dataset {name}: {n} demonstrations, {n_known} of them collected before")
        datasets[name] = Dataset(folder / name)
        n_new += n - n_known
    return datasets, n_new


def check_starts(plan: StudyPlan) -> None:
    """Check that no start state is used by two datasets, or by a dataset and by rollouts.

    Stages of different kinds must not share one either.

    Raises:
        ConfigError: naming a start state that is shared.
    """
    from sim_node.tasks import start_names

    used: dict[str, str] = {}
    for name, settings in plan.collections.items():
        for episode in _collection(plan, settings, name).plan().values():
            owner = used.setdefault(episode.start, name)
            if owner != name:
                raise ConfigError(f"start {episode.start} is used by {owner} and by {name}")
    kinds: dict[str, str] = {}
    for stage in plan.stages:
        for start in start_names(stage.starts, plan.simulated_task):
            if start in used:
                raise ConfigError(
                    f"stage {stage.name!r}: start {start} is one of dataset {used[start]!r}"
                )
            if kinds.setdefault(start, stage.kind) != stage.kind:
                raise ConfigError(
                    f"start {start} is used by stages of kind {kinds[start]} and {stage.kind}"
                )


def _collection(plan: StudyPlan, settings: Mapping[str, Any], name: str) -> Collection:
    from curation_ros.study.collect import Collection

    shared = {"simulated_task": plan.simulated_task, "topic_map": plan.topic_map}
    try:
        return Collection.from_settings({**shared, **settings})
    except ConfigError as err:
        raise ConfigError(f"dataset {name!r}: {err}") from err
