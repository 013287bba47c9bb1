"""Pools: the datasets of a study, scored; and the training sets that its rows name.

Labels are read here, for the rows that say so (`oracle`, `worst`, `shuffled`, `button`, `more`)
and for the figures about a set. No score and no decision of the curator sees one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from curation_ros.batch.audit import AuditSettings, audit, read_episodes, read_labels
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.ties import ranking, tie_key
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, CurationError, EpisodeError
from curation_ros.core.scorers import SCORERS
from curation_ros.core.types import Floats, Span
from curation_ros.dataset.dataset import Dataset
from curation_ros.study.curated import (
    Curated,
    curate,
    facts_of,
    phases_alone,
    phases_shown,
)
from curation_ros.study.plan import StudyPlan
from curation_ros.study.terms import CONTROLS, DECIDED, Term, parse_row

if TYPE_CHECKING:
    from curation_ros.study.collect import Collection

#: Points that a phase of a trace is resampled to.
POINTS_PER_PHASE = 8

#: Fewest steps that a random cut leaves: the least that a policy can learn a motion from.
_LEAST_STEPS = 2

Row = dict[str, Any]
Said = Callable[[str], None]


@dataclass(frozen=True)
class TrainingSet:
    """What a row of a study means in a pool.

    Attributes:
        id: hash of what is in it; equal sets have equal ids, whoever made them.
        pool: whose demonstrations.
        row: as the plan has it.
        needs: what somebody must have to make it, sorted.
        bags: folders of the bags, sorted by episode, each with the span to learn from,
            nanoseconds from its start stamp; None: all of it.
        n_pool: how many come from the pool.
        n_good: how many of these that are there as a whole succeeded.
        n_reference: how many come from the reference.
        n_salvaged: how many of the pool are there by a part alone.
        n_more: how many come from `more`.
        tied: how many of equal score a hash decided between, at the cut.
    """

    id: str
    pool: str
    row: str
    needs: tuple[str, ...]
    bags: tuple[tuple[Path, Span | None], ...]
    n_pool: int
    n_good: int
    n_reference: int
    n_salvaged: int = 0
    n_more: int = 0
    tied: int = 0

    def to_json(self, timelines: Mapping[str, Episode]) -> Row:
        """Plain data; bags by their names, which are the episodes' ids.

        Args:
            timelines: id -> episode, its phases at least.
        """
        n_whole = self.n_pool - self.n_salvaged
        spans = {bag.name: list(span) for bag, span in self.bags if span is not None}
        return {
            "pool": self.pool,
            "row": self.row,
            "set": self.id,
            "needs": list(self.needs),
            "n": self.n_pool + self.n_reference + self.n_more,
            "n_pool": self.n_pool,
            "n_good": self.n_good,
            "n_reference": self.n_reference,
            "n_salvaged": self.n_salvaged,
            "n_more": self.n_more,
            "contamination": 1 - self.n_good / n_whole if n_whole else None,
            "tied_at_cut": self.tied,
            "episodes": [bag.name for bag, _ in self.bags],
            **({"spans": spans} if spans else {}),
            "phases": phases_shown([(bag.name, span) for bag, span in self.bags], timelines),
        }


def collect_datasets(
    folder: Path, plan: StudyPlan, *, jobs: int, backend: str, said: Said
) -> tuple[dict[str, Dataset], int]:
    """Collect what is missing of the reference (`reference`), of `more` and of the pools.

    Returns:
        Datasets by name, and how many demonstrations were collected now.

    Raises:
        ConfigError: if a start state is used twice among them and the rollouts.
        CurationError: if one of them cannot be completed.
    """
    from curation_ros.study.collect import collect

    check_starts(plan)
    made, n_new = {}, 0
    for name, settings in plan.collections.items():
        collection = _collection(settings, name)
        problems, n_known, n = [], 0, 0
        for one in collect(folder / name, collection, jobs=jobs, backend=backend):
            n += 1
            n_known += one.is_known
            if one.problem:
                problems.append(f"{one.name}: {one.problem}")
        if problems:
            raise CurationError(f"dataset {folder / name}: {'; '.join(problems)}")
        said(f"dataset {name}: {n} demonstrations, {n_known} of them there before")
        made[name] = Dataset(folder / name)
        n_new += n - n_known
    return made, n_new


def check_starts(plan: StudyPlan) -> None:
    """Complain where demonstrations and rollouts, or two datasets, share a start state.

    Raises:
        ConfigError: naming one that is shared.
    """
    from sim_node.starts import start_names

    used: dict[str, str] = {}
    for name, settings in plan.collections.items():
        for episode in _collection(settings, name).plan().values():
            owner = used.setdefault(episode.start, name)
            if owner != name:
                raise ConfigError(f"start {episode.start} is used by {owner} and by {name}")
    kinds: dict[str, str] = {}
    for stage in plan.stages:
        for start in start_names(stage.starts):
            if start in used:
                raise ConfigError(
                    f"stage {stage.name!r}: start {start} is one of dataset {used[start]!r}"
                )
            if kinds.setdefault(start, stage.kind) != stage.kind:
                raise ConfigError(
                    f"start {start} is used by stages of kind {kinds[start]} and {stage.kind}"
                )


def _collection(settings: Any, name: str) -> Collection:
    from curation_ros.study.collect import Collection

    try:
        return Collection(**settings)
    except TypeError as err:
        raise ConfigError(f"dataset {name!r}: {err}") from err


@dataclass
class Pool:
    """A contaminated dataset with its scores.

    Attributes:
        name: of the pool.
        dataset: where its bags are.
        episodes: ids, sorted.
        names: id -> short name.
        good: id -> whether it succeeded; labels.
        scores: scorer -> id -> score; those that abstained are missing.
        raw_length: id -> steps.
        needs: scorer -> what it needs, its length control included.
        audited: rows of `curation audit` on it.
        notes: of the audit.
        traces: what the report draws of each episode.
        facts: about the dataset.
        timelines: id -> episode, its phases and stamps alone.
        curated: what the curator decides; None where no row of the plan asks for it.
    """

    name: str
    dataset: Dataset
    episodes: tuple[str, ...]
    names: dict[str, str]
    good: dict[str, bool]
    scores: dict[str, dict[str, float]]
    needs: dict[str, tuple[str, ...]]
    audited: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    traces: list[Row] = field(default_factory=list)
    facts: Row = field(default_factory=dict)
    timelines: dict[str, Episode] = field(default_factory=dict)
    curated: Curated | None = None


def score_pool(name: str, dataset: Dataset, reference: Sequence[Episode], plan: StudyPlan) -> Pool:
    """Read and score a pool, and audit the scores.

    Raises:
        CurationError: if a bag cannot be read, an outcome is missing, or the audit is refused.
    """
    episodes, problems = read_episodes(dataset)
    if problems:
        raise CurationError(f"pool {name!r}: {'; '.join(problems)}")
    good = read_labels(dataset, "success")
    missing = [e.name for e in episodes if e.id not in good]
    if missing:
        raise EpisodeError(f"pool {name!r}: no outcome in truth.jsonl of {', '.join(missing)}")
    settings = AuditSettings(
        scorers=plan.scorers,
        length=plan.length,
        length_value=plan.length_value,
        keep=min(plan.keep_for_audit, len(episodes)),
    )
    audited = audit(dataset, episodes, reference, settings)
    control = audited.facts["length_control"]
    mode, value = control["mode"], control["value"]
    if mode == "percentile":  # of the pool itself, as the audit has it
        mode, value = "fixed", control["steps"]
    curation = Curation(
        scorers=plan.scorers,
        rule="none",
        rule_scorer=plan.scorers[0],
        length=mode,
        length_value=value,
    )
    curation.fit(reference).fit_dataset(episodes)
    scores: dict[str, dict[str, float]] = {scorer: {} for scorer in plan.scorers}
    for episode in episodes:
        for scorer, score in curation.score(episode)[0].items():
            if score is not None:
                scores[scorer][episode.id] = score
    by_length = {"nothing", str(control["needs"])}
    truth = dataset.truth()
    released = {i: int(t["release_step"]) for i, t in truth.items() if "release_step" in t}
    timelines = {e.id: phases_alone(e) for e in episodes}
    terms = [term for term in plan.terms(name) if term.name in DECIDED]
    curated = None
    if terms:
        margins = {term.margin for term in terms if term.margin is not None}
        curated = curate(episodes, sorted(margins))
    return Pool(
        name=name,
        dataset=dataset,
        episodes=tuple(e.id for e in episodes),
        names={e.id: e.name for e in episodes},
        good={e.id: good[e.id] for e in episodes},
        scores=scores,
        needs={
            scorer: _needs(
                {curation.scorers_[scorer].needs}
                | (by_length if curation.scorers_[scorer].length_controlled else set())
            )
            for scorer in plan.scorers
        },
        audited=list(audited.rows),
        notes=list(audited.notes),
        traces=[_trace(e, good[e.id]) for e in episodes],
        facts={
            "n": len(episodes),
            "n_good": sum(good[e.id] for e in episodes),
            "n_starts": len({truth[e.id]["start"] for e in episodes}),
            "steps": [len(e) for e in episodes],
            "release_steps": sorted(released[e.id] for e in episodes if e.id in released),
            "length_control": control,
            "scoring_hash": curation.scoring_hash_,
            **(
                {"curator": facts_of(curated, good, released, timelines)}
                if curated is not None
                else {}
            ),
        },
        timelines=timelines,
        curated=curated,
    )


def _needs(found: set[str]) -> tuple[str, ...]:
    return tuple(sorted(found - {"nothing"})) or ("nothing",)


def training_set(
    pool: Pool,
    row: str,
    reference: Dataset,
    seed: int,
    draw: int = 0,
    *,
    more: Dataset | None = None,
) -> TrainingSet:
    """The demonstrations that a row of a study means.

    Where two terms show the same demonstration, the one that shows more of it counts.

    Args:
        pool: whose.
        row: such as `knn@16`, see `curation_ros.study.terms.parse_row`.
        reference: the trusted demonstrations.
        seed: of equal scores and of the controls.
        draw: of the controls that name none.
        more: further clean demonstrations, for `more@K`.

    Raises:
        CurationError: if there are too few to keep.
    """
    chosen: dict[str, Span | None] = {}
    needs: set[str] = set()
    n_reference, n_more, tied = 0, 0, 0
    bags: dict[str, Path] = {}
    for given in parse_row(row):
        term = replace(given, draw=draw) if given.is_drawn else given
        if term.name == "reference":
            needs.add("reference")
            trusted = list(reference.bags())
            n_reference = len(trusted)
            bags |= {bag.name: bag for bag in trusted}
        elif term.name == "more":
            needs.add(CONTROLS["more"].needs)
            further = _further(more, term.keep or 0)
            n_more = len(further)
            bags |= {bag.name: bag for bag in further}
        elif term.name in DECIDED:
            parts = _decided(pool, term, seed)
            needs |= _curated(pool).needs(parts)
            chosen = _united(chosen, parts)
        else:
            ids, tied = _kept(pool, term, seed)
            chosen = _united(chosen, dict.fromkeys(ids))
            needs |= set(
                pool.needs[term.name] if term.name in SCORERS else (CONTROLS[term.name].needs,)
            )
    bags |= {i: pool.dataset.bag_path(i) for i in chosen}
    return TrainingSet(
        id=_content(bags, chosen),
        pool=pool.name,
        row=row,
        needs=_needs(needs),
        bags=tuple((bags[i], chosen.get(i)) for i in sorted(bags)),
        n_pool=len(chosen),
        n_good=sum(pool.good[i] for i, span in chosen.items() if span is None),
        n_reference=n_reference,
        n_salvaged=sum(span is not None for span in chosen.values()),
        n_more=n_more,
        tied=tied,
    )


def _content(ids: Iterable[str], spans: Mapping[str, Span | None]) -> str:
    """Hash of what is in a set; a whole demonstration counts by its id alone."""
    lines = []
    for i in sorted(ids):
        span = spans.get(i)
        lines.append(i if span is None else f"{i} {span[0]} {span[1]}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]


def _united(
    known: Mapping[str, Span | None], new: Mapping[str, Span | None]
) -> dict[str, Span | None]:
    """Demonstrations of both; of one that both have the longer part."""
    found = dict(known)
    for i, span in new.items():
        held = found.get(i, (0, -1))
        if span is None or (held is not None and span[1] - span[0] > held[1] - held[0]):
            found[i] = span
    return found


def _further(more: Dataset | None, keep: int) -> list[Path]:
    """The first of the further demonstrations by name, of those that succeeded."""
    if more is None:
        raise EpisodeError("more: there is no dataset of further demonstrations")
    good = read_labels(more, "success")
    names = {i: str(truth["name"]) for i, truth in more.truth().items()}
    ids = sorted((i for i, is_good in good.items() if is_good), key=lambda i: names[i])
    if len(ids) < keep:
        raise EpisodeError(f"dataset {more.path}: {len(ids)} succeeded, cannot keep {keep}")
    return [more.bag_path(i) for i in ids[:keep]]


def _curated(pool: Pool) -> Curated:
    if pool.curated is None:
        raise EpisodeError(f"pool {pool.name!r}: the curator has not decided on it")
    return pool.curated


def _decided(pool: Pool, term: Term, seed: int) -> dict[str, Span | None]:
    """What a term of the curator's decisions holds, each with its span."""
    curated = _curated(pool)
    if term.name == "decided":
        return dict.fromkeys(curated.ids("keep"))
    if term.name == "salvaged":
        return dict(curated.prefixes[term.margin])
    rng = np.random.default_rng([seed, term.draw or 0, 3])
    cut: dict[str, Span | None] = {}
    for i in sorted(curated.prefixes[None], key=lambda i: pool.names[i]):
        episode = pool.timelines[i]
        cut[i] = episode.span(0, int(rng.integers(_LEAST_STEPS - 1, len(episode))))
    return cut


