from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("mujoco")

from curation_ros.core.errors import ConfigError
from sim_node.starts import (
    generated_start,
    official_start,
    official_states,
    parse_starts,
    start_by_name,
)

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
@pytest.mark.sim
def test_bad_spec_is_a_one_line_error(spec):
    with pytest.raises(ConfigError) as error:
        parse_starts(spec)
    assert "\n" not in str(error.value)
    assert repr(spec) in str(error.value)


def test_unknown_name_is_an_error():
    with pytest.raises(ConfigError, match="unknown"):
        start_by_name("nonsense")


@pytest.mark.sim
def test_official_starts_are_fifty_and_protected():
    starts = parse_starts("official:0:50")
    assert len({start.name for start in starts}) == 50
    starts[0].state[:] = 0.0
    assert np.array_equal(official_start(0).state, official_states()[0])
    assert official_states()[0].any()
    with pytest.raises(ConfigError, match="0 to 49"):
        official_start(50)


@pytest.mark.sim
def test_generated_starts_are_deterministic_and_none_is_official():
    starts = parse_starts("generated:0:6")
    assert [start.name for start in starts] == [f"generated-0-{i:03d}" for i in range(6)]
    states = np.array([start.state for start in starts])
    # Any order, any subset, any neighbours.
    assert np.array_equal(generated_start(0, 4).state, states[4])
    assert np.array_equal(parse_starts("generated:0:2:4")[1].state, states[3])
    assert np.array_equal(start_by_name("generated-0-005").state, states[5])
    assert not np.array_equal(generated_start(1, 0).state, states[0])
    apart_m = np.abs(states[:, None, 1:] - official_states()[None, :, 1:]).max(axis=-1)
    assert apart_m.min() > 1e-3
    assert len(np.unique(states, axis=0)) == 6


@pytest.mark.sim
def test_generated_starts_are_the_same_in_another_process():
    code = "from sim_node.starts import generated_start as g;print(g(3, 1).state.tobytes().hex())"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout.strip() == generated_start(3, 1).state.tobytes().hex()


def test_negative_seed_is_an_error():
    with pytest.raises(ConfigError, match=">= 0"):
        generated_start(-1, 0)
