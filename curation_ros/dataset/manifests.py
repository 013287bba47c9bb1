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
from curation_ros.core.decision.rules import Rule, given_params, make_rule
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
    chooser = _chooser(rule or ("gap" if scorer else "decisions"), value, method, scorer)
    candidates, state_hash = _candidates(dataset, chooser)
    resolution = find_scorer(scorer)().resolution if is_scorer(scorer) else 0.0
    chosen = select(candidates, chooser, seed=seed, tie=dataset.tie(seed), resolution=resolution)
    used = chooser.params().get(chooser.value_param) if chooser.value_param else None
    now = datetime.now(timezone.utc)
    manifest = Manifest(
        name=name or f"{chooser.name}-{now:%Y%m%dT%H%M%S%f}",
        created_at=now.isoformat(timespec="seconds"),
        dataset=str(dataset.path),
        scorer=scorer,
        rule=chooser.name,
        entries=chosen.entries,
        kept_of=chosen.kept_of,
        rule_params={"value": used, "seed": seed, **({"method": method} if method else {})},
        state_hash=state_hash,
        abstained=chosen.abstained,
        phases=phases_of(dataset, chosen.entries),
    )
    return manifest, dataset.save_manifest(manifest)


def _chooser(name: str, value: float | None, method: str, scorer: str) -> Rule:
    """The rule, if it can select and fits the scorer.

    Raises:
        ConfigError: if not.
    """
    rule = make_rule(name, scorer, given_params(name, value, method))
    check_selects(rule)
    if scorer and not rule.reads_scores:
        raise ConfigError(f"rule {name!r} reads no scores: --scorer {scorer} needs another --rule")
    if rule.reads_scores and not scorer:
        raise ConfigError(f"rule {name!r} reads the scores of a scorer: name one with --scorer")
    return rule


def _candidates(dataset: Dataset, rule: Rule) -> tuple[list[Candidate], str]:
    """All episodes of a dataset, and the hashes of the states that they were decided with.

    Scores are those of the curator's last decision, whatever a person decided.

    Raises:
        ConfigError: if there is no episode, or no logged decision asked the scorer.
    """
    bags = list(dataset.bags())
    if not bags:
        raise ConfigError(f"dataset {dataset.path}: no episode to select from")
    decided = dataset.latest_decisions()
    scored: dict[str, Decision] = {}
    if rule.reads_scores:
        scored = own_decisions(d for bag in bags for d in dataset.decisions(bag.name))
        _check_scored(dataset, rule.scorer, scored)
    names = dict(dataset.names())
    candidates = []
    for episode_id in (bag.name for bag in bags):
        own = scored.get(episode_id)
        candidates.append(
            Candidate(
                episode=episode_id,
                name=names.get(episode_id, ""),
                score=own.scores.get(rule.scorer) if own is not None else None,
                decision=decided.get(episode_id),
                is_trusted=own is None or not untrustworthy(own.findings),
            )
        )
    basis = scored if rule.reads_scores else decided
    return candidates, ",".join(sorted({d.state_hash for d in basis.values()}))


def _check_scored(dataset: Dataset, scorer: str, scored: Mapping[str, Decision]) -> None:
    """Refuse a scorer that no logged decision asked.

    Raises:
        ConfigError: with the command that logs its scores.
    """
    if any(scorer in d.scores for d in scored.values()):
        return
    is_fitted = is_scorer(scorer) and find_scorer(scorer).needs == "reference"
    raise ConfigError(
        f"dataset {dataset.path}: no episode has a logged score of {scorer!r}: run "
        f"curation score {dataset.path} --write --scorers {scorer}"
        + (" --reference DATASET" if is_fitted else "")
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
