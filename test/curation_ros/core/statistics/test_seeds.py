from __future__ import annotations

import pytest
from outcomes import outcomes

from curation_ros.core.statistics.seeds import SeedCount, deviations, modes, seed_counts


def test_deviations_of_the_papers_gripper_timing_are_the_populations() -> None:
    sample, population = deviations([0, 100 / 30, 1100 / 30])
    assert population == pytest.approx(16.6, abs=0.1)  # as the paper prints it
    assert sample == pytest.approx(population * 1.5**0.5)
    assert deviations([1.0]) == (None, 0.0)


def test_seeds_that_fail_and_work_are_shown_as_two_modes() -> None:
    rows = outcomes([[0] * 10, [1] * 9 + [0], [1, 0] * 5])
    assert seed_counts(rows) == [SeedCount(0, 0, 10), SeedCount(1, 9, 10), SeedCount(2, 5, 10)]
    found = modes(seed_counts(rows))
    assert (found.low, found.middle, found.high) == (1, 1, 1)