def _kept(pool: Pool, term: Term, seed: int) -> tuple[list[str], int]:
    """Ids that a term keeps, and how many were tied at the cut."""
    everybody = list(pool.episodes)
    if term.name == "everything":
        return everybody, 0
    if term.name == "button":
        pressed = _pressed(pool, term.wrong, seed)
        return [i for i in everybody if pressed[i]], 0
    if term.name in ("random", "shuffled", "oracle", "worst"):
        labels = _labels(pool, term, seed)
        keep = sum(pool.good.values()) if term.keep is None else term.keep
        order = ranking(labels, lambda i: tie_key(seed, term.name, term.draw, pool.names[i]))
        return order[:keep], 0
    scores = pool.scores[term.name]
    keep = term.keep or 0
    if len(scores) < keep:
        raise EpisodeError(
            f"pool {pool.name!r}: {term.name} has scored {len(scores)} of {len(everybody)} "
            f"episodes, cannot keep {keep}"
        )
    tie = pool.dataset.tie(seed)
    # A clean and a defective demonstration of one start have one key; their names tell them apart.
    order = ranking(scores, lambda i: (tie(i), tie_key(seed, pool.names[i])))
    last = scores[order[keep - 1]]
    equal = [i for i in order if scores[i] == last]
    split = scores[order[keep]] == last if keep < len(order) else False
    return order[:keep], len(equal) if split else 0


