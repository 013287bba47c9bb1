from __future__ import annotations

import numpy as np
import pytest
from episodes import make_episode
from streams import record

from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_all_episodes, read_episodes


def test_episodes_are_read_in_the_order_of_ids_and_problems_are_listed(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    made = [make_episode(rng, 20, close_at=None) for _ in range(3)]
    for episode in made:
        record(dataset, episode)
    broken = dataset.bag_path("broken")
    broken.mkdir()
    (broken / "broken_0.mcap").write_bytes(b"")
    episodes, problems = read_episodes(dataset)
    assert [e.id for e in episodes] == sorted(e.id for e in made)
    assert len(problems) == 1
    assert str(broken) in problems[0]
    with pytest.raises(CurationError, match=r"pool 'a': .*broken"):
        read_all_episodes(dataset, "pool 'a'")
