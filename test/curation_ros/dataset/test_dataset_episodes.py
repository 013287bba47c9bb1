"""Episodes are found and read by their paths, in datasets and elsewhere."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from bag_messages import episode_messages, write_bag
from episodes import make_episode
from streams import record

from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import find_episodes, read_all_episodes, read_episodes


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


def test_find_episodes_expands_datasets_folders_and_files(tmp_path: Path) -> None:
    dataset = tmp_path / "data"
    for name in ("b", "a"):
        write_bag(dataset / "episodes" / name, episode_messages(1))
    write_bag(dataset / "episodes" / ".partial" / "c", episode_messages(1))
    (dataset / "episodes" / "notes").mkdir()
    flat = tmp_path / "flat"
    flat.mkdir()
    for k in (10, 9):
        shutil.copy(dataset / "episodes/a/a_0.mcap", flat / f"demo_{k}.mcap")
    (flat / "readme.txt").write_text("")
    one = dataset / "episodes" / "b"
    assert find_episodes([one, dataset]) == [one, dataset / "episodes" / "a"]
    assert find_episodes([dataset / "episodes"]) == [dataset / "episodes" / "a", one]
    assert find_episodes([flat]) == [flat / "demo_9.mcap", flat / "demo_10.mcap"]
    assert find_episodes([one / "b_0.mcap"]) == [one / "b_0.mcap"]
    with pytest.raises(EpisodeError, match="has no episode in it"):
        find_episodes([dataset, dataset / "episodes" / "notes"])
    with pytest.raises(EpisodeError, match="no such path"):
        find_episodes([tmp_path / "nowhere"])


def test_folder_of_datasets_is_told_from_a_dataset(tmp_path: Path) -> None:
    (tmp_path / "notes").mkdir()
    with pytest.raises(EpisodeError, match=r"has no episode in it$"):
        find_episodes([tmp_path])
    for name in ("ann", "ben"):
        (tmp_path / name / "episodes").mkdir(parents=True)
    with pytest.raises(
        EpisodeError, match=r"has no episode in it: did you mean .*ann or .*ben[?]$"
    ):
        find_episodes([tmp_path])


def test_episodes_are_found_in_the_order_of_their_ids(tmp_path: Path) -> None:
    ids = ["01a20164-99af-7f9c-803d-7ad12c0caf76", "01a20164-9be8-79b2-a1b7-789d4261dc45"]
    for episode_id in ids:
        folder = tmp_path / "episodes" / episode_id
        folder.mkdir(parents=True)
        (folder / "metadata.yaml").touch()
    assert [path.name for path in find_episodes([tmp_path])] == ids
