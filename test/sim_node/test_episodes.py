from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

pytest.importorskip("mujoco")

from curation_ros.core.errors import ConfigError
from sim_node.episodes import plan_episodes, run_episode
from sim_node.expert import Expert
from sim_node.starts import official_start

STARTS = [f"generated-0-{i:03d}" for i in range(80)]


@pytest.mark.parametrize(
    ("n", "contamination", "expected"), [(80, 0.8, 64), (7, 0.5, 4), (5, 0, 0)]
)
def test_plan_has_the_exact_number_of_defects(n, contamination, expected):
    plans = plan_episodes(n, contamination, "early_release", 0, STARTS)
    kinds = Counter(plan.defect for plan in plans)
    assert kinds["early_release"] == expected
    assert kinds["none"] == n - expected
    assert [plan.index for plan in plans] == list(range(n))


def test_paired_plan_repeats_each_clean_start_among_the_defective():
    plans = plan_episodes(80, 0.8, "early_release", 3, STARTS, paired=True)
    clean = Counter(plan.start for plan in plans if plan.defect == "none")
    defective = Counter(plan.start for plan in plans if plan.defect != "none")
    assert set(clean) == set(defective)
    assert set(clean.values()) == {1}
    assert set(defective.values()) == {4}
    repetitions = sorted(
        p.repetition for p in plans if p.defect != "none" and p.start == STARTS[0]
    )
    assert repetitions == [0, 1, 2, 3]


def test_independent_plan_uses_each_start_once():
    plans = plan_episodes(80, 0.8, "early_release", 3, STARTS, paired=False)
    assert len({plan.start for plan in plans}) == 80


def test_plan_is_shuffled_by_the_seed_alone():
    one = plan_episodes(40, 0.5, "early_release", 1, STARTS)
    assert one == plan_episodes(40, 0.5, "early_release", 1, STARTS)
    other = plan_episodes(40, 0.5, "early_release", 2, STARTS)
    assert [plan.defect for plan in one] != [plan.defect for plan in other]
    # Shuffled: the kinds do not come in two blocks.
    kinds = [plan.defect for plan in one]
    assert sum(a != b for a, b in pairwise(kinds)) > 8
    assert len({plan.expert_seed for plan in one}) == 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n": 0}, "n >= 1"),
        ({"contamination": 1.5}, "contamination"),
        ({"defect": "sabotage"}, "sabotage"),
        ({"seed": -1}, "seed"),
        ({"starts": []}, "no start states"),
    ],
)
def test_bad_plan_is_an_error(change, message):
    values = {"n": 4, "contamination": 0.5, "defect": "early_release", "seed": 0, "starts": STARTS}
    with pytest.raises(ConfigError, match=message):
        plan_episodes(**{**values, **change})


@pytest.mark.sim
def test_steps_are_seen_in_order_and_end_at_the_limit(env):
    steps = []
    result = run_episode(env, official_start(1), Expert(0), max_steps=7, on_step=steps.append)
    assert [step.index for step in steps] == list(range(7))
    assert result.n_steps == 7
    assert not result.is_success
    assert result.success_step is None
    assert result.stage == "PREGRASP"
    with pytest.raises(ConfigError, match="max_steps"):
        run_episode(env, official_start(1), Expert(0), max_steps=0)


@pytest.mark.sim
def test_episodes_can_be_repeated_to_the_bit(env):
    def run() -> list[bytes]:
        rows: list[bytes] = []
        plan = plan_episodes(1, 1.0, "early_release", 0, ["official-03"])[0]
        run_episode(
            env,
            official_start(3),
            plan.controller(),
            max_steps=60,
            on_step=lambda step: rows.append(
                step.observation.joint_position_rad.tobytes() + step.action_xyz.tobytes()
            ),
        )
        return rows

    assert run() == run()
