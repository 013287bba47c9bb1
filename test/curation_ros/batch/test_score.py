"""Scoring as one function: results in order, logged one by one, compared with people."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from episodes import make_episode, make_reference
from streams import record

from curation_ros.batch import score as module
from curation_ros.batch.examine import Examined
from curation_ros.batch.score import Scoring, decide_dataset, score_recordings
from curation_ros.batch.scored import Scored, Unreadable
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.identity import new_episode_id
from curation_ros.core.errors import ConfigError, CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_override

SCORERS = ("gripper_timing", "knn", "length")
SETTINGS = CurationSettings(scorers=SCORERS, rule="threshold")
BEST_HALF = CurationSettings(
    scorers=SCORERS, rule="top-fraction", rule_scorer="length", rule_params={"value": 0.5}
)
N_BAGS = 8
REFERENCE = make_reference(np.random.default_rng(7))


@pytest.fixture(scope="module")
def _recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    dataset = Dataset(tmp_path_factory.mktemp("scored") / "data", create=True)
    rng = np.random.default_rng(11)
    for k in range(N_BAGS):
        open_at = 140 if k % 4 == 3 else -1
        record(dataset, make_episode(rng, 240 + k, open_at=open_at, name=f"pick-{k}"))
    return dataset.path


@pytest.fixture
def data(_recorded: Path, tmp_path: Path) -> Dataset:
    shutil.copytree(_recorded, tmp_path / "data")
    return Dataset(tmp_path / "data")


def scored(results: Iterable[object]) -> list[Scored]:
    found = list(results)
    assert all(isinstance(one, Scored) for one in found), found
    return [one for one in found if isinstance(one, Scored)]


# --- results ------------------------------------------------------------------------------------


def test_every_bag_is_scored_and_decided_on_in_order(data: Dataset) -> None:
    run = score_recordings([data.path], SETTINGS, REFERENCE)
    results = scored(run)
    assert [one.path for one in results] == list(data.bags()) == run.paths
    verdicts = {one.decision.name: one.decision.verdict for one in results}
    bad = {"pick-3", "pick-7"}
    assert verdicts == {
        f"pick-{k}": "discard" if f"pick-{k}" in bad else "keep" for k in range(N_BAGS)
    }
    for one in results:
        assert one.decision.scores == one.examination.scores
        assert (one.is_known, one.is_logged, one.warning) == (False, False, "")
    assert not (data.path / "decisions").exists()


def test_counts_are_those_of_the_results(data: Dataset) -> None:
    broken = next(data.bags())
    [file] = broken.glob("*.mcap")
    file.write_bytes(b"")
    run = score_recordings([data.path, data.path / "none"], SETTINGS, REFERENCE)
    assert run.counts.n_scored == 0
    results = list(run)
    counts = run.counts
    assert (counts.n_scored, counts.n_unreadable) == (N_BAGS - 1, 2)
    assert (counts.n_known, counts.n_in_reference) == (0, 0)
    assert counts.verdicts.total() == N_BAGS - 1
    assert counts.n_with_findings == sum(
        bool(one.decision.findings) for one in results if isinstance(one, Scored)
    )
    again = score_recordings([data.path], SETTINGS, REFERENCE)
    list(again)
    assert again.counts.n_known == N_BAGS - 1


def test_path_without_a_bag_comes_first_and_a_broken_bag_in_its_place(data: Dataset) -> None:
    first, second, *_ = data.bags()
    [file] = second.glob("*.mcap")
    file.write_bytes(b"")
    results = list(score_recordings([first, second, data.path / "none"], SETTINGS, REFERENCE))
    assert [type(one) for one in results] == [Unreadable, Scored, Unreadable]
    missing, good, broken = results
    assert (missing.path, good.path, broken.path) == (data.path / "none", first, second)
    assert isinstance(missing, Unreadable)
    assert isinstance(missing.error, EpisodeError)
    assert list(missing.to_json()) == ["path", "error", "finding"]
    assert missing.to_json()["finding"] == "missing-file"


def test_bag_that_is_named_twice_is_scored_once(data: Dataset) -> None:
    first, *_ = data.bags()
    assert len(scored(score_recordings([first, data.path, first], SETTINGS))) == N_BAGS


def test_reference_that_is_scored_itself_is_counted(data: Dataset) -> None:
    reference = make_reference(np.random.default_rng(7))
    record(data, reference[0])
    run = score_recordings([data.path], SETTINGS, reference)
    list(run)
    assert run.counts.n_in_reference == 1


def test_bad_reference_and_bad_workers_are_refused_before_anything_is_read(
    data: Dataset,
) -> None:
    with pytest.raises(EpisodeError, match="there twice"):
        score_recordings([data.path], SETTINGS, [REFERENCE[0]] * 2)
    with pytest.raises(ConfigError, match="slurm"):
        score_recordings([data.path], SETTINGS, backend="slurm")
    with pytest.raises(ConfigError, match="into one dataset, found 2 paths"):
        score_recordings([data.path, data.path], SETTINGS, write=True)
    with pytest.raises(CurationError, match="no folder 'episodes'"):
        score_recordings([next(data.bags())], SETTINGS, write=True)


def test_progress_wraps_every_bag_once(data: Dataset) -> None:
    for settings in (SETTINGS, BEST_HALF):
        passed = []

        def bar(results: Iterable[Examined], passed: list[Path] = passed) -> Iterator[Examined]:
            for one in results:
                passed.append(one.path)
                yield one

        run = score_recordings([data.path], settings, REFERENCE)
        assert len(scored(run.run(bar))) == N_BAGS
        assert passed == list(data.bags())


# --- logging ------------------------------------------------------------------------------------


def test_written_decisions_are_logged_and_those_of_before_are_replaced(data: Dataset) -> None:
    first = scored(score_recordings([data.path], SETTINGS, REFERENCE, write=True))
    assert all(one.is_logged and one.replaced is None for one in first)
    decided = data.latest_decisions()
    assert {one.decision.episode: one.decision for one in first} == decided
    run = score_recordings([data.path], SETTINGS, REFERENCE, write=True)
    assert not any(one.is_logged for one in scored(run))
    assert data.latest_decisions() == decided
    run = score_recordings([data.path], replace(SETTINGS, rule="none"), REFERENCE, write=True)
    assert {one.replaced for one in scored(run)} == {"keep", "discard"}
    assert run.counts.replaced == {("keep", "review"): 6, ("discard", "review"): 2}


def test_stopped_run_has_logged_what_it_has_given(data: Dataset) -> None:
    run = iter(score_recordings([data.path], SETTINGS, REFERENCE, write=True))
    given = [next(run), next(run), next(run)]
    assert {one.path.name for one in given} == set(data.decided_ids())


def test_person_s_decision_stays_in_force_with_the_scores_of_now(data: Dataset) -> None:
    person = log_override(data, "pick-0", "discard", "no", "Ada")
    run = score_recordings([data.path], SETTINGS, REFERENCE, write=True)
    [one] = [one for one in scored(run) if one.decision.name == "pick-0"]
    assert (one.decision.verdict, one.decision.by) == ("discard", "Ada")
    assert person.scores == {}
    assert one.decision.scores == one.examination.scores
    assert one.is_logged
    assert run.counts.overridden == []


def test_bag_under_another_name_is_scored_and_not_logged(data: Dataset) -> None:
    bag = next(data.bags())
    moved = bag.rename(bag.with_name(new_episode_id()))
    results = scored(score_recordings([data.path], SETTINGS, REFERENCE, write=True))
    [one] = [one for one in results if one.path == moved]
    assert not one.is_logged
    assert one.warning.startswith(f"{moved}: not logged: its folder is not named after")
    assert len(data.decided_ids()) == N_BAGS - 1


# --- people -------------------------------------------------------------------------------------


def test_what_a_person_decided_otherwise_is_named(data: Dataset) -> None:
    kept, dropped = (log_override(data, f"pick-{k}", "keep", "", "Ada") for k in (0, 3))
    run = score_recordings([data.path], SETTINGS, REFERENCE)
    overridden = {one.decision.name: one.overridden_by for one in scored(run)}
    assert kept.verdict == "keep"
    assert {name: held for name, held in overridden.items() if held} == {"pick-3": dropped}
    assert [one.decision.name for one in run.counts.overridden] == ["pick-3"]
    assert run.counts.verdicts["discard"] == 2


def test_dataset_is_not_opened_for_every_row(
    data: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = []

    class Counted(Dataset):
        def __init__(self, path: Path) -> None:
            opened.append(path)
            super().__init__(path)

    monkeypatch.setattr(module, "Dataset", Counted)
    assert len(scored(score_recordings([data.path], SETTINGS, REFERENCE))) == N_BAGS
    assert len(opened) == 1


# --- the dataset --------------------------------------------------------------------------------


def test_copy_of_an_episode_is_found_whatever_it_is_called(data: Dataset) -> None:
    original = make_episode(np.random.default_rng(5), episode_id=new_episode_id(), name="first")
    record(data, original)
    record(data, replace(original, id=new_episode_id(), name="again"))
    found = [one.decision for one in scored(score_recordings([data.path], SETTINGS, REFERENCE))]
    copies = [d for d in found if any(f.id == "duplicate" for f in d.findings)]
    assert [(d.name, d.verdict) for d in copies] == [("again", "review")]
    assert copies[0].reason == f"duplicate: same content as episode {original.id}"


def test_share_is_of_the_trusted_episodes_and_final(data: Dataset) -> None:
    broken = make_episode(np.random.default_rng(5), name="broken")
    shutil.copytree(record(data, broken), data.bag_path(new_episode_id()))
    found = [one.decision for one in scored(score_recordings([data.path], BEST_HALF))]
    assert {d.evidence["basis"] for d in found} == {"final"}
    assert {d.evidence["fitted_on"]["episodes"] for d in found} == {N_BAGS + 1}
    assert len({d.evidence["fitted_on"]["hash"] for d in found}) == 1
    assert sum(d.verdict == "discard" for d in found) == 4  # half of 9 are 5, rounded half up
    for decision in found:
        reasons = {"wrong-id", "opened-early"} & {f.id for f in decision.findings}
        assert (decision.verdict == "review") <= bool(reasons), decision


def test_known_bags_are_counted_also_where_all_are_read_twice(data: Dataset) -> None:
    first, second = (score_recordings([data.path], BEST_HALF) for _ in range(2))
    assert not any(one.is_known for one in scored(first))
    assert all(one.is_known for one in scored(second))


def test_equal_scores_are_drawn_by_the_start_with_and_without_writing(tmp_path: Path) -> None:
    data = Dataset(tmp_path / "equal", create=True)
    rng = np.random.default_rng(1)
    for k in range(6):
        episode = make_episode(rng, name=f"pick-{k}")
        record(data, episode)
        data.append_truth({"episode": episode.id, "task": "t", "start": f"s{k}", "repetition": 0})
    settings = CurationSettings(
        scorers=("gripper_timing",), rule="top-k", rule_params={"value": 2}
    )
    for write in (False, True):
        results = scored(score_recordings([data.path], settings, write=write))
        assert len({one.decision.scores["gripper_timing"] for one in results}) == 1
        kept = {one.decision.episode for one in results if one.decision.verdict == "keep"}
        assert kept == set(sorted((bag.name for bag in data.bags()), key=data.tie(0))[:2])


def test_twins_are_fitted_on_the_bags_that_are_scored(data: Dataset) -> None:
    settings = CurationSettings(
        scorers=("knn_label_free", "length"), rule="none", rule_scorer="length"
    )
    curation = Curation.fit(settings)
    run = Scoring(list(data.bags()), curation)
    assert all(one.examination.scores["knn_label_free"] for one in scored(run))
    assert run.curation.scorers.dataset_ids == tuple(sorted(b.name for b in data.bags()))
    assert curation.scorers.dataset_ids == ()


def test_deciding_on_a_dataset_gives_what_is_new(data: Dataset) -> None:
    curation = Curation.fit(BEST_HALF)
    fitted, new = decide_dataset(data, curation)
    assert [d.episode for d in new] == data.decided_ids()
    assert fitted.scorers.scoring_hash == curation.scorers.scoring_hash
    assert decide_dataset(data, curation)[1] == []
    record(data, make_episode(np.random.default_rng(99), 100, name="short"))
    changed = decide_dataset(data, curation)[1]
    assert "short" in {d.name for d in changed}
