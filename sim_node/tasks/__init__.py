"""The tasks that can be simulated, by name."""

from __future__ import annotations

from functools import cache

from curation_ros.core.errors import ConfigError
from sim_node.environment import Environment
from sim_node.settings import SIMULATED_TASK
from sim_node.starts import names_of
from sim_node.tasks import bowl_from_center, bowl_on_plate
from sim_node.tasks.task import Task

TASKS: dict[str, Task] = {
    "bowl_on_plate": bowl_on_plate.TASK,
    "bowl_from_center": bowl_from_center.TASK,
}
"""Every task that the sim node, `curation collect` and studies can name."""


def task_named(name: str) -> Task:
    """The task of a name.

    Raises:
        ConfigError: naming the known ones if there is none.
    """
    if name not in TASKS:
        raise ConfigError(f"simulated task {name!r} is unknown; known: {', '.join(TASKS)}")
    return TASKS[name]


def start_names(spec: str, simulated_task: str = SIMULATED_TASK) -> list[str]:
    """Names of the starts that a specification means; nothing is simulated for it.

    Args:
        spec: see `sim_node.starts.names_of`.
        simulated_task: the task whose starts they are.

    Raises:
        ConfigError: if the text is no such specification, or there is no such task.
    """
    return names_of(spec, task_named(simulated_task).n_official_starts)


@cache
def process_environment(simulated_task: str) -> Environment:
    """The lean environment of a task in this process, made once, for workers with many episodes.

    Raises:
        ConfigError: if there is no such task.
        SimError: if the simulator cannot be loaded.
    """
    return task_named(simulated_task).environment()
