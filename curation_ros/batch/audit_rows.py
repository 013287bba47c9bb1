"""The row of an audit: what the scores of one scorer detect, and how much of that is length."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from curation_ros.batch.published import TABLE_1
from curation_ros.core.statistics import detection, length_confound
from curation_ros.core.statistics.rank_correlation import rank_correlation
from curation_ros.core.types import Floats, JsonObject, Mask

#: Beginning of every note on a question that the data cannot answer.
NOT_IDENTIFIABLE = "not identifiable"
#: Keys that are null unless the scores answer their question.
_OPEN = (
    *("auroc_within_length", "p_label_length_held"),
    *("spearman_within_label", "p_length_label_held"),
    *("n_kept", "precision", "clean_recall", "tied_at_cut", "purity_ceiling"),
)


@dataclass(frozen=True)
class ScorerScores:
    """Scores of one scorer, None where it abstained.

    Attributes:
        raw: of whole episodes.
        controlled: with length controlled.
        reasons: why it abstained with length controlled, one per abstention.
    """

    raw: list[float | None]
    controlled: list[float | None]
    reasons: list[str]


@dataclass(frozen=True)
class RowMaker:
    """Computes rows from scores.

    Attributes:
        good: (n,) whether the episode is good; these are labels.
        lengths: (n,) number of steps.
        starts: (n,) task and start state.
        separates: whether length alone separates the labels.
        keep: share of the scored episodes to keep (a float), or their number (an int).
        n_permutations: number of permutations in each test.
        n_resamples: number of draws of the bootstrap over starts.
        seed: seed of permutations and bootstrap.
    """

    good: Mask
    lengths: Floats
    starts: Sequence[tuple[str, str]]
    separates: bool
    keep: float | int
    n_permutations: int
    n_resamples: int
    seed: int

    def row(self, name: str, scores: ScorerScores) -> JsonObject:
        """All values of one scorer; a null has a note that gives the reason.

        Args:
            name: of the scorer.
            scores: one per episode, in the order of the attributes.
        """
        notes: list[str] = []
        raw, chosen = _scored(scores.raw), _scored(scores.controlled)
        n_abstained = int((~chosen).sum())
        if n_abstained:
            [(why, _)] = Counter(scores.reasons).most_common(1)
            who = "all" if n_abstained == len(chosen) else str(n_abstained)
            notes.append(f"{who} abstained: {why}")
        paper = TABLE_1.get(name)
        row: JsonObject = {
            **self._auroc(scores.raw, raw, ("auroc_raw", "ci_raw")),
            **self._auroc(scores.controlled, chosen, ("auroc_controlled", "ci")),
            "ci_starts": None,
            "pauroc": None,
            **self._correlation(scores.raw, raw, "spearman_length"),
            **self._correlation(scores.controlled, chosen, "spearman_length_controlled"),
            **dict.fromkeys(_OPEN),
            "n_scored": int(chosen.sum()),
            "abstained": n_abstained,
            "abstained_raw": int((~raw).sum()),
            "paper": None if paper is None else paper.to_json(),
        }
        if row["auroc_controlled"] is None:
            if n_abstained < len(chosen):
                notes.append("the episodes with a score are all good or all bad")
        else:
            values = _values(scores.controlled)
            row |= self._kept(values, chosen, notes)
            row |= self._over_starts(values, chosen, notes)
            row |= self._label_test(values, chosen, notes)
            row |= self._length_test(values, chosen, notes)
        return {**row, "notes": notes}

    def _auroc(
        self, scores: Sequence[float | None], chosen: Mask, keys: tuple[str, str]
    ) -> JsonObject:
        good = self.good[chosen]
        if not 0 < good.sum() < len(good):
            return dict.fromkeys(keys)
        estimate = detection.auroc(_values(scores), good)
        interval = detection.auroc_interval(estimate, int(good.sum()), int((~good).sum()))
        return dict(zip(keys, (estimate, list(interval)), strict=True))

    def _correlation(self, scores: Sequence[float | None], chosen: Mask, key: str) -> JsonObject:
        found = rank_correlation(_values(scores), self.lengths[chosen])
        return dict(zip((key, f"{key}_p"), found or (None, None), strict=True))

    def _kept(self, values: Floats, chosen: Mask, notes: list[str]) -> JsonObject:
        """The top of the ranking: what is kept, and the partial AUROC."""
        good = self.good[chosen]
        # As `curation select` rounds.
        n_kept = (
            self.keep
            if isinstance(self.keep, int)
            else max(1, math.floor(self.keep * len(good) + 0.5))
        )
        found: JsonObject = {"pauroc": detection.partial_auroc(values, good)}
        if n_kept > len(good):
            notes.append(f"cannot keep {n_kept}: {len(good)} have a score")
            return found
        kept = detection.evaluate_kept(values, good, n_kept, n_good=int(self.good.sum()))
        return {
            **found,
            "n_kept": n_kept,
            "precision": kept.precision,
            "clean_recall": kept.clean_recall,
            "tied_at_cut": kept.tied_at_cut,
            "purity_ceiling": kept.purity_ceiling,
        }

    def _over_starts(self, values: Floats, chosen: Mask, notes: list[str]) -> JsonObject:
        """The interval that takes a start state as the unit."""
        starts = [s for s, c in zip(self.starts, chosen, strict=True) if c]
        interval = detection.auroc_interval_over_clusters(
            values, self.good[chosen], starts, seed=self.seed, n_resamples=self.n_resamples
        )
        if interval is not None:
            return {"ci_starts": list(interval)}
        if len(set(starts)) < len(starts):
            notes.append("the bootstrap over starts gives one value throughout: see ci")
        return {}

    def _label_test(self, values: Floats, chosen: Mask, notes: list[str]) -> JsonObject:
        """The association with the labels at equal length."""
        if self.separates:
            notes.append(f"{NOT_IDENTIFIABLE} at equal length: length separates the labels")
            return {}
        strata = length_confound.length_strata(self.lengths[chosen])
        within = length_confound.label_test_within(
            values, self.good[chosen], strata, seed=self.seed, n_permutations=self.n_permutations
        )
        if within is None:
            notes.append(f"{NOT_IDENTIFIABLE} at equal length: no stratum holds both labels")
            return {}
        return {"auroc_within_length": within.value, "p_label_length_held": within.p}

    def _length_test(self, values: Floats, chosen: Mask, notes: list[str]) -> JsonObject:
        """The association with length among episodes of one label."""
        within = length_confound.correlation_test_within(
            values,
            self.lengths[chosen],
            self.good[chosen],
            seed=self.seed,
            n_permutations=self.n_permutations,
        )
        if within is None:
            notes.append("within a label, the score or the length does not vary")
            return {}
        return {"spearman_within_label": within.value, "p_length_label_held": within.p}


def _scored(scores: Sequence[float | None]) -> Mask:
    """(n,) whether the episode has a score."""
    return np.array([s is not None for s in scores], dtype=np.bool_)


def _values(scores: Sequence[float | None]) -> Floats:
    """(k,) the scores that there are."""
    return np.array([s for s in scores if s is not None], dtype=np.float64)