def _labels(pool: Pool, term: Term, seed: int) -> dict[str, float]:
    """A score of each episode that puts first what the control keeps."""
    if term.name == "random":
        return dict.fromkeys(pool.episodes, 0.0)
    order = sorted(pool.episodes, key=lambda i: pool.names[i])
    good = np.array([pool.good[i] for i in order], dtype=np.float64)
    if term.name == "shuffled":
        good = np.random.default_rng([seed, term.draw or 0, 1]).permutation(good)
    if term.name == "worst":
        good = -good
    return dict(zip(order, good.tolist(), strict=True))


def _pressed(pool: Pool, wrong: int, seed: int) -> dict[str, bool]:
    """What a person's button says: exactly so many presses in a hundred are wrong."""
    n = len(pool.episodes)
    n_wrong = int(n * wrong / 100 + 0.5)
    drawn = np.random.default_rng([seed, wrong, 2]).choice(n, size=n_wrong, replace=False)
    order = sorted(pool.episodes, key=lambda i: pool.names[i])
    mistaken = {order[k] for k in drawn.tolist()}
    return {i: pool.good[i] != (i in mistaken) for i in pool.episodes}


def _trace(episode: Episode, good: bool) -> Row:
    """Object height, effector height and gripper command, each phase resampled to equal length."""
    phases = episode.fields["phase"][:, 0]
    heights = {
        "object_height_m": episode.fields["bowl_position"][:, 2],
        "effector_height_m": episode.fields["eef_position"][:, 2],
        "gripper": episode.fields["gripper"][:, 0],
    }
    return {
        "episode": episode.id,
        "name": episode.name,
        "good": good,
        **{key: list(_resampled(values, phases)) for key, values in heights.items()},
    }


def _resampled(values: Floats, phases: Floats) -> Iterator[float | None]:
    for phase in range(6):
        steps = np.flatnonzero(phases == phase)
        if not len(steps):
            yield from [None] * POINTS_PER_PHASE
            continue
        at = steps[np.linspace(0, len(steps) - 1, POINTS_PER_PHASE).round().astype(int)]
        yield from (round(float(v), 4) for v in values[at])
