"""Audits: how well the scores of a dataset tell good from bad, by the labels in its truth.

Labels meet scores only here. Episodes are scored first, by scorers that are fitted on a reference
or on the unlabelled dataset. The scores are then compared with the labels. The one exception is
the length control `shortest-success`, which uses labels and declares it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from curation_ros.batch.audit_length import LENGTHS, AuditLength, choose_length
from curation_ros.batch.audit_rows import NOT_IDENTIFIABLE, RowMaker, ScorerScores
from curation_ros.batch.published import TABLE_1
from curation_ros.configuration import read_reference
from curation_ros.core.decision.fitted_scorers import FittedScorers, fit_scorers
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.evidence.length_control import LengthControl
from curation_ros.core.scorers import SCORERS, Scorer
from curation_ros.core.scorers.length import Length
from curation_ros.core.statistics.length_confound import separates
from curation_ros.core.types import Floats, JsonObject, Mask
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episodes
from curation_ros.dataset.labels import LABELS, read_labels

#: Rows of length alone, the baselines of the confound: name -> scorer.
_LENGTH_ROWS = {"length": Length(), "length_path": Length(of="path")}


@dataclass(frozen=True)
class AuditSettings:
    """What to audit.

    Attributes:
        labels: one of LABELS.
        scorers: names of scorers. Rows of length alone are always added.
        scorer_params: scorer -> its hyper-parameters.
        length: one of LENGTHS, or empty for the default of `choose_length`.
        length_value: value of the length control, for modes that take one.
        keep: share of the scored episodes to keep (a float), or their number (an int).
        n_permutations: number of permutations in each test.
        n_resamples: number of draws of the bootstrap over starts.
        seed: seed of permutations and bootstrap.

    Raises:
        ConfigError: if a name does not exist or a number is out of range.
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
        is_number = isinstance(self.keep, int)
        if not (self.keep >= 1 if is_number else 0 < self.keep <= 1):
            raise ConfigError(
                f"keep {self.keep!r}: expected a share above 0 and up to 1 with a decimal point, "
                "or a number of episodes"
            )
        for name in ("n_permutations", "n_resamples"):
            if getattr(self, name) < 1:
                raise ConfigError(f"{name} {getattr(self, name)}: expected at least 1")
        if self.length and self.length not in LENGTHS:
            raise ConfigError(f"length {self.length!r} is none of {', '.join(LENGTHS)}")


@dataclass(frozen=True)
class Audit:
    """The result of an audit.

    Attributes:
        rows: one per scorer; docs/audit.md explains the keys.
        facts: what holds for all rows; every row contains it.
        notes: what a reader must know about all rows.
        problems: a line about each bag that could not be read.
    """

    rows: tuple[JsonObject, ...]
    facts: Mapping[str, Any]
    notes: tuple[str, ...]
    problems: tuple[str, ...] = ()

    def to_json(self) -> Iterator[JsonObject]:
        """The lines of `curation audit --json`."""
        for row in self.rows:
            yield {**row, "notes": [*row["notes"], *self.notes]}


def audit_dataset(
    dataset: Dataset,
    reference: Sequence[Path] = (),
    settings: AuditSettings | None = None,
    topic_map: TopicMap | None = None,
) -> Audit:
    """Read a dataset and its reference, and audit the scores.

    Args:
        dataset: the dataset to audit.
        reference: datasets or bags of trusted demonstrations.
        settings: what to audit.
        topic_map: how episodes are built; by default the map in each bag.

    Raises:
        ConfigError: if the settings do not fit each other.
        CurationError: if the reference cannot be used, or the labels are all of one kind.
    """
    trusted = read_reference(reference, topic_map) if reference else []
    episodes, problems = read_episodes(dataset, topic_map)
    try:
        audited = audit(dataset, episodes, trusted, settings)
    except EpisodeError as err:
        if not problems:
            raise
        unread = f"{len(problems)} bags cannot be read, such as {problems[0]}"
        raise EpisodeError(f"{err}; {unread}") from err
    return replace(audited, problems=tuple(problems))


