from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode
from streams import record, same_arrays, short_episode

from curation_ros.core.decision.balance import balance_of, phase_steps
from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.decision.ties import tie_key
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import BagError, ConfigError, CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_override
from curation_ros.dataset.manifests import read_manifest, read_selected, save_selection

N = 8


def _decide(
    dataset: Dataset, episode: Episode, scores: Mapping[str, float | None], **changes: Any
) -> Decision:
    values: dict[str, Any] = {"verdict": "keep", "reason": "r", "span": (0, 90_000_000), **changes}
    values.setdefault("state_hash", "fitted")
    decision = Decision(episode=episode.id, name=episode.name, scores=scores, **values)
    return dataset.append_decision(decision)


def _recorded(dataset: Dataset, rng: np.random.Generator, n: int = N) -> list[Episode]:
    episodes = [short_episode(rng, 3, name=f"pick-{k}") for k in range(n)]
    for episode in episodes:
        record(dataset, episode)
    return sorted(episodes, key=lambda e: e.id)


def _scored(
    dataset: Dataset, rng: np.random.Generator, scores: list[float | None]
) -> list[Episode]:
    episodes = _recorded(dataset, rng, len(scores))
    for episode, score in zip(episodes, scores, strict=True):
        _decide(dataset, episode, {"knn": score, "length": -1.0})
    return episodes


def _kept(dataset: Dataset, **options: Any) -> list[str]:
    manifest, _ = save_selection(dataset, **options)
    return [e.episode for e in manifest.entries]


# --- rules --------------------------------------------------------------------------------------


