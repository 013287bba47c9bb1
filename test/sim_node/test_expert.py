from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hand_made_observations import step_at

from sim_node import phases
from sim_node.episodes import run_episode
from sim_node.expert import Expert
from sim_node.starts import parse_starts


def test_same_seed_gives_the_same_commands_and_another_does_not():
    path = [step_at([0.01 * i - 0.2, 0.0, 1.1]) for i in range(30)]

    def commands(seed: int) -> np.ndarray:
        expert = Expert(seed)
        return np.array([expert.act(step)[0] for step in path])

    assert np.array_equal(commands(1), commands(1))
    assert not np.array_equal(commands(1), commands(2))


def test_commands_stay_in_range_and_close_the_gripper_in_three_phases():
    for seed in range(20):
        expert = Expert(seed)
        grippers = []
        for phase in range(6):
            for _ in range(5):
                action, gripper = expert.act(step_at([-0.2, 0.1, 1.2], phase))
                assert action.dtype == np.float64
                assert np.abs(action).max() <= 0.3
            grippers.append(gripper)
        assert grippers == [-1, -1, 1, 1, 1, -1]


def test_expert_does_not_notice_that_the_bowl_is_lost():
    first = step_at([0.0, 0.1, 1.0])
    here = step_at([0.0, 0.1, 1.0], phases.LIFT)
    lost = step_at([0.0, 0.1, 1.0], phases.LIFT, bowl_m=np.full(3, 9.0))
    one, other = Expert(0), Expert(0)
    one.act(first)
    other.act(first)
    assert np.array_equal(one.act(here)[0], other.act(lost)[0])


@pytest.mark.sim
def test_expert_succeeds_and_goes_on_for_a_second(env):
    lengths = []
    for i, start in enumerate(parse_starts("generated:11:6")):
        result = run_episode(env, start, Expert(i))
        assert result.is_success
        assert result.is_success_at_end
        assert result.n_steps == result.success_step + 21
        assert result.stage == "RELEASE"
        assert sum(result.phase_steps) == result.n_steps
        lengths.append(result.n_steps)
    assert len(set(lengths)) > 3
