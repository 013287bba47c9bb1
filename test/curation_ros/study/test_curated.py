from __future__ import annotations

from pathlib import Path

import pytest
from made_pool import DROPS, MARGIN, pool_of, scenes_of
from scenes import scene

from curation_ros.study.curated import compare_with_truth, curate
from curation_ros.study.pools import Pool


@pytest.fixture
def pool(tmp_path: Path) -> Pool:
    return pool_of(tmp_path, scenes_of())


def test_facts_are_decisions_against_the_truth(pool: Pool) -> None:
    assert pool.curated is not None
    released = {f"a-{k}": at for k, at in enumerate(DROPS, start=2)}
    facts = compare_with_truth(pool.curated, pool.good, released, pool.timelines)
    assert facts["verdicts"]["keep"] == {"good": 2, "defective": 0}
    assert facts["verdicts"]["salvage"] == {"good": 0, "defective": 3}
    assert facts["verdicts"]["review"] == {"good": 0, "defective": 0}
    assert facts["decided_by"] == {"object_coupling": 5}
    late = {"n": 3, "min": -MARGIN, "median": -MARGIN, "max": -MARGIN}
    assert facts["cut_minus_release"] == late
    assert (
        compare_with_truth(pool.curated, pool.good, {}, pool.timelines)["cut_minus_release"]
        is None
    )


def test_example_is_the_first_salvaged_episode_by_name(pool: Pool) -> None:
    assert pool.curated is not None
    assert pool.curated.example is not None
    assert pool.curated.example.id == "a-2"
    assert curate([scene()]).example is None
