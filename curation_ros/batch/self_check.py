"""Proof that labels are never an input: flip all of them in a copy, and compare the scores.

The dataset is copied twice, with its bags as links. One copy is unchanged. In the other one all
labels and all decisions of people are flipped. Both copies are scored and decided from scratch.
If a single bit differs, something reads labels.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from curation_ros.batch.score import Scoring
from curation_ros.batch.scored import Scored
from curation_ros.configuration import read_reference
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision, Verdict
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import CurationError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.layout import is_dataset
from curation_ros.files import write_atomically

#: Keys of truth.jsonl that identify an episode; ties of scores are broken by them. The values of
#: all other keys are flipped, including unknown ones.
IDENTITY = ("episode", "name", "task", "start", "repetition", "expert_seed")
_OPPOSITE = {"succeeded": "failed", "failed": "succeeded", "none": "early_release"}
_OPPOSITE_VERDICT: dict[Verdict, Verdict] = {
    "keep": "discard",
    "salvage": "discard",
    "review": "keep",
    "discard": "keep",
}


@dataclass(frozen=True)
class Difference:
    """A value that changed with the labels.

    Attributes:
        episode: id of the episode.
        name: its short name.
        field: name of the value.
        original: the value as JSON text.
        flipped: the same with all labels flipped.
    """

    episode: str
    name: str
    field: str
    original: str
    flipped: str

    def to_json(self) -> dict[str, str]:
        """A line of `curation self-check --json`."""
        return {
            "episode": self.episode,
            "name": self.name,
            "field": self.field,
            "original": self.original,
            "turned": self.flipped,
        }


@dataclass(frozen=True)
class SelfCheck:
    """Result of a self-check.

    Attributes:
        labels: number of flipped values in the truth of dataset and reference.
        overrides: number of flipped decisions of people in dataset and reference.
        episodes: number of episodes that were scored and decided in both copies.
        scores: number of scores that were compared.
        unreadable: number of bags that could not be read in either copy.
        differences: what changed; empty if labels are not an input.
    """

    labels: int
    overrides: int
    episodes: int
    scores: int
    unreadable: int
    differences: tuple[Difference, ...]

    def to_json(self) -> dict[str, Any]:
        """The last line of `curation self-check --json`."""
        return {**vars(self), "differences": len(self.differences)}


def self_check(
    dataset: Dataset,
    settings: CurationSettings,
    reference: Sequence[Path] = (),
    topic_map: TopicMap | None = None,
) -> SelfCheck:
    """Score and decide with all labels unchanged, and with all labels flipped.

    Args:
        dataset: the dataset to check; nothing is written to it.
        settings: how to score and decide.
        reference: trusted demonstrations. The labels of those that are datasets are flipped, too.
        topic_map: how episodes are built; by default the map in each bag.

    Raises:
        CurationError: if there is no label to flip, or no episode that can be scored.
    """
    with tempfile.TemporaryDirectory(prefix="curation-self-check-") as folder:
        home = Path(folder)
        plain = _copies(dataset, reference, home / "unchanged", flip=False)
        other = _copies(dataset, reference, home / "flipped", flip=True)
        if not other.labels + other.overrides:
            raise CurationError(
                f"dataset {dataset.path}: there is no label to flip: neither a label in "
                "truth.jsonl nor a decision of a person, here or in the reference"
            )
        before, after = (_score(c, settings, topic_map) for c in (plain, other))
    if not any(before.values()) and not any(after.values()):
        raise CurationError(f"dataset {dataset.path}: no episode that can be scored")
    differences = [
        difference
        for episode_id in sorted(before)
        for difference in _compare(episode_id, before[episode_id], after[episode_id])
    ]
    compared = [i for i in before if before[i] is not None and after[i] is not None]
    return SelfCheck(
        labels=other.labels,
        overrides=other.overrides,
        episodes=len(compared),
        scores=sum(v is not None for i in compared for v in (before[i] or {})["scores"].values()),
        unreadable=sum(before[i] is None and after[i] is None for i in before),
        differences=tuple(differences),
    )


@dataclass(frozen=True)
class _Copies:
    """Copies of a dataset and of its reference, and the number of labels in them."""

    dataset: Dataset
    reference: list[Path]
    labels: int
    overrides: int


def _copies(dataset: Dataset, reference: Sequence[Path], home: Path, *, flip: bool) -> _Copies:
    target = Dataset(home / "dataset", create=True)
    counts = [_copy(dataset, target, flip=flip)]
    trusted = []
    for k, path in enumerate(reference):
        if not is_dataset(path):
            trusted.append(path)
            continue
        copied = Dataset(home / f"reference-{k}", create=True)
        counts.append(_copy(Dataset(path), copied, flip=flip))
        trusted.append(copied.path)
    labels, overrides = (sum(found) for found in zip(*counts, strict=True))
    return _Copies(target, trusted, labels, overrides)


def _copy(source: Dataset, target: Dataset, *, flip: bool) -> tuple[int, int]:
    """Copy bags as links, and truth and decisions unchanged or flipped.

    The results of labels and scores (index, selections, policies) are not copied.

    Returns:
        Number of labels, and number of decisions of people.
    """
    for bag in source.bags():
        shutil.copytree(bag, target.bag_path(bag.name), copy_function=_link)
    truth = source.truth()
    labels = sum(len(set(record) - set(IDENTITY)) for record in truth.values())
    records = [flipped(r) if flip else r for r in truth.values()]
    if records:
        target.truth_log.replace(records)
    overrides = 0
    for episode_id in source.decided_ids():
        decisions = source.decisions(episode_id)
        overrides += sum(d.by != CURATOR for d in decisions)
        copied = [_flipped_decision(d) if flip else d for d in decisions]
        lines = [json.dumps(d.to_json(), allow_nan=False) for d in copied]
        write_atomically(target.decision_log(episode_id), "".join(f"{k}\n" for k in lines))
    return labels, overrides


def _link(source: str, target: str) -> None:
    """Make a hard link, through which the unchanged labels cannot be found."""
    try:
        os.link(source, target)
    except OSError:  # another file system, or one without hard links: a symbolic link
        os.symlink(os.path.abspath(source), target)


def flipped(record: Mapping[str, Any]) -> dict[str, Any]:
    """A line of truth.jsonl with another value under each key that is no part of the identity."""
    return {k: v if k in IDENTITY else _flipped_value(k, v) for k, v in record.items()}


def _flipped_value(key: str, value: object) -> object:
    if isinstance(value, bool):
        return not value
    if isinstance(value, (int, float)):
        return -1 - value
    if isinstance(value, str):
        if key == "defect" and value != "none":
            return "none"
        return _OPPOSITE.get(value, f"not {value}")
    return 0 if value is None else None


def _flipped_decision(decision: Decision) -> Decision:
    if decision.by == CURATOR:
        return decision
    return replace(decision, verdict=_OPPOSITE_VERDICT[decision.verdict])


def _score(
    copies: _Copies, settings: CurationSettings, topic_map: TopicMap | None
) -> dict[str, dict[str, Any] | None]:
    """Bag -> examination and decision as plain data; None if the bag cannot be read."""
    reference = read_reference(copies.reference, topic_map) if copies.reference else []
    curation = Curation.fit(settings, reference)
    bags = list(copies.dataset.bags())
    scoring = Scoring(bags, curation, topic_map=topic_map, fresh=True)
    return {
        result.path.name: {**result.examination.to_json(), **result.decision.to_json()}
        if isinstance(result, Scored)
        else None
        for result in scoring
    }


def _compare(
    episode_id: str, before: dict[str, Any] | None, after: dict[str, Any] | None
) -> list[Difference]:
    """The fields that differ; numbers are compared to the last bit, as JSON shows them exactly."""
    name = str((before or after or {}).get("name", ""))
    if before is None or after is None:
        if before is after:
            return []
        readable = [json.dumps(side is not None) for side in (before, after)]
        return [Difference(episode_id, name, "readable", *readable)]
    found = []
    for key in sorted({*before, *after}):
        pairs = {key: (before.get(key), after.get(key))}
        if key == "scores":
            scorers = sorted({*before[key], *after[key]})
            pairs = {f"score/{s}": (before[key].get(s), after[key].get(s)) for s in scorers}
        for field, pair in pairs.items():
            original, other = (json.dumps(value, sort_keys=True) for value in pair)
            if original != other:
                found.append(Difference(episode_id, name, field, original, other))
    return found
