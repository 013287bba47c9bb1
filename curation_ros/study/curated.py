"""Decisions of the curator on a pool, and how much of each phase a training set shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from statistics import median

import numpy as np

from curation_ros.core.decision.balance import balance_of, phase_steps
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import VERDICTS, Decision
from curation_ros.core.decision.salvage import good_prefix
from curation_ros.core.episode.episode import Episode
from curation_ros.core.scorers import find_scorer, is_scorer
from curation_ros.core.types import JsonObject, Span


def timeline_of(episode: Episode) -> Episode:
    """The episode with only its phases and stamps, so that all of a study fit into memory."""
    names = [spec.name for spec in episode.topic_map.with_role("phase")]
    return replace(episode, fields={name: episode.fields[name] for name in names})


@dataclass(frozen=True)
class Curated:
    """Decisions of the curator with its default configuration and without a reference.

    Attributes:
        decisions: id -> decision.
        prefixes: margin -> id -> good beginning of an episode that broke, in nanoseconds from
            the start stamp. The margin is in control steps. None stands for the curator's own
            margin, and then these are the spans of the salvaged episodes.
        example: the first salvaged episode by name that broke; None if there is none.
    """

    decisions: Mapping[str, Decision] = field(default_factory=dict)
    prefixes: Mapping[int | None, Mapping[str, Span]] = field(default_factory=dict)
    example: Episode | None = None

    def ids(self, verdict: str) -> list[str]:
        """Sorted ids of the episodes with that verdict."""
        return sorted(i for i, d in self.decisions.items() if d.verdict == verdict)

    def needs(self, ids: Iterable[str]) -> set[str]:
        """What the scorers need that decided on these episodes."""
        deciders = {str(self.decisions[i].evidence.get("decided_by", "")) for i in ids}
        return {find_scorer(name).needs for name in deciders if is_scorer(name)}


def curate(episodes: Iterable[Episode], margins: Iterable[int] = ()) -> Curated:
    """Let the curator decide on episodes with its defaults and without a reference.

    Args:
        episodes: in any order.
        margins: control steps; beginnings are also made with each of these margins.
    """
    curation = Curation.fit()
    decisions: dict[str, Decision] = {}
    prefixes: dict[int | None, dict[str, Span]] = {None: {}, **{m: {} for m in margins}}
    example: Episode | None = None
    for episode in episodes:
        examination = curation.examine(episode)
        decision = decisions[episode.id] = curation.decide(examination)
        broke = examination.breaks.get(str(decision.evidence.get("decided_by")))
        if decision.verdict == "salvage":
            prefixes[None][episode.id] = decision.span
            if broke is not None and (example is None or episode.name < example.name):
                example = episode
        for margin in (m for m in prefixes if m is not None):
            if broke is not None and decision.verdict in ("salvage", "discard"):
                at = int(np.searchsorted(episode.stamps_ns, episode.start_ns + broke.at_ns))
                kept = good_prefix(episode, at, margin / episode.rate_hz)
                if kept is not None:
                    prefixes[margin][episode.id] = episode.span(*kept)
            elif decision.verdict == "salvage":  # only an end is spoilt: no margin changes that
                prefixes[margin][episode.id] = decision.span
    return Curated(decisions, prefixes, example)


def compare_with_truth(
    curated: Curated,
    good: Mapping[str, bool],
    release_steps: Mapping[str, int],
    timelines: Mapping[str, Episode],
) -> JsonObject:
    """Compare the decisions with the truth.

    Args:
        curated: the decisions.
        good: id -> whether the episode succeeded.
        release_steps: id -> step at which the gripper opened too early, for episodes with one.
        timelines: id -> episode with at least its stamps.

    Returns:
        `verdicts`: for each verdict the number of episodes that succeeded and that failed.
        `decided_by`: the number of episodes that each scorer decided.
        `cut_minus_release`: for salvaged episodes the last step that is kept minus the step of
        the release: their number, and the smallest, middle and largest difference.
    """
    verdicts = {v: {"good": 0, "defective": 0} for v in VERDICTS}
    deciders: dict[str, int] = {}
    for i, decision in curated.decisions.items():
        verdicts[decision.verdict]["good" if good[i] else "defective"] += 1
        decider = str(decision.evidence.get("decided_by", ""))
        deciders[decider] = deciders.get(decider, 0) + 1
    late = [
        len(timelines[i].within(span)) - 1 - release_steps[i]
        for i, span in curated.prefixes.get(None, {}).items()
        if i in release_steps
    ]
    difference = None
    if late:
        difference = {"n": len(late), "min": min(late), "median": median(late), "max": max(late)}
    return {
        "verdicts": verdicts,
        "decided_by": dict(sorted(deciders.items())),
        "cut_minus_release": difference,
    }


def phases_shown(
    bags: Iterable[tuple[str, Span | None]], timelines: Mapping[str, Episode]
) -> dict[str, dict[str, int]]:
    """Count how much of each phase demonstrations show.

    Args:
        bags: ids, each with the span that is kept; None for the whole episode.
        timelines: id -> episode with at least its phases.

    Returns:
        Phase -> the number of `demonstrations` that show it, and the number of `steps`. It is
        empty if the phases are unknown.
    """
    parts = [(i, phase_steps(timelines[i], span) if i in timelines else None) for i, span in bags]
    shown: dict[str, dict[str, int]] = balance_of(parts).to_json()["shown"]
    return shown
