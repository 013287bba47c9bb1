"""Demonstrations recorded in process: the same episodes as on the graph, and safe to interrupt."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from curation_ros.bags import open_bag
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")

from curation_ros.study.collect import Collection, collect  # noqa: E402 - needs LIBERO

#: Short episodes: their outcome is `failed`, but their bags are complete.
SHORT = Collection(episodes=4, contamination=0.5, seed=3, paired=True, max_steps=20)


def by_name(folder: Path) -> dict[str, dict[str, Any]]:
    return {t["name"]: t for t in Dataset(folder).truth().values()}


def without_identity(truth: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in truth.items() if key != "episode"}


def contents(folder: Path) -> dict[str, str]:
    """Name -> digest of everything but stamps."""
    found = {}
    for bag in Dataset(folder).bags():
        episode = read_episode(bag)
        assert episode.findings == ()
        assert episode.name not in found
        offsets = episode.stamps_ns - episode.start_ns
        found[episode.name] = (
            len(episode),
            offsets.tobytes(),
            *(values.tobytes() for _, values in sorted(episode.fields.items())),
        )
    return found


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("collected") / "data"
    assert [one.problem for one in collect(folder, SHORT)] == [""] * 4
    return folder


@pytest.fixture
def data(collected: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    shutil.copytree(collected, tmp_path / "data")
    return tmp_path / "data"


# --- as on the graph ----------------------------------------------------------------------------


@pytest.mark.ros
def test_episodes_equal_those_recorded_on_the_graph(tmp_path: Path) -> None:
    """The same plan over DDS: equal arrays, truth and form of the bags."""
    pytest.importorskip("rclpy", reason="rclpy is not installed")
    from curation_ros.nodes.processes import Domain, Nodes

    plan = {"episodes": 2, "contamination": 0.5, "seed": 3, "max_steps_defective": 120}
    in_process, on_graph = tmp_path / "in_process", tmp_path / "on_graph"
    list(collect(in_process, Collection(**plan)))
    domain = Domain()
    with Nodes(domain, tmp_path / "logs") as nodes:
        nodes.start("recorder", {"dataset": on_graph})
        nodes.start("sim_node", {**plan, "dataset": on_graph, "wait_for": ["recorder"]})
        nodes.wait("sim_node", 120.0)
    domain.close()
    assert contents(in_process) == contents(on_graph)
    ours, theirs = by_name(in_process), by_name(on_graph)
    assert [without_identity(t) for t in ours.values()] == [
        without_identity(t) for t in theirs.values()
    ]
    for name, truth in ours.items():
        bags = [
            open_bag(Dataset(folder).bag_path(there[name]["episode"]))
            for folder, there in ((in_process, ours), (on_graph, theirs))
        ]
        # Over DDS a first step may be there twice: `forms` has the counts of distinct stamps.
        assert [{name: topic.type for name, topic in bag.topics.items()} for bag in bags] == [
            {name: topic.type for name, topic in bags[0].topics.items()}
        ] * 2
        assert forms(bags[0]) == forms(bags[1])
        assert truth["outcome"] == ("succeeded" if truth["defect"] == "none" else "failed")


def forms(bag: Any) -> dict[str, Any]:
    """Custom data of a bag, without ids and stamps."""
    data = {key: text for key, text in bag.custom_data.items()}
    event = json.loads(data.pop("episode"))
    for key in ("id", "start_stamp", "end_stamp"):
        event.pop(key)
    return {**data, "episode": event}


# --- plan ---------------------------------------------------------------------------------------


def test_ids_names_and_stamps_are_in_the_order_of_the_plan(collected: Path) -> None:
    bags = [open_bag(bag).event() for bag in Dataset(collected).bags()]
    assert [event.name for event in bags] == [f"bowl-{k:04d}" for k in range(1, 5)]
    assert all(a.end_ns < b.start_ns for a, b in itertools.pairwise(bags))
    plan, truth = SHORT.plan(), by_name(collected)
    assert set(plan) == set(truth)
    for name, episode in plan.items():
        for key in ("start", "repetition", "defect", "expert_seed"):
            assert truth[name][key] == getattr(episode, key)


def test_workers_collect_the_same(collected: Path, tmp_path: Path) -> None:
    done = list(collect(tmp_path / "data", SHORT, jobs=2))
    assert sorted(one.name for one in done) == list(SHORT.plan())
    assert contents(tmp_path / "data") == contents(collected)
    names = [open_bag(bag).event().name for bag in Dataset(tmp_path / "data").bags()]
    assert names == list(SHORT.plan())


@pytest.mark.parametrize(
    "wrong",
    [
        {"episodes": 0},
        {"contamination": 1.5},
        {"defect": "dance"},
        {"starts": "nonsense"},
        {"max_steps": 0},
        {"steps_after_success": -1},
        {"simulated_task": "dance"},
        {"topic_map": "nowhere.yaml"},
    ],
)
def test_collection_that_makes_no_sense_is_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        list(collect(tmp_path / "data", replace(SHORT, **wrong)))


def test_another_task_is_collected_by_its_name(tmp_path: Path) -> None:
    other = replace(SHORT, episodes=1, contamination=0.0, simulated_task="bowl_from_center")
    [one] = collect(tmp_path / "data", other)
    assert (one.problem, one.truth["task"]) == ("", "libero_spatial/2")
    [bag] = Dataset(tmp_path / "data").bags()
    bowl_m = read_episode(bag).field("bowl_position")[0]
    assert np.linalg.norm(bowl_m[:2] - (-0.075, 0.0)) < 0.06
    with pytest.raises(ConfigError, match="bowl-0001 has task 'libero_spatial/2', the plan"):
        list(collect(tmp_path / "data", replace(other, simulated_task="bowl_on_plate")))


def test_study_names_the_prefix_as_the_sim_node_does() -> None:
    made = Collection.from_settings({"episodes": 2, "task": "cup"})
    assert list(made.plan()) == ["cup-0001", "cup-0002"]
    with pytest.raises(ConfigError, match="colour"):
        Collection.from_settings({"episodes": 2, "colour": "red"})


# --- going on -----------------------------------------------------------------------------------


def test_what_is_there_is_not_collected_again(data: Path) -> None:
    before = sorted(p.name for p in Dataset(data).bags())
    assert all(one.is_known for one in collect(data, SHORT))
    more = list(collect(data, replace(SHORT, name_prefix="more", episodes=1, contamination=0.0)))
    assert [(one.name, one.is_known) for one in more] == [("more-0001", False)]
    assert sorted(p.name for p in Dataset(data).bags())[:4] == before


def test_bag_without_truth_is_collected_again_and_kept_apart(collected: Path, data: Path) -> None:
    lines = (data / "truth.jsonl").read_text().splitlines(keepends=True)
    (data / "truth.jsonl").write_text("".join(lines[:-1]))
    untold = json.loads(lines[-1])["episode"]
    done = list(collect(data, SHORT))
    assert [one.is_known for one in done] == [True, True, True, False]
    assert not Dataset(data).bag_path(untold).exists()
    assert (data / "quarantine" / f"{untold}.untold").is_dir()
    assert contents(data) == contents(collected)


def test_dataset_of_another_plan_is_refused(data: Path) -> None:
    with pytest.raises(ConfigError, match=r"bowl-0001 has .*another plan"):
        list(collect(data, replace(SHORT, seed=4)))


def test_two_collections_at_once_are_refused(data: Path) -> None:
    first = collect(data, SHORT)
    next(first)
    with pytest.raises(CurationError, match="another collection is running"):
        list(collect(data, SHORT))
    assert len(list(first)) == 3


def test_killed_collection_goes_on(collected: Path, tmp_path: Path) -> None:
    folder = tmp_path / "data"
    plan = {"--episodes": 4, "--contamination": 0.5, "--seed": 3, "--max-steps": 20}
    words = ["--paired", "--json", *(str(word) for pair in plan.items() for word in pair)]
    command = [sys.executable, "-m", "curation_ros.cli.main", "collect", str(folder), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        first = json.loads(process.stdout.readline())
        os.kill(process.pid, signal.SIGKILL)
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    *rows, summary = map(json.loads, done.stdout.splitlines())
    assert first["episode"] not in {row["episode"] for row in rows}
    assert (summary["episodes"], summary["known"]) == (4, 4 - len(rows))
    assert summary["known"] >= 1
    assert contents(folder) == contents(collected)


def test_full_disk_fails_the_episode_and_says_so(tmp_path: Path, monkeypatch: Any) -> None:
    real = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: real._replace(free=1_000_000))
    done = list(collect(tmp_path / "data", replace(SHORT, episodes=1)))
    assert [(one.truth, "MB free" in one.problem) for one in done] == [(None, True)]
    monkeypatch.undo()
    assert [one.problem for one in collect(tmp_path / "data", replace(SHORT, episodes=1))] == [""]


def test_values_are_those_of_the_simulator(collected: Path) -> None:
    episode = read_episode(next(Dataset(collected).bags()))
    assert len(episode) == SHORT.max_steps
    assert np.all(np.diff(episode.stamps_ns) == 50_000_000)
    assert episode.field("bowl_position")[:, 2].min() > 0.85
