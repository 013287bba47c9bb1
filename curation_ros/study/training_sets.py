"""Training sets: the demonstrations that the rows of a study stand for.

Labels are read for the rows that name them (`oracle`, `worst`, `shuffled`, `button`, `more`) and
for facts about a set. No score and no decision of the curator depends on them.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from curation_ros.core.decision.ties import ranking, tie_key
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import EpisodeError
from curation_ros.core.scorers import is_scorer
from curation_ros.core.types import JsonObject, Span
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.labels import read_labels
from curation_ros.study.curated import Curated, phases_shown
from curation_ros.study.pools import Pool, sorted_needs
from curation_ros.study.terms import CONTROLS, DECIDED, Term, parse_row

#: Fewest steps that a random cut leaves: the least that a policy can learn a motion from.
_LEAST_STEPS = 2


@dataclass(frozen=True)
class TrainingSet:
    """The demonstrations of a row in a pool.

    Attributes:
        id: hash of the content; equal sets have equal ids, even under different rows.
        pool: name of the pool.
        row: its name in the plan.
        needs: what somebody must have to make it, sorted.
        bags: folders of the bags, sorted by episode. Each has the span to learn from, in
            nanoseconds from its start stamp, or None for the whole episode.
        n_pool: number of demonstrations from the pool.
        n_good: number of whole demonstrations from the pool that succeeded.
        n_reference: number of demonstrations from the reference.
        n_salvaged: number of demonstrations from the pool of which only a part is used.
        n_more: number of demonstrations from `more`.
        tied: number of equal scores at the cut, between which a hash decided.
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

    def to_json(self, timelines: Mapping[str, Episode]) -> JsonObject:
        """The set as plain data; bags are named by the ids of their episodes.

        Args:
            timelines: id -> episode with at least its phases.
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


@dataclass
class _Content:
    """What the terms of a row hold so far.

    Attributes:
        parts: id of each demonstration from the pool -> the span to learn from; None: all of it.
        others: id of each other demonstration -> its bag.
        needs: of the terms.
        n_reference, n_more: numbers of demonstrations from there.
        tied: of the last term.
    """

    parts: dict[str, Span | None] = field(default_factory=dict)
    others: dict[str, Path] = field(default_factory=dict)
    needs: set[str] = field(default_factory=set)
    n_reference: int = 0
    n_more: int = 0
    tied: int = 0

    def add_parts(self, parts: Mapping[str, Span | None]) -> None:
        """Add demonstrations from the pool; of a known one the longer part is used."""
        for i, span in parts.items():
            known = self.parts.get(i, (0, -1))
            if span is None or (known is not None and span[1] - span[0] > known[1] - known[0]):
                self.parts[i] = span


def training_set(
    pool: Pool,
    row: str,
    reference: Dataset,
    seed: int,
    draw: int = 0,
    *,
    more: Dataset | None = None,
) -> TrainingSet:
    """Find the demonstrations that a row of a study stands for.

    If two terms hold the same demonstration, the longer part of it counts.

    Args:
        pool: the pool to take demonstrations from.
        row: such as `knn@16`, see `curation_ros.study.terms.parse_row`.
        reference: the trusted demonstrations.
        seed: seed of ties and of the controls.
        draw: draw of the controls that name none.
        more: further clean demonstrations, for `more@K`.

    Raises:
        CurationError: if there are fewer demonstrations than the row keeps.
    """
    content = _Content()
    for term in parse_row(row):
        drawn = replace(term, draw=draw) if term.is_drawn else term
        _add_term(content, drawn, pool, reference, seed, more)
    parts = content.parts
    bags = {**content.others, **{i: pool.dataset.bag_path(i) for i in parts}}
    return TrainingSet(
        id=_content_hash(bags, parts),
        pool=pool.name,
        row=row,
        needs=sorted_needs(content.needs),
        bags=tuple((bags[i], parts.get(i)) for i in sorted(bags)),
        n_pool=len(parts),
        n_good=sum(pool.good[i] for i, span in parts.items() if span is None),
        n_reference=content.n_reference,
        n_salvaged=sum(span is not None for span in parts.values()),
        n_more=content.n_more,
        tied=content.tied,
    )


def _add_term(
    content: _Content,
    term: Term,
    pool: Pool,
    reference: Dataset,
    seed: int,
    more: Dataset | None,
) -> None:
    """Add the demonstrations of a term."""
    if term.name == "reference":
        trusted = list(reference.bags())
        content.n_reference = len(trusted)
        content.others |= {bag.name: bag for bag in trusted}
        content.needs.add(CONTROLS["reference"].needs)
    elif term.name == "more":
        further = _further(more, term.keep or 0)
        content.n_more = len(further)
        content.others |= {bag.name: bag for bag in further}
        content.needs.add(CONTROLS["more"].needs)
    elif term.name in DECIDED:
        parts = _decided(pool, term, seed)
        content.add_parts(parts)
        content.needs |= _curated(pool).needs(parts)
    else:
        ids, content.tied = _kept(pool, term, seed)
        content.add_parts(dict.fromkeys(ids))
        if is_scorer(term.name):
            content.needs |= set(pool.needs[term.name])
        else:
            content.needs.add(CONTROLS[term.name].needs)


def _content_hash(ids: Iterable[str], spans: Mapping[str, Span | None]) -> str:
    """Hash of the content of a set; of a whole demonstration only its id is hashed."""
    lines = []
    for i in sorted(ids):
        span = spans.get(i)
        lines.append(i if span is None else f"{i} {span[0]} {span[1]}")
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]


def _further(more: Dataset | None, keep: int) -> list[Path]:
    """The first `keep` further demonstrations that succeeded, by name."""
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
    """Demonstrations of a term that rests on decisions of the curator, each with its span."""
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
    """Ids that a term keeps, and the number of equal scores at the cut."""
    everything = list(pool.episodes)
    if term.name == "everything":
        return everything, 0
    if term.name == "button":
        pressed = _pressed(pool, term.wrong, seed)
        return [i for i in everything if pressed[i]], 0
    if term.name in ("random", "shuffled", "oracle", "worst"):
        labels = _labels(pool, term, seed)
        keep = sum(pool.good.values()) if term.keep is None else term.keep
        order = ranking(labels, lambda i: tie_key(seed, term.name, term.draw, pool.names[i]))
        return order[:keep], 0
    scores = pool.scores[term.name]
    keep = term.keep or 0
    if len(scores) < keep:
        raise EpisodeError(
            f"pool {pool.name!r}: {term.name} has scored {len(scores)} of {len(everything)} "
            f"episodes, cannot keep {keep}"
        )
    tie = pool.dataset.tie(seed)
    # Demonstrations of one start share the first key, so the name is needed as a second one.
    order = ranking(scores, lambda i: (tie(i), tie_key(seed, pool.names[i])))
    last = scores[order[keep - 1]]
    is_split = keep < len(order) and scores[order[keep]] == last
    return order[:keep], sum(score == last for score in scores.values()) if is_split else 0


def _labels(pool: Pool, term: Term, seed: int) -> dict[str, float]:
    """A score of each episode, highest for those that the control keeps first."""
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
    """Id -> whether a person pressed the success button; `wrong` in 100 presses are wrong."""
    n = len(pool.episodes)
    n_wrong = int(n * wrong / 100 + 0.5)
    drawn = np.random.default_rng([seed, wrong, 2]).choice(n, size=n_wrong, replace=False)
    order = sorted(pool.episodes, key=lambda i: pool.names[i])
    mistaken = {order[k] for k in drawn.tolist()}
    return {i: pool.good[i] != (i in mistaken) for i in pool.episodes}