def test_decisions_keep_what_is_kept_and_the_spans_that_are_salvaged(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _recorded(dataset, rng, 5)
    for episode, verdict in zip(episodes, ("keep", "salvage", "review", "discard"), strict=False):
        span = (1, 50_000_000) if verdict == "salvage" else (0, 90_000_000)
        _decide(dataset, episode, {}, verdict=verdict, span=span)
    manifest, path = save_selection(dataset, rule="decisions")
    assert {e.episode: e.span for e in manifest.entries} == {
        episodes[0].id: None,
        episodes[1].id: (1, 50_000_000),
    }
    assert (manifest.kept_of, manifest.abstained) == (5, (episodes[4].id,))
    assert (manifest.rule, manifest.scorer, manifest.state_hash) == ("decisions", "", "fitted")
    assert {e.name for e in manifest.entries} == {episodes[0].name, episodes[1].name}
    assert path.parent == dataset.path / "selections"


def test_what_a_person_decided_is_what_is_selected(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first, second = _recorded(dataset, rng, 2)
    _decide(dataset, first, {"knn": 1.0})
    _decide(dataset, second, {"knn": 2.0}, verdict="discard")
    log_override(dataset, first.id, "discard", "", "Ada")
    log_override(dataset, second.id, "keep", "", "Ada")
    _decide(dataset, second, {"knn": 3.0}, verdict="discard")
    assert _kept(dataset, rule="decisions") == [second.id]
    # Scores are the curator's, whatever a person decided: the last ones.
    assert _kept(dataset, rule="threshold", value=2.5, scorer="knn") == [second.id]


@pytest.mark.parametrize(
    ("rule", "value", "kept"),
    [
        ("top-k", 2, [5, 3]),
        ("top-k", 1, [5]),
        ("top-fraction", 0.5, [5, 3, 0]),
        ("top-fraction", 1, [5, 3, 0, 2, 6]),
        ("threshold", 0.5, [5, 3, 0]),
        ("threshold", 9, []),
    ],
)
def test_rules_that_rank_keep_the_best_first(
    dataset: Dataset, rng: np.random.Generator, rule: str, value: float, kept: list[int]
) -> None:
    scores = [0.5, None, 0.1, 0.8, None, 0.9, -2.0]
    episodes = _scored(dataset, rng, scores)
    manifest, _ = save_selection(dataset, rule=rule, value=value, scorer="knn")
    assert [e.episode for e in manifest.entries] == [episodes[k].id for k in kept]
    assert set(manifest.abstained) == {episodes[1].id, episodes[4].id}
    assert manifest.kept_of == 7
    assert manifest.rule_params == {"value": value, "seed": 0}


def test_fault_of_the_recording_is_not_selected_by_its_score(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    best, second, third = _recorded(dataset, rng, 3)
    gap = Finding("gap", "silent", (0, 9))
    _decide(dataset, best, {"knn": 3.0}, verdict="review", findings=(gap,))
    _decide(dataset, second, {"knn": 2.0})
    _decide(dataset, third, {"knn": 1.0})
    manifest, _ = save_selection(dataset, rule="top-k", value=1, scorer="knn")
    assert [e.episode for e in manifest.entries] == [second.id]
    assert manifest.abstained == (best.id,)
    log_override(dataset, best.id, "keep", "", "Ada")
    assert _kept(dataset, rule="top-k", value=1, scorer="knn") == [best.id]


def test_manifest_has_the_value_that_counted_and_the_method_that_was_asked_for(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _scored(dataset, rng, [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 9.0, 9.1])
    manifest, _ = save_selection(dataset, rule="top-fraction", scorer="knn")
    assert manifest.rule_params == {"value": 0.75, "seed": 0}
    manifest, _ = save_selection(dataset, scorer="knn", method="largest-gap", seed=2)
    assert manifest.rule == "gap"
    assert manifest.rule_params == {"value": None, "seed": 2, "method": "largest-gap"}
    assert len(manifest.entries) == 2


def test_more_than_there_are_keeps_all_and_warns(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _scored(dataset, rng, [0.5, None, 0.1])
    manifest, _ = save_selection(dataset, rule="top-k", value=3, scorer="knn")
    assert len(manifest.entries) == 2
    assert manifest.warnings()[0].startswith("top-k 3 keeps 2: no other of the 3 episodes")


def test_all_keeps_everything_and_asks_for_nothing(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _recorded(dataset, rng, 3)
    assert sorted(_kept(dataset, rule="all")) == [e.id for e in episodes]


def test_decided_episodes_without_a_bag_are_not_candidates(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first, second = _scored(dataset, rng, [1.0, 2.0])
    shutil.rmtree(dataset.bag_path(second.id))
    assert _kept(dataset, rule="decisions") == [first.id]
    assert _kept(dataset, rule="top-k", value=1, scorer="knn") == [first.id]


# --- ties ---------------------------------------------------------------------------------------


def _with_starts(folder: Path, rng: np.random.Generator, order: list[int]) -> Dataset:
    """Episodes of equal scores whose starts were recorded in some order."""
    dataset = Dataset(folder, create=True)
    for episode, k in zip(_scored(dataset, rng, [0.0] * len(order)), order, strict=True):
        dataset.append_truth(
            {"episode": episode.id, "task": "t", "start": f"official-{k:02d}", "repetition": 1}
        )
    return dataset


def _kept_starts(dataset: Dataset, seed: int, k: int = 3) -> list[str]:
    starts = dataset.truth_log.starts()
    kept = _kept(dataset, rule="top-k", value=k, scorer="knn", seed=seed)
    return [starts[i][1] for i in kept]


def test_ties_go_by_start_and_seed_and_not_by_the_order_of_recording(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    datasets = [
        _with_starts(tmp_path / f"d{n}", rng, order)
        for n, order in enumerate(([0, 1, 2, 3, 4, 5], [5, 3, 1, 0, 2, 4]))
    ]
    chosen = set()
    for seed in range(6):
        first, second = (_kept_starts(d, seed) for d in datasets)
        assert first == second
        keys = sorted(range(6), key=lambda k: tie_key(seed, "t", f"official-{k:02d}", 1))
        assert first == [f"official-{k:02d}" for k in keys[:3]]
        chosen.add(tuple(first))
    assert len(chosen) > 1


def test_constant_scorer_keeps_early_and_late_episodes_alike(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    n, n_seeds = 8, 60
    dataset = _with_starts(tmp_path / "d", rng, list(range(n)))
    times_kept = np.zeros(n)
    for seed in range(n_seeds):
        for start in _kept_starts(dataset, seed, n // 2):
            times_kept[int(start[-2:])] += 1
    # Each is kept in half of the selections, give or take five standard deviations.
    assert np.abs(times_kept / n_seeds - 0.5).max() < 5 * np.sqrt(0.25 / n_seeds)


def test_ties_without_a_known_start_go_by_the_id(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = _scored(dataset, rng, [0.0] * 5)
    keys = sorted((e.id for e in episodes), key=lambda i: tie_key(3, i))
    assert _kept(dataset, rule="top-k", value=2, scorer="knn", seed=3) == keys[:2]


# --- phases -------------------------------------------------------------------------------------


def test_phases_of_what_is_kept_are_counted(dataset: Dataset, rng: np.random.Generator) -> None:
    whole, cut, left = (make_episode(rng, name=f"pick-{k}") for k in range(3))
    for episode in (whole, cut, left):
        record(dataset, episode)
    half = (0, 7_000_000_000)
    _decide(dataset, whole, {})
    _decide(dataset, cut, {}, verdict="salvage", span=half)
    _decide(dataset, left, {}, verdict="discard")
    manifest, path = save_selection(dataset, rule="decisions")
    trained_on = [(whole.id, phase_steps(whole)), (cut.id, phase_steps(cut, half))]
    assert manifest.phases == balance_of(trained_on)
    assert read_manifest(path)[0].phases == manifest.phases
    shown = manifest.phases.phases
    expected = dict.fromkeys(whole.phase_labels, 2) | {"TRANSPORT": 1, "RELEASE": 1}
    assert {name: s.demonstrations for name, s in shown.items()} == expected


def test_phases_of_a_bag_that_cannot_be_read_are_not_known(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first, second = _recorded(dataset, rng, 2)
    [file] = dataset.bag_path(second.id).glob("*.mcap")
    file.write_bytes(b"")
    manifest, _ = save_selection(dataset, rule="all")
    assert manifest.phases == balance_of([(first.id, phase_steps(first)), (second.id, None)])


# --- what is refused ----------------------------------------------------------------------------


def test_empty_dataset_gives_no_selection(dataset: Dataset) -> None:
    with pytest.raises(ConfigError, match="no episode to select from"):
        save_selection(dataset, rule="all")
    assert not (dataset.path / "selections").exists()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rule": "top-k", "value": 1}, "reads the scores of a scorer"),
        (
            {"rule": "top-k", "value": 1, "scorer": "nose"},
            "no episode has a logged score of 'nose'",
        ),
        ({"rule": "all", "scorer": "knn"}, "'all' reads no scores"),
        ({"rule": "top-k", "value": 1.5, "scorer": "knn"}, "'top-k': value is 1.5"),
        ({"rule": "top-fraction", "value": 2, "scorer": "knn"}, "'top-fraction': value is 2"),
        ({"rule": "threshold", "scorer": "knn"}, "'threshold': without a value"),
        ({"rule": "threshold", "value": float("nan"), "scorer": "knn"}, "threshold is nan"),
        ({"rule": "decisions", "value": 1}, "'decisions' takes no value, found 1"),
        ({"rule": "evidence", "scorer": "knn"}, "'evidence': it decides on whole examinations"),
        ({"rule": "nose"}, "'nose'"),
        ({"rule": "all", "name": "../evil"}, "'../evil'"),
        ({"rule": "all", "name": "a b"}, "'a b'"),
    ],
)
def test_selection_that_makes_no_sense_is_refused_and_not_written(
    dataset: Dataset, rng: np.random.Generator, options: dict[str, Any], said: str
) -> None:
    _scored(dataset, rng, [0.0, 1.0, 2.0])
    with pytest.raises(ConfigError, match=said.replace(".", r"\.")):
        save_selection(dataset, **options)
    assert not list(dataset.path.rglob("*.json"))


def test_name_that_is_taken_is_refused(dataset: Dataset, rng: np.random.Generator) -> None:
    _recorded(dataset, rng, 2)
    _, path = save_selection(dataset, rule="all", name="mine")
    before = path.read_bytes()
    with pytest.raises(CurationError, match=f"{path} exists"):
        save_selection(dataset, rule="all", name="mine")
    assert path.read_bytes() == before
    unnamed = {save_selection(dataset, rule="all")[1] for _ in range(3)}
    assert len(unnamed) == 3


# --- back to episodes ---------------------------------------------------------------------------


def test_selected_episodes_are_those_of_the_manifest(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episodes = {e.id: e for e in _recorded(dataset, rng, 3)}
    ids = list(episodes)
    _decide(dataset, episodes[ids[0]], {})
    _decide(dataset, episodes[ids[1]], {}, verdict="salvage", span=(5, 60_000_000))
    written, path = save_selection(dataset, rule="decisions")
    manifest, found = read_manifest(path)
    assert manifest == written
    assert found.path == dataset.path.resolve()
    selected = read_selected(manifest, found)
    assert {e.id: span for e, span in selected} == {ids[0]: None, ids[1]: (5, 60_000_000)}
    for episode, _ in selected:
        assert same_arrays(episode, episodes[episode.id])


def test_dataset_may_be_moved_with_its_selections(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    _recorded(dataset, rng, 2)
    _, path = save_selection(dataset, rule="all", name="mine")
    moved = tmp_path / "elsewhere" / "data"
    moved.parent.mkdir()
    shutil.move(dataset.path, moved)
    manifest, found = read_manifest(moved / "selections" / path.name)
    assert len(read_selected(manifest, found)) == 2


def test_episode_that_is_not_there_is_named(dataset: Dataset, rng: np.random.Generator) -> None:
    first, second = _recorded(dataset, rng, 2)
    _, path = save_selection(dataset, rule="all")
    shutil.rmtree(dataset.bag_path(second.id))
    with pytest.raises(BagError, match=second.id):
        read_selected(*read_manifest(path))
    assert first.id != second.id


@pytest.mark.parametrize(
    "content", [b"{", b"", b"\xff\xfe", b"5", b"[]", b"{}", b'{"name": "x", "entries": 3}']
)
def test_file_that_is_no_selection_is_refused_by_name(dataset: Dataset, content: bytes) -> None:
    path = dataset.path / "selections" / "bad.json"
    path.parent.mkdir()
    path.write_bytes(content)
    with pytest.raises(ConfigError) as refused:
        read_manifest(path)
    assert str(path) in str(refused.value)


def test_selection_that_is_not_there_or_outside_a_dataset_is_refused(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(ConfigError, match=str(path)):
            read_manifest(path)
    _recorded(dataset, rng, 1)
    _, path = save_selection(dataset, rule="all")
    stray = tmp_path / "a" / "b" / "stray.json"
    stray.parent.mkdir(parents=True)
    shutil.copy(path, stray)
    with pytest.raises(CurationError, match="no folder 'episodes'"):
        read_manifest(stray)


def test_manifest_keeps_what_made_it(dataset: Dataset, rng: np.random.Generator) -> None:
    first, second = _recorded(dataset, rng, 2)
    _decide(dataset, first, {"knn": 1.0}, state_hash="b")
    _decide(dataset, second, {"knn": 2.0}, state_hash="a")
    _, path = save_selection(dataset, rule="top-k", value=1, scorer="knn", seed=5, name="mine")
    raw = json.loads(path.read_text())
    assert raw["state_hash"] == "a,b"
    assert (raw["scorer"], raw["rule_params"]) == ("knn", {"value": 1, "seed": 5})
    assert raw["dataset"] == str(dataset.path)
    assert CURATOR not in path.read_text()
