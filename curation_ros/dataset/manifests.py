"""Selections over a dataset: from decisions and logged scores to a manifest, and back to data."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import datetime, timezone
from pathlib import Path

from curation_ros.bags.reader import episode_of, open_bag, read_episode
from curation_ros.core.decision.balance import Balance, balance_of, phase_steps
from curation_ros.core.decision.decision import CURATOR, Decision, in_force
from curation_ros.core.decision.selection import Candidate, Entry, Manifest, select
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.types import Span
from curation_ros.dataset.dataset import Dataset


def save_selection(
    dataset: Dataset,
    *,
    rule: str = "",
    value: float | None = None,
    scorer: str = "",
    name: str = "",
    seed: int = 0,
) -> tuple[Manifest, Path]:
    """Select over all bags of a dataset and write the manifest.

    Args:
        dataset: its bags are the candidates, its decision logs have scores and verdicts.
        rule: one of KEEP_RULES; empty: `gap` where a scorer is named, else `decisions`.
        value: what the rule takes.
        scorer: whose scores rank, for the rules that rank.
        name: of the manifest; empty makes one of rule and time.
        seed: of the ties.

    Raises:
        ConfigError: if the rule and its value do not fit, or it ranks and no scorer is named.
        CurationError: if there is no bag, the name is taken, or the scores do not separate.
    """
    rule = rule or ("gap" if scorer else "decisions")
    ranks = rule not in ("decisions", "all")
    if scorer and not ranks:
        raise ConfigError(f"keep rule {rule!r} ranks nothing: --scorer {scorer} needs a --rule")
    if ranks and not scorer:
        raise ConfigError(f"keep rule {rule!r} ranks by a scorer: name one")
    bags = list(dataset.bags())
    if not bags:
        raise ConfigError(f"dataset {dataset.path}: no episode to select from")
    names = dict(dataset.names())
    decided = dataset.latest_decisions()
    scored = {bag.name: _scored(dataset, bag.name) for bag in bags} if ranks else {}
    candidates = [
        Candidate(
            bag.name,
            names.get(bag.name, ""),
            _score(scored.get(bag.name), scorer),
            decided.get(bag.name),
        )
        for bag in bags
    ]
    if ranks and all(c.score is None for c in candidates):
        is_fitted = scorer in SCORERS and SCORERS[scorer].needs == "reference"
        raise ConfigError(
            f"dataset {dataset.path}: no episode has a logged score of {scorer!r}: run "
            f"curation score {dataset.path} --write --scorers {scorer}"
            + (" --reference DATASET" if is_fitted else "")
        )
    resolution = SCORERS[scorer]().resolution if scorer in SCORERS else 0.0
    chosen = select(
        candidates, rule, value, seed=seed, tie=dataset.tie(seed), resolution=resolution
    )
    now = datetime.now(timezone.utc)
    hashes = {d.state_hash for d in (scored if ranks else decided).values() if d is not None}
    manifest = Manifest(
        name=name or f"{rule}-{now:%Y%m%dT%H%M%S%f}",
        created_at=now.isoformat(timespec="seconds"),
        dataset=str(dataset.path),
        scorer=scorer,
        rule=rule,
        entries=chosen.entries,
        kept_of=chosen.kept_of,
        rule_params={"value": value, "seed": seed},
        state_hash=",".join(sorted(hashes)),
        abstained=chosen.abstained,
        phases=phases_of(dataset, chosen.entries),
    )
    return manifest, dataset.save_manifest(manifest)


def phases_of(dataset: Dataset, entries: Iterable[Entry]) -> Balance:
    """How much of each phase the entries of a selection show.

    Of each bag only clock and phase are read: 5 ms, of which opening it is nearly half. Of one
    that cannot be read, or has no phases, they are not known.
    """
    return balance_of((e.episode, _phase_steps(dataset, e.episode, e.span)) for e in entries)


def _phase_steps(dataset: Dataset, episode_id: str, span: Span | None) -> dict[str, int] | None:
    try:
        bag = open_bag(dataset.bag_path(episode_id))
        topic_map = bag.topic_map()
        phases = topic_map.with_role("phase") if topic_map is not None else ()
        if topic_map is None or not phases:
            return None
        return phase_steps(
            episode_of(bag, topic_map.only([topic_map.clock, phases[0].name])), span
        )
    except CurationError:  # who reads it to train on it is told
        return None


def _scored(dataset: Dataset, episode_id: str) -> Decision | None:
    """The curator's last decision: the one whose scores count, whatever a person decided."""
    own = in_force(d for d in dataset.decisions(episode_id) if d.by == CURATOR)
    return own.get(episode_id)


def _score(decision: Decision | None, scorer: str) -> float | None:
    return decision.scores.get(scorer) if decision is not None else None


def read_manifest(path: Path) -> tuple[Manifest, Dataset]:
    """Read a selection and the dataset that it is part of.

    Args:
        path: `<dataset>/selections/<name>.json`; the dataset is found from there, so that it may
            be moved as a whole.

    Raises:
        ConfigError: if it cannot be read or is none.
        CurationError: if it does not lie in a dataset.
    """
    try:
        raw = json.loads(path.read_text())
    except OSError as err:
        raise ConfigError(f"selection {path}: {err.strerror}") from err
    except ValueError as err:
        raise ConfigError(f"selection {path} is not JSON: {err}") from err
    try:
        manifest = Manifest.from_json(raw)
    except ConfigError as err:
        raise ConfigError(f"{path}: {err}") from err
    return manifest, Dataset(path.resolve().parent.parent)


def read_selected(
    manifest: Manifest, dataset: Dataset, topic_map: TopicMap | None = None
) -> list[tuple[Episode, tuple[int, int] | None]]:
    """Episodes of a selection, each with the span to train on (None: the whole).

    Raises:
        BagError: if a bag is missing or cannot be read.
    """
    return [
        (read_episode(dataset.bag_path(entry.episode), topic_map), entry.span)
        for entry in manifest.entries
    ]
