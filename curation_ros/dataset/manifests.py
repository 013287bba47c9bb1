"""Selections over a dataset: from decisions and logged scores to a manifest, and back to data."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from pathlib import Path

from curation_ros.bags import episode_of, open_bag
from curation_ros.core.decision.balance import Balance, balance_of, phase_steps
from curation_ros.core.decision.decision import Decision, own_decisions, untrustworthy
from curation_ros.core.decision.manifest import Entry, Manifest
from curation_ros.core.decision.rules import given_params, make_rule
from curation_ros.core.decision.selection import Candidate, check_selects, select
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.scorers import find_scorer, is_scorer
from curation_ros.core.types import Span
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode


def save_selection(
    dataset: Dataset,
    *,
    rule: str = "",
    value: float | None = None,
    method: str = "",
    scorer: str = "",
    name: str = "",
    seed: int = 0,
) -> tuple[Manifest, Path]:
    """Select over all bags of a dataset and write the manifest.

    Args:
        dataset: its bags are the candidates; its decision logs hold scores and verdicts.
        rule: one of RULES; empty: `gap` if a scorer is named, else `decisions`.
        value: the threshold, share or number of the rule; None: its default.
        method: how `gap` separates groups; empty: its default.
        scorer: ranks the episodes, for rules that read scores.
        name: of the manifest; empty makes one of rule and time.
        seed: of the order of equal scores.

    Returns:
        The manifest, and the file that it was written to.

    Raises:
        ConfigError: if the rule cannot select, its parameters make no sense, or it reads scores
            and no scorer is named.
        CurationError: if there is no bag, the name is taken, or the rule has no basis.
    """
    rule = rule or ("gap" if scorer else "decisions")
    ruler = make_rule(rule, scorer, given_params(rule, value, method))
    check_selects(ruler)
    if scorer and not ruler.reads_scores:
        raise ConfigError(f"rule {rule!r} reads no scores: --scorer {scorer} needs another --rule")
    if ruler.reads_scores and not scorer:
        raise ConfigError(f"rule {rule!r} reads the scores of a scorer: name one with --scorer")
    bags = list(dataset.bags())
    if not bags:
        raise ConfigError(f"dataset {dataset.path}: no episode to select from")
    decided = dataset.latest_decisions()
    scored: dict[str, Decision] = {}
    if ruler.reads_scores:
        scored = own_decisions(d for bag in bags for d in dataset.decisions(bag.name))
        _check_scored(dataset, scorer, scored)
    names = dict(dataset.names())
    candidates = [
        _candidate(bag.name, names, scorer, decided.get(bag.name), scored.get(bag.name))
        for bag in bags
    ]
    resolution = find_scorer(scorer)().resolution if is_scorer(scorer) else 0.0
    chosen = select(candidates, ruler, seed=seed, tie=dataset.tie(seed), resolution=resolution)
    now = datetime.now(timezone.utc)
    basis = scored if ruler.reads_scores else decided
    hashes = {d.state_hash for d in basis.values()}
    used = ruler.params().get(ruler.value_param) if ruler.value_param else None
    manifest = Manifest(
        name=name or f"{rule}-{now:%Y%m%dT%H%M%S%f}",
        created_at=now.isoformat(timespec="seconds"),
        dataset=str(dataset.path),
        scorer=scorer,
        rule=rule,
        entries=chosen.entries,
        kept_of=chosen.kept_of,
        rule_params={"value": used, "seed": seed, **({"method": method} if method else {})},
        state_hash=",".join(sorted(hashes)),
        abstained=chosen.abstained,
        phases=phases_of(dataset, chosen.entries),
    )
    return manifest, dataset.save_manifest(manifest)


def _check_scored(dataset: Dataset, scorer: str, scored: Mapping[str, Decision]) -> None:
    """Refuse a scorer that no logged decision asked.

    Raises:
        ConfigError: with the command that logs them.
    """
    if any(scorer in d.scores for d in scored.values()):
        return
    is_fitted = is_scorer(scorer) and find_scorer(scorer).needs == "reference"
    raise ConfigError(
        f"dataset {dataset.path}: no episode has a logged score of {scorer!r}: run "
        f"curation score {dataset.path} --write --scorers {scorer}"
        + (" --reference DATASET" if is_fitted else "")
    )


def _candidate(
    episode_id: str,
    names: Mapping[str, str],
    scorer: str,
    decided: Decision | None,
    scored: Decision | None,
) -> Candidate:
    return Candidate(
        episode=episode_id,
        name=names.get(episode_id, ""),
        score=scored.scores.get(scorer) if scored is not None else None,
        decision=decided,
        is_trusted=scored is None or not untrustworthy(scored.findings),
    )


def phases_of(dataset: Dataset, entries: Iterable[Entry]) -> Balance:
    """How much of each phase the entries of a selection show.

    Of each bag only clock and phase are read, which takes 5 ms. The phases of a bag that cannot be
    read, or has none, are unknown.
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
    except CurationError:  # training reads the whole bag, and reports it
        return None


def read_manifest(path: Path) -> tuple[Manifest, Dataset]:
    """Read a selection and the dataset that it is part of.

    Args:
        path: `<dataset>/selections/<name>.json`. The dataset is found from there, so that both
            may be moved together.

    Raises:
        ConfigError: if the file cannot be read, or is not a selection.
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
