"""The self-check finds scorers that read labels, and nothing else."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from decided import decide_on
from episodes import make_episode, make_reference
from peeking import Peeker, path_being_read
from streams import record

from curation_ros.batch.self_check import IDENTITY, flipped, self_check
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import CurationError
from curation_ros.core.scorers import SCORERS, Look
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.decision_log import log_decision, log_override

pytestmark = pytest.mark.slow

TRUTH: dict[str, Any] = {
    "name": "pick-0",
    "outcome": "succeeded",
    "steps": 240,
    "success_step": 220,
    "stage": "RELEASE",
    "aborted": "",
    "task": "t/0",
    "start": "s-1",
    "repetition": 0,
    "expert_seed": 7,
    "defect": "none",
    "button": True,
    "release_fraction": 0.5,
    "remark": None,
}


class Listener(Peeker):
    """Scores by what people have decided."""

    def look(self, episode: Episode) -> Look:
        """1.0 where the last line of the log is a keep."""
        log = Dataset(path_being_read().resolve().parents[1]).decisions(episode.id)
        return Look(float(log[-1].verdict == "keep"))


class Resolver(Peeker):
    """Follows links to the original, if there are any."""

    def look(self, episode: Episode) -> Look:
        """As its parent, from where the bag's own file really is."""
        [file] = path_being_read().glob("*.mcap")
        truth = Dataset(file.resolve().parents[2]).truth()
        return Look(float(truth.get(episode.id, {}).get("outcome") == "succeeded"))


@pytest.fixture
def labelled(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Two good episodes and two early releases, with their truth."""
    for k, open_at in enumerate((-1, -1, 120, 140)):
        episode = make_episode(rng, name=f"pick-{k}", open_at=open_at)
        record(dataset, episode)
        outcome = {"outcome": "succeeded", "defect": "none"}
        if k > 1:
            outcome = {"outcome": "failed", "defect": "early_release"}
        dataset.append_truth({**TRUTH, "episode": episode.id, "name": episode.name, **outcome})
    return dataset


@pytest.fixture
def cheat(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """A scorer among the others that reads labels."""
    monkeypatch.setitem(SCORERS, "cheat", request.param)
    return "cheat"


def _settings(*more: str, **options: Any) -> CurationSettings:
    return CurationSettings(scorers=("gripper_timing", "knn", "length", *more), **options)


def _files(folder: Path) -> Iterator[tuple[str, bytes]]:
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            yield str(path), path.read_bytes()


def test_everything_but_the_identity_is_flipped() -> None:
    other = flipped({"episode": "a", **TRUTH})
    for key, value in {"episode": "a", **TRUTH}.items():
        assert (other[key] == value) == (key in IDENTITY), key
    assert (other["outcome"], other["defect"]) == ("failed", "early_release")
    assert (other["button"], other["success_step"]) == (False, -221)
    json.dumps(other, allow_nan=False)


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("outcome", "failed", "succeeded"),
        ("outcome", "aborted", "not aborted"),
        ("defect", "early_release", "none"),
        ("success_step", None, 0),
        ("aborted", "", "not "),
        ("list", [1], None),
    ],
)
def test_each_label_becomes_another_one(key: str, value: object, expected: object) -> None:
    assert flipped({key: value}) == {key: expected}


def test_scores_and_decisions_are_equal_to_the_last_bit(
    labelled: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    reference = Dataset(tmp_path / "reference", create=True)
    for episode in make_reference(rng, 4):
        record(reference, episode)
        reference.append_truth({"episode": episode.id, "outcome": "succeeded"})
    done = self_check(labelled, CurationSettings(scorers=tuple(SCORERS)), [reference.path])
    assert done.differences == ()
    assert (done.episodes, done.unreadable, done.overrides) == (4, 0, 0)
    assert done.labels == 4 * (len(TRUTH) - len(IDENTITY) + 1) + 4
    abstaining = sum(kind.needs == "dataset" for kind in SCORERS.values())  # of one start
    assert done.scores >= 4 * (len(SCORERS) - abstaining)


@pytest.mark.parametrize(
    ("rule", "value"), [("threshold", None), ("top-fraction", 0.5), ("top-k", 2)]
)
def test_rules_that_look_at_the_dataset_are_checked(
    labelled: Dataset, rule: str, value: float | None
) -> None:
    params = {} if value is None else {"value": value}
    done = self_check(labelled, _settings(rule=rule, rule_params=params))
    assert (done.differences, done.episodes) == ((), 4)


def test_nothing_is_written_to_the_dataset(labelled: Dataset, rng: np.random.Generator) -> None:
    before = dict(_files(labelled.path))
    self_check(labelled, _settings())
    assert dict(_files(labelled.path)) == before


@pytest.mark.parametrize("cheat", [Peeker], indirect=True)
def test_scorer_that_reads_the_truth_is_found(labelled: Dataset, cheat: str) -> None:
    done = self_check(labelled, _settings(cheat))
    scores = [d for d in done.differences if d.field == "score/cheat"]
    assert len(scores) == 4
    assert {(d.original, d.flipped) for d in scores} == {("1.0", "0.0"), ("0.0", "1.0")}
    assert {d.name for d in scores} == {f"pick-{k}" for k in range(4)}
    assert not [d for d in done.differences if d.field == "score/knn"]


@pytest.mark.parametrize("cheat", [Peeker], indirect=True)
def test_verdict_that_rests_on_the_truth_is_found(labelled: Dataset, cheat: str) -> None:
    done = self_check(
        labelled,
        _settings(cheat, rule="threshold", rule_scorer=cheat, rule_params={"threshold": 0.5}),
    )
    fields = {d.field for d in done.differences}
    assert {"verdict", "reason", "score/cheat"} <= fields


@pytest.mark.parametrize("cheat", [Resolver], indirect=True)
def test_link_does_not_lead_back_to_the_unchanged_labels(labelled: Dataset, cheat: str) -> None:
    assert self_check(labelled, _settings(cheat)).differences


@pytest.mark.parametrize("cheat", [Listener], indirect=True)
def test_scorer_that_reads_decisions_of_people_is_found(labelled: Dataset, cheat: str) -> None:
    fitted = Curation.fit(_settings())
    for bag in labelled.bags():
        [name] = [n for i, n in labelled.names() if i == bag.name]
        log_decision(labelled, decide_on(fitted, make_episode(episode_id=bag.name, name=name)))
        log_override(labelled, bag.name, "keep", "fine", "Ada")
    done = self_check(labelled, _settings(cheat))
    assert done.overrides == 4
    assert {d.field for d in done.differences} >= {"score/cheat"}


def test_dataset_without_any_label_is_nothing_to_check(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    record(dataset, make_episode(rng))
    with pytest.raises(CurationError, match=r"neither a label in truth\.jsonl nor a decision"):
        self_check(dataset, _settings())


def test_dataset_without_an_episode_is_nothing_to_check(dataset: Dataset) -> None:
    dataset.append_truth({"episode": "gone", "outcome": "failed"})
    with pytest.raises(CurationError, match="no episode that can be scored"):
        self_check(dataset, _settings())


def test_unreadable_bag_is_counted(labelled: Dataset) -> None:
    broken = labelled.bag_path("broken")
    broken.mkdir()
    (broken / "broken_0.mcap").write_bytes(b"")
    done = self_check(labelled, _settings())
    assert (done.unreadable, done.episodes, done.differences) == (1, 4, ())
