from __future__ import annotations

from collections import Counter
from itertools import pairwise

import pytest

from curation_ros.core.errors import ConfigError
from sim_node.planning import plan_episodes

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
