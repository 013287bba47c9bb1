from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from curation_ros.core.errors import ConfigError, SimError
from sim_node.starts import names_of
from sim_node.tasks import TASKS, start_names
from sim_node.tasks.bowl_on_plate import TASK

BAD_SPECS = [
    "",
    "official",
    "official:0",
    "official:0:51",
    "official:5:5",
    "official:-1:5",
    "official:a:b",
    "generated:0",
    "generated:0:0",
    "generated:0:1:2:3",
    "random:0:5",
    "official:0:2,official:1:3",
    "official:0:2,",
]


@pytest.mark.parametrize("spec", BAD_SPECS)
def test_bad_spec_is_a_one_line_error(spec):
    with pytest.raises(ConfigError) as error:
        start_names(spec)
    assert "\n" not in str(error.value)
    assert repr(spec) in str(error.value)


def test_official_starts_are_as_many_as_the_task_has():
    assert names_of("official:1:3", 3) == ["official-01", "official-02"]
    with pytest.raises(ConfigError, match="there are 3 official starts"):
        names_of("official:0:4", 3)


def test_unknown_name_is_an_error():
    with pytest.raises(ConfigError, match="unknown"):
        TASK.start("nonsense")


def test_unknown_task_is_an_error():
    with pytest.raises(ConfigError, match="simulated task 'dance' is unknown; known: bowl_on_pla"):
        start_names("official:0:1", "dance")


@pytest.mark.sim
@pytest.mark.parametrize("name", TASKS)
def test_official_starts_are_fifty_and_protected(name):
    task = TASKS[name]
    starts = [task.start(one) for one in start_names("official:0:50", name)]
    assert len({start.state.tobytes() for start in starts}) == 50
    kept = starts[0].state.copy()
    starts[0].state[:] = 0.0
    assert np.array_equal(task.start("official-00").state, kept)
    assert kept.any()
    with pytest.raises(ConfigError, match="0 to 49"):
        task.start("official-50")


@pytest.mark.sim
def test_generated_starts_are_deterministic_and_none_is_official():
    assert start_names("generated:0:2") == ["generated-0-000", "generated-0-001"]
    assert start_names("generated:0:2:4") == ["generated-0-002", "generated-0-003"]
    states = np.array([TASK.start(name).state for name in start_names("generated:0:6")])
    # Any order, any subset, any neighbours.
    assert np.array_equal(TASK.start("generated-0-004").state, states[4])
    assert not np.array_equal(TASK.start("generated-1-000").state, states[0])
    official = np.array([TASK.start(name).state for name in start_names("official:0:50")])
    apart_m = np.abs(states[:, None, 1:] - official[None, :, 1:]).max(axis=-1)
    assert apart_m.min() > 1e-3
    assert len(np.unique(states, axis=0)) == 6


@pytest.mark.sim
def test_generated_starts_are_the_same_in_another_process():
    code = (
        "from sim_node.tasks.bowl_on_plate import TASK;"
        "print(TASK.start('generated-3-001').state.tobytes().hex())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.strip() == TASK.start("generated-3-001").state.tobytes().hex()


@pytest.mark.sim
def test_places_of_other_objects_are_refused():
    pytest.importorskip("libero", reason="LIBERO is not installed")
    from sim_node.libero.starts import LiberoStarts, Place

    starts = LiberoStarts(TASK._problem, {"plate_1": Place(0.0, 0.0)})
    with pytest.raises(SimError, match="places are given for plate_1; the objects"):
        starts.start("generated-0-000")