def audit(
    dataset: Dataset,
    episodes: Iterable[Episode],
    reference: Iterable[Episode] = (),
    settings: AuditSettings | None = None,
) -> Audit:
    """Score episodes raw and with their length controlled, and compare with the labels.

    Args:
        dataset: has the labels and the start states.
        episodes: its episodes, in any order.
        reference: trusted episodes. Those that are also in the dataset are not audited.
        settings: what to audit.

    Raises:
        ConfigError: if the settings do not fit each other.
        EpisodeError: if the labels are all of one kind.
    """
    settings = settings or AuditSettings()
    everything = sorted(episodes, key=lambda e: e.id)
    trusted = sorted(reference, key=lambda e: e.id)
    labelled = _Labelled.of(dataset, settings.labels, everything, trusted)
    success = read_labels(dataset, "success")
    length = choose_length(
        settings.length,
        settings.length_value,
        lengths=[len(e) for e in everything],
        success_lengths=[len(e) for e in everything if success.get(e.id)],
        has_reference=bool(trusted),
    )
    raw = _fitted(settings, LengthControl("none"), trusted, everything)
    controlled = _fitted(settings, length.control, trusted, everything)
    scores = _scores(labelled.episodes, raw, controlled)
    facts = _facts(settings, labelled, len(trusted), length, controlled.length)
    maker = RowMaker(
        good=labelled.good,
        lengths=labelled.lengths,
        starts=labelled.starts,
        separates=facts["length_separates"],
        keep=settings.keep,
        n_permutations=settings.n_permutations,
        n_resamples=settings.n_resamples,
        seed=settings.seed,
    )
    rows = {}
    for name in _in_order(scores):
        needs = "nothing" if name in _LENGTH_ROWS else controlled.scorers[name].needs
        row = maker.row(name, scores[name])
        rows[name] = {"scorer": name, "needs": needs, **row, **facts}
    notes = [
        *_label_notes(dataset, settings.labels, labelled, facts),
        *_length_notes(facts, labelled.lengths, rows["length"]["auroc_controlled"]),
    ]
    return Audit(tuple(rows.values()), facts, tuple(notes))


# --- labels -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Labelled:
    """The episodes that are audited.

    Attributes:
        episodes: those with a label that are not in the reference, by id.
        good: (n,) whether they are good.
        lengths: (n,) number of steps.
        starts: (n,) task and start state. An episode with an unknown start has its own.
        n_unlabelled: number of episodes without a label.
        n_in_reference: number of episodes that are also in the reference.
    """

    episodes: Sequence[Episode]
    good: Mask
    lengths: Floats
    starts: Sequence[tuple[str, str]]
    n_unlabelled: int
    n_in_reference: int

    @classmethod
    def of(
        cls,
        dataset: Dataset,
        kind: str,
        everything: Sequence[Episode],
        trusted: Sequence[Episode],
    ) -> _Labelled:
        """Find the episodes to audit.

        Raises:
            EpisodeError: if not both kinds are among them.
        """
        if not everything:
            raise EpisodeError(f"dataset {dataset.path}: it has no episode that can be read")
        labels = read_labels(dataset, kind)
        trusted_ids = {e.id for e in trusted}
        episodes = [e for e in everything if e.id in labels and e.id not in trusted_ids]
        good = np.array([labels[e.id] for e in episodes], dtype=np.bool_)
        n_unlabelled = sum(e.id not in labels for e in everything)
        n_good = int(good.sum())
        if not 0 < n_good < len(good):
            kinds = f"{n_good} good and {len(good) - n_good} bad of {len(everything)} episodes"
            missing = (
                f" ({n_unlabelled} have no such label in truth.jsonl)" if n_unlabelled else ""
            )
            raise EpisodeError(
                f"dataset {dataset.path}: by the labels {kind!r} there are {kinds}{missing}: an "
                "audit compares good with bad, so it needs some of both"
            )
        starts = dataset.truth_log.starts()
        return cls(
            episodes=episodes,
            good=good,
            lengths=np.array([len(e) for e in episodes], dtype=np.float64),
            starts=[starts[e.id][:2] if e.id in starts else ("", e.id) for e in episodes],
            n_unlabelled=n_unlabelled,
            n_in_reference=sum(e.id in trusted_ids for e in everything),
        )


# --- scores -------------------------------------------------------------------------------------


def _fitted(
    settings: AuditSettings,
    control: LengthControl,
    trusted: Sequence[Episode],
    everything: Sequence[Episode],
) -> FittedScorers:
    configured = CurationSettings(
        scorers=settings.scorers,
        rule="none",
        rule_scorer=settings.scorers[0] if settings.scorers else "",
        length=control.mode,
        length_value=control.value,
        scorer_params={k: v for k, v in settings.scorer_params.items() if k in settings.scorers},
    )
    return fit_scorers(configured, trusted).fit_dataset(everything)


