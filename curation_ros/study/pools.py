"""Pools: the contaminated datasets of a study, scored, audited and decided on.

Labels are read here for the audit and for facts about a pool. No score and no decision of the
curator depends on them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from curation_ros.batch.audit import Audit, AuditSettings, audit
from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import Floats, JsonObject
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_all_episodes
from curation_ros.dataset.labels import read_labels
from curation_ros.study.curated import Curated, compare_with_truth, curate, timeline_of
from curation_ros.study.plan import StudyPlan
from curation_ros.study.terms import DECIDED

#: Number of points that each phase of a trace is resampled to.
POINTS_PER_PHASE = 8


@dataclass
class Pool:
    """A contaminated dataset with its scores.

    Attributes:
        name: name of the pool.
        dataset: holds its bags.
        episodes: ids, sorted.
        names: id -> short name.
        good: id -> whether it succeeded; these are labels.
        scores: scorer -> id -> score; episodes on which the scorer abstained are left out.
        needs: scorer -> what it needs, including its length control.
        audited: rows of `curation audit` on the pool.
        notes: notes of the audit.
        traces: what the report draws of each episode.
        facts: facts about the dataset.
        timelines: id -> episode with only its phases and stamps.
        curated: decisions of the curator; None if no row of the plan uses them.
    """

    name: str
    dataset: Dataset
    episodes: tuple[str, ...]
    names: dict[str, str]
    good: dict[str, bool]
    scores: dict[str, dict[str, float]]
    needs: dict[str, tuple[str, ...]]
    audited: list[JsonObject] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    traces: list[JsonObject] = field(default_factory=list)
    facts: JsonObject = field(default_factory=dict)
    timelines: dict[str, Episode] = field(default_factory=dict)
    curated: Curated | None = None


def score_pool(name: str, dataset: Dataset, reference: Sequence[Episode], plan: StudyPlan) -> Pool:
    """Read and score a pool, audit the scores, and let the curator decide if rows ask for it.

    Args:
        name: name of the pool.
        dataset: holds its bags and their truth.
        reference: trusted demonstrations.
        plan: of the study.

    Raises:
        CurationError: if a bag cannot be read, an outcome is missing, or the audit is refused.
    """
    episodes = read_all_episodes(dataset, f"pool {name!r}")
    good = _outcomes(name, dataset, episodes)
    settings = AuditSettings(
        scorers=plan.scorers,
        length=plan.length,
        length_value=plan.length_value,
        keep=min(plan.keep_for_audit, len(episodes)),
    )
    audited = audit(dataset, episodes, reference, settings)
    fitted = _fitted(plan, audited, reference, episodes)
    terms = [term for term in plan.terms(name) if term.name in DECIDED]
    curated = None
    if terms:
        curated = curate(episodes, sorted({t.margin for t in terms if t.margin is not None}))
    pool = Pool(
        name=name,
        dataset=dataset,
        episodes=tuple(e.id for e in episodes),
        names={e.id: e.name for e in episodes},
        good=good,
        scores=_scores(fitted, episodes),
        needs=_scorer_needs(fitted, str(audited.facts["length_control"]["needs"])),
        audited=list(audited.rows),
        notes=list(audited.notes),
        traces=[_trace(e, good[e.id]) for e in episodes],
        timelines={e.id: timeline_of(e) for e in episodes},
        curated=curated,
    )
    pool.facts = _facts(pool, audited, fitted.scoring_hash)
    return pool


def _outcomes(name: str, dataset: Dataset, episodes: Sequence[Episode]) -> dict[str, bool]:
    """Id -> whether the episode succeeded."""
    good = read_labels(dataset, "success")
    missing = [e.name for e in episodes if e.id not in good]
    if missing:
        raise EpisodeError(f"pool {name!r}: no outcome in truth.jsonl of {', '.join(missing)}")
    return {e.id: good[e.id] for e in episodes}


def _fitted(
    plan: StudyPlan, audited: Audit, reference: Sequence[Episode], episodes: Sequence[Episode]
) -> FittedScorers:
    """The scorers of the plan, fitted with the length control of the audit."""
    control = audited.facts["length_control"]
    mode, value = control["mode"], control["value"]
    if mode == "percentile":  # the audit has taken it from the lengths in the pool
        mode, value = "fixed", control["steps"]
    settings = CurationSettings(
        scorers=plan.scorers,
        rule="none",
        rule_scorer=plan.scorers[0],
        length=mode,
        length_value=value,
    )
    return fit_scorers(settings, reference).fit_dataset(episodes)


def _scores(fitted: FittedScorers, episodes: Iterable[Episode]) -> dict[str, dict[str, float]]:
    """Scorer -> id -> score, without abstentions."""
    scores: dict[str, dict[str, float]] = {scorer: {} for scorer in fitted.scorers}
    for episode in episodes:
        for scorer, score in fitted.score(episode)[0].items():
            if score is not None:
                scores[scorer][episode.id] = score
    return scores


def _scorer_needs(fitted: FittedScorers, length_needs: str) -> dict[str, tuple[str, ...]]:
    """Scorer -> what it needs; a length-controlled one also needs what the control needs."""
    return {
        name: sorted_needs(
            {scorer.needs, length_needs} if scorer.length_controlled else {scorer.needs}
        )
        for name, scorer in fitted.scorers.items()
    }


def sorted_needs(needs: set[str]) -> tuple[str, ...]:
    """Needs in order, without `nothing` unless nothing is needed."""
    return tuple(sorted(needs - {"nothing"})) or ("nothing",)


def _facts(pool: Pool, audited: Audit, scoring_hash: str) -> JsonObject:
    """Facts about a pool; docs/study.md explains the keys."""
    truth = pool.dataset.truth()
    released = {i: int(t["release_step"]) for i, t in truth.items() if "release_step" in t}
    facts: JsonObject = {
        "n": len(pool.episodes),
        "n_good": sum(pool.good.values()),
        "n_starts": len({truth[i]["start"] for i in pool.episodes}),
        "steps": [len(pool.timelines[i]) for i in pool.episodes],
        "release_steps": sorted(released[i] for i in pool.episodes if i in released),
        "length_control": audited.facts["length_control"],
        "phases": list(_phases(pool)),
        "scoring_hash": scoring_hash,
    }
    if pool.curated is not None:
        facts["curator"] = compare_with_truth(pool.curated, pool.good, released, pool.timelines)
    return facts


def _phases(pool: Pool) -> tuple[str, ...]:
    """Names of the phases that the traces show."""
    first = next(iter(pool.timelines.values()), None)
    return first.phase_labels if first is not None else ()


# --- traces -------------------------------------------------------------------------------------


def _trace(episode: Episode, good: bool) -> JsonObject:
    """Object height, effector height and gripper command, with an equal length for each phase.

    The object is the first one of the topic map.

    Raises:
        EpisodeError: if the topic map lacks one of the roles.
    """
    phases = _of_role(episode, "phase", 0)
    n_phases = len(episode.phase_labels)
    curves = {
        "object_height_m": _of_role(episode, "object", 2),
        "effector_height_m": _of_role(episode, "effector", 2),
        "gripper": _of_role(episode, "gripper", 0),
    }
    return {
        "episode": episode.id,
        "name": episode.name,
        "good": good,
        **{key: list(_resampled(curve, phases, n_phases)) for key, curve in curves.items()},
    }


def _of_role(episode: Episode, role: str, column: int) -> Floats:
    """(T,) column of the first field with a role."""
    specs = episode.topic_map.with_role(role)
    if not specs:
        raise EpisodeError(f"episode {episode.name}: its topic map has no field of role {role!r}")
    values: Floats = episode.field(specs[0].name)[:, column]
    return values


def _resampled(values: Floats, phases: Floats, n_phases: int) -> Iterator[float | None]:
    for phase in range(n_phases):
        steps = np.flatnonzero(phases == phase)
        if not len(steps):
            yield from [None] * POINTS_PER_PHASE
            continue
        at = steps[np.linspace(0, len(steps) - 1, POINTS_PER_PHASE).round().astype(int)]
        yield from (round(float(v), 4) for v in values[at])
