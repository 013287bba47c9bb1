"""Audits: how well the scores of a dataset tell good from bad, by the labels in its truth.

Labels meet scores here and nowhere before: episodes are scored first, by curations that are
fitted on a reference or on the unlabelled dataset, and compared with `truth.jsonl` afterwards.
The one exception is the length control `shortest-success`, which says that it uses labels.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.evidence.length_control import MODES, LengthControl
from curation_ros.core.scorers import SCORERS, Scorer
from curation_ros.core.scorers.length import Length
from curation_ros.core.statistics import detection, length_confound
from curation_ros.core.statistics.rank_correlation import rank_correlation
from curation_ros.core.types import Floats, Mask
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.labels import LABELS, read_labels

#: Length control of audits alone: with labels, as the paper has it.
SHORTEST_SUCCESS = "shortest-success"
LENGTHS: dict[str, str] = {
    **MODES,
    "percentile": "the prefix as long as the `value`-th percentile of the lengths in the dataset",
    SHORTEST_SUCCESS: "the prefix as long as the shortest success: the paper's T, uses labels",
}
_LENGTH_NEEDS = {
    "phase-normalised": "phases",
    "shortest-reference": "reference",
    "percentile": "dataset",
    SHORTEST_SUCCESS: "labels",
}
#: Where there is no reference to learn T from.
_LABEL_FREE_LENGTH = ("percentile", 5.0)
#: Rows of length alone, the confound's own baselines: name -> scorer.
_LENGTH_ROWS = {"length": Length(), "length_path": Length(of="path")}

#: Table I of the paper in its order: AUROC raw, truncated to T = 324, and truncated as computed
#: from its released scores with the rows joined by name (the paper joined them by position).
PAPER: dict[str, tuple[float, float, float | None]] = {
    "length_path": (1.000, 0.500, None),
    "ensemble": (1.000, 0.761, 0.952),
    "isolation_forest": (1.000, 0.440, 0.338),
    "knn": (1.000, 0.712, 0.859),
    "trajectory_alignment": (1.000, 0.638, 0.773),
    "smoothness": (0.979, 0.447, 0.391),
    "gripper_timing": (0.957, 0.804, 0.973),
    "entropy": (0.000, 0.280, 0.139),
}


@dataclass(frozen=True)
class AuditSettings:
    """What an audit is asked for.

    Attributes:
        labels: one of LABELS.
        scorers: names in SCORERS; rows of length alone are always there.
        scorer_params: scorer -> its hyper-parameters.
        length: one of LENGTHS; empty takes `shortest-reference`, or without a reference a
            percentile of the dataset's own lengths.
        length_value: its value, for those that take one.
        keep: share of the scored episodes to keep (a float), or their number (an int).
        n_permutations: of each permutation test.
        n_resamples: of the bootstrap over starts.
        seed: of both.
    """

    labels: str = "success"
    scorers: tuple[str, ...] = tuple(SCORERS)
    scorer_params: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    length: str = ""
    length_value: float | None = None
    keep: float | int = 0.75
    n_permutations: int = 9999
    n_resamples: int = 2000
    seed: int = 0

    def __post_init__(self) -> None:
        if self.labels not in LABELS:
            raise ConfigError(f"labels {self.labels!r}: expected one of {', '.join(LABELS)}")
        whole = isinstance(self.keep, int)
        if not (self.keep >= 1 if whole else 0 < self.keep <= 1):
            raise ConfigError(
                f"keep {self.keep!r}: expected a share from 0 to 1 with a point, or a number of "
                "episodes"
            )
        for name in ("n_permutations", "n_resamples"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} {getattr(self, name)}: expected at least 1")
        if self.length and self.length not in LENGTHS:
            raise ConfigError(f"length {self.length!r} is none of {', '.join(LENGTHS)}")


@dataclass(frozen=True)
class Audit:
    """The outcome of an audit.

    Attributes:
        rows: a scorer each, as printed by `curation audit --json`.
        facts: what holds for all rows, as printed in each.
        notes: what a reader must know about all rows.
    """

    rows: tuple[dict[str, Any], ...]
    facts: Mapping[str, Any]
    notes: tuple[str, ...]


def audit(
    dataset: Dataset,
    episodes: Iterable[Episode],
    reference: Iterable[Episode] = (),
    settings: AuditSettings | None = None,
) -> Audit:
    """Score episodes raw and with their length controlled, and compare with the labels.

    Args:
        dataset: where the labels and the start states are.
        episodes: its episodes, in any order.
        reference: trusted episodes; those that are also in the dataset are not audited.
        settings: what to do.

    Raises:
        ConfigError: if the settings do not fit each other, or the labels are of one kind.
    """
    settings = settings or AuditSettings()
    everything = sorted(episodes, key=lambda e: e.id)
    trusted = sorted(reference, key=lambda e: e.id)
    trusted_ids = {e.id for e in trusted}
    labels = read_labels(dataset, settings.labels)
    judged = [e for e in everything if e.id in labels and e.id not in trusted_ids]
    good = np.array([labels[e.id] for e in judged], dtype=np.bool_)
    unlabelled = sum(e.id not in labels for e in everything)
    _check_labels(dataset, settings.labels, everything, good, unlabelled)

    control, mode, value = _length_control(settings, dataset, everything, trusted)
    raw = _fitted(settings, LengthControl("none"), trusted, everything)
    controlled = _fitted(settings, control, trusted, everything)
    lengths = np.array([len(e) for e in judged], dtype=np.float64)
    identifiable = not length_confound.separates(lengths, good)
    noted = dataset.truth_log.starts()
    starts = [_start(noted.get(e.id), e.id) for e in judged]
    other = "defect" if settings.labels == "success" else "success"
    others = read_labels(dataset, other)
    both = [(labels[e.id], others[e.id]) for e in judged if e.id in others]
    facts: dict[str, Any] = {
        "labels": settings.labels,
        "n_good": int(good.sum()),
        "n_bad": int((~good).sum()),
        "unlabelled": unlabelled,
        "in_reference": sum(e.id in trusted_ids for e in everything),
        "reference": len(trusted),
        "length_control": {
            "mode": mode,
            "value": value,
            "steps": controlled.length.describe().get("steps"),
            "needs": _LENGTH_NEEDS.get(mode, "nothing"),
        },
        "length_separates": not identifiable,
        "keep": settings.keep,
        "permutations": settings.n_permutations,
        "seed": settings.seed,
    }
    scores = _scores(judged, raw, controlled)
    table = _Table(settings, good, lengths, starts, identifiable)
    rows = []
    for name in _order(scores):
        needs = "nothing" if name in _LENGTH_ROWS else controlled.scorers[name].needs
        rows.append({"scorer": name, "needs": needs, **table.row(name, scores[name]), **facts})
    [left] = [row["auroc_controlled"] for row in rows if row["scorer"] == "length"]
    notes = _notes(facts, lengths, good, both, other, left)
    return Audit(tuple(rows), facts, tuple(notes))


def _check_labels(
    dataset: Dataset,
    name: str,
    everything: Sequence[Episode],
    good: Mask,
    unlabelled: int,
) -> None:
    if not everything:
        raise EpisodeError(f"dataset {dataset.path}: no episode that can be read")
    n_good = int(good.sum())
    if not 0 < n_good < len(good):
        kinds = f"{n_good} good and {len(good) - n_good} bad of {len(everything)} episodes"
        missing = f" ({unlabelled} have no such label in truth.jsonl)" if unlabelled else ""
        raise EpisodeError(
            f"dataset {dataset.path}: by the labels {name!r} there are {kinds}{missing}: an audit "
            "compares good with bad, so it needs some of both"
        )


def _start(noted: tuple[str, str, int] | None, episode_id: str) -> tuple[str, str]:
    """Task and start state of an episode; one that is unknown is its own."""
    return (noted[0], noted[1]) if noted is not None else ("", episode_id)


def _length_control(
    settings: AuditSettings,
    dataset: Dataset,
    everything: Sequence[Episode],
    trusted: Sequence[Episode],
) -> tuple[LengthControl, str, float | None]:
    """The length control to configure a curation with; mode and value that it stands for."""
    mode, value = settings.length, settings.length_value
    if not mode:
        mode, value = ("shortest-reference", None) if trusted else _LABEL_FREE_LENGTH
    lengths = [len(e) for e in everything]
    if mode == SHORTEST_SUCCESS:
        if value is not None:
            raise ConfigError(f"length control {mode!r} takes no value, found {value!r}")
        success = read_labels(dataset, "success")
        lengths = [len(e) for e in everything if success.get(e.id)]
        if not lengths:
            raise ConfigError(f"length control {mode!r}: no episode of the dataset succeeded")
        return LengthControl("fixed", max(2, min(lengths))), mode, value
    control = LengthControl(mode, value)
    if mode == "percentile":
        steps = int(np.percentile(lengths, float(value or 0.0)))
        return LengthControl("fixed", max(2, steps)), mode, value
    if control.needs_reference and not trusted:
        raise ConfigError(f"length control {mode!r} needs --reference, which was not given")
    return control, mode, value


def _fitted(
    settings: AuditSettings,
    control: LengthControl,
    trusted: Sequence[Episode],
    everything: Sequence[Episode],
) -> FittedScorers:
    curation = CurationSettings(
        scorers=settings.scorers,
        rule="none",
        rule_scorer=settings.scorers[0] if settings.scorers else "",
        length=control.mode,
        length_value=control.value,
        scorer_params={k: v for k, v in settings.scorer_params.items() if k in settings.scorers},
    )
    return fit_scorers(curation, trusted).fit_dataset(everything)


@dataclass(frozen=True)
class _Scores:
    """Scores of one scorer, None where it abstained, with the reasons."""

    raw: list[float | None]
    controlled: list[float | None]
    reasons: list[str]


def _scores(
    judged: Sequence[Episode], raw: FittedScorers, controlled: FittedScorers
) -> dict[str, _Scores]:
    """Every score of every episode, each computed once a length control."""
    found: dict[str, _Scores] = {
        name: _Scores([], [], []) for name in (*_LENGTH_ROWS, *raw.scorers)
    }
    for episode in judged:
        before, _ = raw.score(episode)
        after, why = controlled.score(episode)
        for name, scorer in _LENGTH_ROWS.items():
            before[name], _ = _score(scorer, episode, LengthControl("none"))
            after[name], reason = _score(scorer, episode, controlled.length)
            why.pop(name, None)
            if reason:
                why[name] = reason
        for name, row in found.items():
            row.raw.append(before[name])
            row.controlled.append(after[name])
            if name in why:
                row.reasons.append(why[name])
    return found


def _score(scorer: Scorer, episode: Episode, control: LengthControl) -> tuple[float | None, str]:
    try:
        return scorer.score(control.apply(episode)), ""
    except EpisodeError as err:  # Abstain is one
        return None, str(err)


def _order(names: Iterable[str]) -> list[str]:
    """The rows of the paper in its order, then the others."""
    names = list(names)
    return [n for n in PAPER if n in names] + [n for n in names if n not in PAPER]


@dataclass(frozen=True)
class _Table:
    """Makes rows of figures from scores.

    Attributes:
        settings: what was asked for.
        good, lengths, starts: of the judged episodes, in one order.
        identifiable: whether there is anything to compare at equal length.
    """

    settings: AuditSettings
    good: Mask
    lengths: Floats
    starts: Sequence[tuple[str, str]]
    identifiable: bool

    def row(self, name: str, scores: _Scores) -> dict[str, Any]:
        """All figures of one scorer; null where a question has no answer, with a note."""
        notes: list[str] = []
        raw = self._scored(scores.raw)
        chosen = self._scored(scores.controlled)
        n_abstained = int((~chosen).sum())
        if n_abstained:
            [(why, _)] = Counter(scores.reasons).most_common(1)
            who = "all" if n_abstained == len(chosen) else str(n_abstained)
            notes.append(f"{who} abstained: {why}")
        paper = PAPER.get(name)
        found: dict[str, Any] = {
            **self._auroc(scores.raw, raw, ("auroc_raw", "ci_raw")),
            **self._auroc(scores.controlled, chosen, ("auroc_controlled", "ci")),
            "ci_starts": None,
            "pauroc": None,
            **self._correlation(scores.raw, raw, "spearman_length"),
            **self._correlation(scores.controlled, chosen, "spearman_length_controlled"),
            "auroc_within_length": None,
            "p_label_length_held": None,
            "spearman_within_label": None,
            "p_length_label_held": None,
            "n_kept": None,
            "precision": None,
            "clean_recall": None,
            "tied_at_cut": None,
            "purity_ceiling": None,
            "n_scored": int(chosen.sum()),
            "abstained": n_abstained,
            "abstained_raw": int((~raw).sum()),
            "paper": None
            if paper is None
            else dict(zip(("raw", "truncated", "truncated_joined_by_name"), paper, strict=True)),
        }
        if found["auroc_controlled"] is None:
            if n_abstained < len(chosen):
                notes.append("the episodes with a score are all good or all bad")
        else:
            found |= self._at_the_top(scores.controlled, chosen, notes)
            found |= self._permutations(scores.controlled, chosen, notes)
        return {**found, "notes": notes}

    def _scored(self, scores: Sequence[float | None]) -> Mask:
        return np.array([s is not None for s in scores], dtype=np.bool_)

    def _values(self, scores: Sequence[float | None]) -> Floats:
        return np.array([s for s in scores if s is not None], dtype=np.float64)

    def _auroc(
        self, scores: Sequence[float | None], chosen: Mask, keys: tuple[str, str]
    ) -> dict[str, Any]:
        good = self.good[chosen]
        if not 0 < good.sum() < len(good):
            return dict.fromkeys(keys)
        estimate = detection.auroc(self._values(scores), good)
        interval = detection.auroc_interval(estimate, int(good.sum()), int((~good).sum()))
        return dict(zip(keys, (estimate, list(interval)), strict=True))

    def _correlation(
        self, scores: Sequence[float | None], chosen: Mask, key: str
    ) -> dict[str, Any]:
        found = rank_correlation(self._values(scores), self.lengths[chosen])
        return dict(zip((key, f"{key}_p"), found or (None, None), strict=True))

    def _at_the_top(
        self, scores: Sequence[float | None], chosen: Mask, notes: list[str]
    ) -> dict[str, Any]:
        """What is kept, the partial AUROC, and the interval over starts."""
        values, good = self._values(scores), self.good[chosen]
        keep = self.settings.keep
        # As `curation select` rounds.
        n_kept = keep if isinstance(keep, int) else max(1, math.floor(keep * len(good) + 0.5))
        found: dict[str, Any] = {"pauroc": detection.partial_auroc(values, good)}
        if n_kept > len(good):
            notes.append(f"cannot keep {n_kept}: {len(good)} have a score")
        else:
            kept = detection.evaluate_kept(values, good, n_kept, n_good=int(self.good.sum()))
            found |= {
                "n_kept": n_kept,
                "precision": kept.precision,
                "clean_recall": kept.clean_recall,
                "tied_at_cut": kept.tied_at_cut,
                "purity_ceiling": kept.purity_ceiling,
            }
        starts = [s for s, c in zip(self.starts, chosen, strict=True) if c]
        interval = detection.auroc_interval_over_clusters(
            values,
            good,
            starts,
            seed=self.settings.seed,
            n_resamples=self.settings.n_resamples,
        )
        if interval is not None:
            found["ci_starts"] = list(interval)
        elif len(set(starts)) < len(starts):
            notes.append("the bootstrap over starts gives one value throughout: see ci")
        return found

    def _permutations(
        self, scores: Sequence[float | None], chosen: Mask, notes: list[str]
    ) -> dict[str, Any]:
        """The association with labels, length held, and with length, labels held."""
        values, good = self._values(scores), self.good[chosen]
        lengths = self.lengths[chosen]
        draws = {"seed": self.settings.seed, "n_permutations": self.settings.n_permutations}
        found: dict[str, Any] = {}
        within = None
        if not self.identifiable:
            notes.append("not identifiable at equal length: length separates the labels")
        else:
            strata = length_confound.length_strata(lengths)
            within = length_confound.label_test_within(values, good, strata, **draws)
            if within is None:
                notes.append("not identifiable at equal length: no stratum holds both labels")
        if within is not None:
            found |= {"auroc_within_length": within.value, "p_label_length_held": within.p}
        follows = length_confound.correlation_test_within(values, lengths, good, **draws)
        if follows is None:
            notes.append("within a label, the score or the length does not vary")
        else:
            found |= {"spearman_within_label": follows.value, "p_length_label_held": follows.p}
        return found


def _notes(
    facts: Mapping[str, Any],
    lengths: Floats,
    good: Mask,
    both: Sequence[tuple[bool, bool]],
    other: str,
    left: float | None,
) -> list[str]:
    """What is to be known about all rows, in words."""
    notes = []
    if facts["length_separates"]:
        spans = [f"{int(x.min())} to {int(x.max())}" for x in (lengths[good], lengths[~good])]
        notes.append(
            f"not identifiable: length alone separates the labels perfectly (good {spans[0]} "
            f"steps, bad {spans[1]}): what a score tells at equal length cannot be asked of "
            "these data"
        )
    if facts["unlabelled"]:
        notes.append(
            f"{facts['unlabelled']} episodes lack the label {facts['labels']!r}: left out"
        )
    if facts["in_reference"]:
        notes.append(f"{facts['in_reference']} episodes are in the reference: left out")
    differ = sum(a != b for a, b in both)
    if not both:
        notes.append(f"no episode has the other label, {other!r}")
    elif differ:
        notes.append(f"the labels {other!r} differ on {differ} of {len(both)} episodes")
    else:
        notes.append(f"the labels {other!r} say the same of all {len(both)} episodes")
    control = facts["length_control"]
    if control["mode"] == "none":
        notes.append("length is not controlled: raw and controlled are the same")
    elif left not in (None, 0.5):
        shorter = int((lengths < control["steps"]).sum())
        notes.append(
            f"{shorter} episodes are shorter than {control['steps']} steps: after control, length "
            f"alone still has an AUROC of {left:.3f}"
        )
    if control["needs"] == "labels":
        notes.append("the length control uses labels: for comparison with the paper only")
    return notes
