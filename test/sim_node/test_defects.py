from __future__ import annotations

import json

import numpy as np
import pytest
from hand_made_observations import step_at

from sim_node.defects import DEFECTS
from sim_node.defects.early_release import EarlyRelease
from sim_node.episodes import run_episode
from sim_node.settings import EpisodeLimits
from sim_node.tasks.bowl_on_plate import TASK
from sim_node.tasks.pick_and_place import GRASP, LIFT, PREGRASP, TRANSPORT

HERE_M = [0.0, 0.0, 1.0]


class Closing:
    def act(self, step):
        return np.zeros(3), 1.0


def test_registry_names_agree():
    assert {name: defect.name for name, defect in DEFECTS.items()} == {n: n for n in DEFECTS}


@pytest.mark.parametrize("name", DEFECTS)
def test_truth_is_json_and_names_the_defect(name):
    controller = DEFECTS[name].inject(Closing(), TASK, 0)
    controller.act(step_at(HERE_M))
    assert json.loads(json.dumps(controller.truth()))["defect"] == name


@pytest.mark.parametrize("seed", range(5))
def test_early_release_opens_at_its_fraction_of_the_lift_for_good(seed):
    controller = EarlyRelease(Closing(), TASK, seed)
    fraction = controller.truth()["release_fraction"]
    assert 0.3 <= fraction <= 0.7
    before = [controller.act(step_at(HERE_M, phase, 1.0))[1] for phase in (PREGRASP, GRASP)]
    assert before == [1.0, 1.0]
    lift = [
        controller.act(step_at(HERE_M, LIFT, progress, index=2 + k))[1]
        for k, progress in enumerate(np.linspace(0.0, 1.0, 51))
    ]
    first = lift.index(-1.0)
    assert first / 50 == pytest.approx(fraction, abs=0.021)
    assert set(lift[:first]) == {1.0}
    assert set(lift[first:]) == {-1.0}
    assert controller.truth()["release_step"] == first + 2
    assert controller.act(step_at(HERE_M, TRANSPORT, 0.0))[1] == -1.0


@pytest.mark.sim
def test_early_release_never_succeeds_and_runs_to_the_limit(env):
    for i in range(3):
        controller = DEFECTS["early_release"].inject(TASK.expert(i), TASK, i)
        start = TASK.start(f"generated-12-{i:03d}")
        result = run_episode(env, TASK, start, controller, EpisodeLimits(400))
        assert not result.is_success
        assert result.n_steps == 400
        assert result.stage == "RELEASE"
        before_lift = sum(result.phase_steps[:LIFT])
        release = controller.truth()["release_step"]
        assert before_lift < release < before_lift + result.phase_steps[LIFT]
