"""From an episode and fitted scorers to an examination."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from curation_ros.core.decision.decision import untrustworthy
from curation_ros.core.decision.examination import Break, Examination, Part
from curation_ros.core.decision.fitted_scorers import FittedScorers, Looks
from curation_ros.core.decision.salvage import good_prefix, sound_part
from curation_ros.core.episode.findings import Finding
from curation_ros.core.evidence.baseline import Baseline
from curation_ros.core.evidence.checks import check_episode
from curation_ros.core.evidence.gripper import gripper_findings
from curation_ros.core.scorers.features import phase_name

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

#: Checks that read the gripper's command: void where its meaning is in doubt.
_BY_GRIPPER = ("clipped-start", "grip-lost", "never-grasped", "opened-early", "unfinished")


def examine(fitted: FittedScorers, episode: Episode) -> Examination:
    """Score one episode and check it: everything that a rule decides on.

    It never raises: what a scorer cannot score it abstains on, and what is wrong with the episode
    is a finding.
    """
    findings = _findings(episode, fitted.baseline)
    looks = fitted.look(episode)
    return Examination(
        episode=episode.id,
        name=episode.name,
        steps=len(episode),
        span=(0, max(0, episode.end_ns - episode.start_ns)),
        scores=looks.scores,
        abstained=looks.abstained,
        explanations=looks.explanations,
        findings=findings,
        evidence=_evidence(fitted, looks),
        content=episode.content_digest,
        part=_part(fitted, episode, findings),
        breaks=_breaks(fitted, episode, looks),
    )


def _findings(episode: Episode, baseline: Baseline) -> tuple[Finding, ...]:
    """Those that came with the episode, and what its arrays show."""
    found = (*gripper_findings(episode), *check_episode(episode, baseline))
    known = {f.id for f in episode.findings}
    if any(f.id == "gripper-meaning" for f in (*episode.findings, *found)):
        known.update(_BY_GRIPPER)
    return (*episode.findings, *(f for f in found if f.id not in known))


def _part(fitted: FittedScorers, episode: Episode, findings: tuple[Finding, ...]) -> Part | None:
    """The sound part of an episode whose recording is bad at an end, scored by itself."""
    faults = untrustworthy(findings)
    kept = sound_part(episode, faults)
    if kept is None:
        return None
    rest = episode.steps(kept[1] + 1, kept[0])
    known = {f.id for f in findings}
    if any(f.id not in known for f in untrustworthy(_findings(rest, fitted.baseline))):
        return None
    looks = fitted.look(rest)
    return Part(
        span=episode.span(*kept),
        without=f"{faults[0].id}: {faults[0].message}",
        scores=looks.scores,
        abstained=looks.abstained,
        explanations=looks.explanations,
    )


def _evidence(fitted: FittedScorers, looks: Looks) -> dict[str, Any]:
    """What goes with the decision: the length that was compared, and where scorers looked."""
    evidence: dict[str, Any] = {"length_steps": fitted.length.steps_}
    places = {
        name: {
            "span": list(looks.views[name].span(*look.steps)),
            "phase": phase_name(looks.views[name], look.steps[0]),
        }
        for name, look in looks.found.items()
        if look.steps is not None
    }
    if places:
        evidence["seen"] = places
    return evidence


def _breaks(fitted: FittedScorers, episode: Episode, looks: Looks) -> dict[str, Break]:
    """Where scorers see the whole episode break."""
    found: dict[str, Break] = {}
    margin_s = fitted.settings.salvage_margin_s
    for name, look in looks.found.items():
        step = look.broke_at
        if margin_s is None or step is None or fitted.scorers[name].length_controlled:
            continue
        kept = good_prefix(episode, step, margin_s)
        at_ns = int(episode.stamps_ns[step]) - episode.start_ns
        found[name] = Break(at_ns, margin_s, kept and episode.span(*kept))
    return found