def _scores(
    episodes: Sequence[Episode], raw: FittedScorers, controlled: FittedScorers
) -> dict[str, ScorerScores]:
    """Scorer -> its scores of all episodes, each computed once per length control."""
    scores = {name: ScorerScores([], [], []) for name in (*_LENGTH_ROWS, *raw.scorers)}
    for episode in episodes:
        before, _ = raw.score(episode)
        after, why = controlled.score(episode)
        for name, scorer in _LENGTH_ROWS.items():
            before[name], _ = _score(scorer, episode, LengthControl("none"))
            after[name], reason = _score(scorer, episode, controlled.length)
            why.pop(name, None)
            if reason:
                why[name] = reason
        for name, found in scores.items():
            found.raw.append(before[name])
            found.controlled.append(after[name])
            if name in why:
                found.reasons.append(why[name])
    return scores


def _score(scorer: Scorer, episode: Episode, control: LengthControl) -> tuple[float | None, str]:
    """The score, or None and the reason."""
    try:
        return scorer.score(control.apply(episode)), ""
    except EpisodeError as err:  # Abstain is one
        return None, str(err)


def _in_order(names: Iterable[str]) -> list[str]:
    """The rows of the paper in its order, then the others."""
    names = list(names)
    return [n for n in TABLE_1 if n in names] + [n for n in names if n not in TABLE_1]


# --- facts and notes ----------------------------------------------------------------------------


def _facts(
    settings: AuditSettings,
    labelled: _Labelled,
    n_reference: int,
    length: AuditLength,
    fitted: LengthControl,
) -> JsonObject:
    """What holds for all rows."""
    n_good = int(labelled.good.sum())
    return {
        "labels": settings.labels,
        "n_good": n_good,
        "n_bad": len(labelled.good) - n_good,
        "unlabelled": labelled.n_unlabelled,
        "in_reference": labelled.n_in_reference,
        "reference": n_reference,
        "length_control": {
            "mode": length.mode,
            "value": length.value,
            "steps": fitted.describe().get("steps"),
            "needs": length.needs,
        },
        "length_separates": separates(labelled.lengths, labelled.good),
        "keep": settings.keep,
        "permutations": settings.n_permutations,
        "seed": settings.seed,
    }


def _label_notes(
    dataset: Dataset, kind: str, labelled: _Labelled, facts: Mapping[str, Any]
) -> Iterator[str]:
    """Notes on the labels."""
    good, lengths = labelled.good, labelled.lengths
    if facts["length_separates"]:
        spans = [f"{int(x.min())} to {int(x.max())}" for x in (lengths[good], lengths[~good])]
        yield (
            f"{NOT_IDENTIFIABLE}: length alone separates the labels perfectly (good {spans[0]} "
            f"steps, bad {spans[1]}): what a score tells at equal length cannot be asked of "
            "these data"
        )
    if labelled.n_unlabelled:
        yield f"{labelled.n_unlabelled} episodes lack the label {kind!r}: left out"
    if labelled.n_in_reference:
        yield f"{labelled.n_in_reference} episodes are in the reference: left out"
    other = "defect" if kind == "success" else "success"
    others = read_labels(dataset, other)
    pairs = zip(labelled.episodes, good.tolist(), strict=True)
    both = [(is_good, others[e.id]) for e, is_good in pairs if e.id in others]
    n_different = sum(a != b for a, b in both)
    if not both:
        yield f"no episode has the other label, {other!r}"
    elif n_different:
        yield f"the labels {other!r} differ on {n_different} of {len(both)} episodes"
    else:
        yield f"the labels {other!r} say the same of all {len(both)} episodes"


def _length_notes(
    facts: Mapping[str, Any], lengths: Floats, length_auroc: float | None
) -> Iterator[str]:
    """Notes on the length control."""
    control = facts["length_control"]
    if control["mode"] == "none":
        yield "length is not controlled: raw and controlled are the same"
    elif length_auroc not in (None, 0.5):
        n_shorter = int((lengths < control["steps"]).sum())
        yield (
            f"{n_shorter} episodes are shorter than {control['steps']} steps: after control, "
            f"length alone still has an AUROC of {length_auroc:.3f}"
        )
    if control["needs"] == "labels":
        yield "the length control uses labels: for comparison with the paper only"
