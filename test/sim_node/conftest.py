from __future__ import annotations

from functools import cache

import pytest


@pytest.fixture(scope="session")
def environments():
    """Name of a task -> its lean environment, made once."""
    pytest.importorskip("libero", reason="LIBERO is not installed")
    from sim_node.tasks import TASKS

    made = []

    @cache
    def environment(name):
        made.append(TASKS[name].environment())
        return made[-1]

    yield environment
    for env in made:
        env.close()


@pytest.fixture(scope="session")
def env(environments):
    return environments("bowl_on_plate")
