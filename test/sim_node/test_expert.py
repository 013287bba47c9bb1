from __future__ import annotations

import numpy as np
import pytest
from hand_made_observations import step_at

from sim_node.episodes import run_episode
from sim_node.tasks import TASKS
from sim_node.tasks.bowl_on_plate import TASK
from sim_node.tasks.pick_and_place import LIFT


def test_same_seed_gives_the_same_commands_and_another_does_not():
    path = [step_at([0.01 * i - 0.2, 0.0, 1.1]) for i in range(30)]

    def commands(seed: int) -> np.ndarray:
        expert = TASK.expert(seed)
        return np.array([expert.act(step)[0] for step in path])

    assert np.array_equal(commands(1), commands(1))
    assert not np.array_equal(commands(1), commands(2))


def test_commands_stay_in_range_and_close_the_gripper_in_three_phases():
    for seed in range(20):
        expert = TASK.expert(seed)
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
    here = step_at([0.0, 0.1, 1.0], LIFT)
    lost = step_at([0.0, 0.1, 1.0], LIFT, bowl_m=np.full(3, 9.0))
    one, other = TASK.expert(0), TASK.expert(0)
    one.act(first)
    other.act(first)
    assert np.array_equal(one.act(here)[0], other.act(lost)[0])


@pytest.mark.sim
@pytest.mark.parametrize("name", TASKS)
def test_expert_succeeds_and_goes_on_for_a_second(environments, name):
    task, env = TASKS[name], environments(name)
    lengths = []
    for i in range(6):
        start = task.start(f"generated-11-{i:03d}")
        result = run_episode(env, task, start, task.expert(i))
        assert result.is_success
        assert env.is_success()
        assert result.n_steps == result.success_step + 21
        assert result.stage == "RELEASE"
        assert sum(result.phase_steps) == result.n_steps
        lengths.append(result.n_steps)
    assert len(set(lengths)) > 3
