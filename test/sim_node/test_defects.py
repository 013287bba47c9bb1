from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("mujoco")

from hand_made_observations import BOWL_START_M, step_at

from sim_node import phases
from sim_node.defects import DEFECTS, EarlyRelease
from sim_node.episodes import EpisodeLimits, run_episode
from sim_node.expert import Expert
from sim_node.starts import parse_starts


class Closing:
    def act(self, step):
        return np.zeros(3), 1.0


def test_registry_names_agree():
    assert {name: defect.name for name, defect in DEFECTS.items()} == {n: n for n in DEFECTS}


@pytest.mark.parametrize("name", DEFECTS)
def test_truth_is_json_and_names_the_defect(name):
    controller = DEFECTS[name].inject(Closing(), 0)
    controller.act(step_at([0.0, 0.0, 1.0]))
    assert json.loads(json.dumps(controller.truth()))["defect"] == name


@pytest.mark.parametrize("seed", range(5))
def test_early_release_opens_at_its_fraction_of_the_lift_for_good(seed):
    controller = EarlyRelease(Closing(), seed)
    fraction = controller.truth()["release_fraction"]
    assert 0.3 <= fraction <= 0.7
    low_m = phases.grasp_point(BOWL_START_M)[2] + 0.036
    high_m = phases.lift_end_height_m(BOWL_START_M)
    heights_m = np.linspace(low_m, high_m, 51)
    controller.act(step_at([0.0, 0.0, 1.2], phases.PREGRASP))
    grippers = [controller.act(step_at([0.0, 0.0, z], phases.LIFT))[1] for z in heights_m]
    first = grippers.index(-1.0)
    assert first / 50 == pytest.approx(fraction, abs=0.021)
    assert set(grippers[:first]) == {1.0}
    assert set(grippers[first:]) == {-1.0}
    assert controller.truth()["release_step"] == first + 1
    assert controller.act(step_at([0.0, 0.0, low_m], phases.TRANSPORT))[1] == -1.0


@pytest.mark.sim
def test_early_release_never_succeeds_and_runs_to_the_limit(env):
    for i, start in enumerate(parse_starts("generated:12:3")):
        controller = DEFECTS["early_release"].inject(Expert(i), i)
        result = run_episode(env, start, controller, EpisodeLimits(400))
        assert not result.is_success
        assert result.n_steps == 400
        assert result.stage == "RELEASE"
        before_lift = sum(result.phase_steps[: phases.LIFT])
        release = controller.truth()["release_step"]
        assert before_lift < release < before_lift + result.phase_steps[phases.LIFT]
