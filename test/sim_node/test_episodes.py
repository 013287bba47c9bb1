from __future__ import annotations

import pytest

from curation_ros.core.errors import ConfigError
from sim_node.episodes import run_episode
from sim_node.planning import plan_episodes
from sim_node.settings import DriveSettings, EpisodeLimits
from sim_node.tasks.bowl_on_plate import TASK


@pytest.mark.parametrize("wrong", [{"max_steps": 0}, {"steps_after_success": -1}])
def test_limits_out_of_range_are_refused(wrong):
    with pytest.raises(ConfigError, match="max_steps must be >= 1"):
        EpisodeLimits(**wrong)


def test_defective_episodes_have_a_limit_of_their_own():
    settings = DriveSettings(max_steps=9, max_steps_defective=5)
    assert settings.limits(is_defective=True).max_steps == 5
    assert settings.limits(is_defective=False).max_steps == 9
    assert DriveSettings(max_steps=9).limits(is_defective=True).max_steps == 9


@pytest.mark.sim
def test_steps_are_seen_in_order_and_end_at_the_limit(env):
    indices = []
    result = run_episode(
        env,
        TASK,
        TASK.start("official-01"),
        TASK.expert(0),
        EpisodeLimits(7),
        on_step=lambda step, _: indices.append(step.index),
    )
    assert indices == list(range(7))
    assert result.n_steps == 7
    assert not result.is_success
    assert result.success_step is None
    assert result.stage == "PREGRASP"


@pytest.mark.sim
def test_episodes_can_be_repeated_to_the_bit(env):
    def run() -> list[bytes]:
        rows: list[bytes] = []
        plan = plan_episodes(1, 1.0, "early_release", 0, ["official-03"])[0]
        run_episode(
            env,
            TASK,
            TASK.start(plan.start),
            plan.controller(TASK),
            EpisodeLimits(60),
            on_step=lambda step, command: rows.append(
                step.observation.joint_position_rad.tobytes() + command.action_xyz.tobytes()
            ),
        )
        return rows

    assert run() == run()
