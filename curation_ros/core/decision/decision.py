"""Decisions: what becomes of an episode, why, which part of it, and on what evidence."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError

Verdict = Literal["keep", "salvage", "review", "discard"]
VERDICTS: tuple[Verdict, ...] = get_args(Verdict)

#: Author of decisions that no person made.
CURATOR = "curator"

#: Findings of the recording that are noted in the decision and stop nothing. All others need a
#: person, because what was recorded may not be what happened. Without a readable bag the live
#: episode stands. Lost messages that cannot be counted matter only if they leave a hole, which is
#: also a `gap`.
NOTED = ("unknown-loss", "unknown-phase", "no-bag")


def untrustworthy(findings: Iterable[Finding]) -> list[Finding]:
    """Findings that need a person, in their order."""
    return [f for f in findings if f.kind == "recording" and f.id not in NOTED]


@dataclass(frozen=True)
class Decision:
    """One line of `decisions/<uuid>.jsonl`.

    Attributes:
        episode, name: identity of the episode.
        verdict: keep, salvage (keep only the span), review (ask a person), or discard.
        reason: one sentence that an operator understands.
        span: nanoseconds from the start stamp, inclusive; the whole episode by default.
        scores: scorer -> score, None where it abstained.
        abstained: scorer -> why.
        findings: faults of the recording, unusual motion, failed task.
        evidence: what the verdict rests on, as plain JSON values.
        revision: 1, 2, ... per episode; the log gives the number.
        by: `curator`, or the name of the person.
        state_hash: hash of the fitted state that the decision is a function of.
    """

    episode: str
    name: str
    verdict: Verdict
    reason: str
    span: tuple[int, int]
    scores: Mapping[str, float | None] = field(default_factory=dict)
    abstained: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    revision: int = 1
    by: str = CURATOR
    state_hash: str = ""

    def __post_init__(self) -> None:
        if self.verdict not in VERDICTS:
            raise EpisodeError(
                f"decision on {self.episode}: verdict {self.verdict!r} is none of "
                f"{', '.join(VERDICTS)}"
            )
        if not 0 <= self.span[0] <= self.span[1]:
            raise EpisodeError(f"decision on {self.episode}: span {self.span} makes no sense")
        for scorer, score in self.scores.items():
            if score is not None and not math.isfinite(score):
                raise EpisodeError(
                    f"decision on {self.episode}: score {scorer!r} is {score}; "
                    "one that abstained is None"
                )

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal decision."""
        return {
            "episode": self.episode,
            "name": self.name,
            "verdict": self.verdict,
            "reason": self.reason,
            "span": list(self.span),
            "scores": dict(self.scores),
            "abstained": dict(self.abstained),
            "findings": [f.to_json() for f in self.findings],
            "evidence": dict(self.evidence),
            "revision": self.revision,
            "by": self.by,
            "state_hash": self.state_hash,
        }

    @classmethod
    def from_json(cls, raw: object) -> Decision:
        """Read what `to_json` wrote; unknown keys are ignored.

        Raises:
            EpisodeError: if a key is missing or a value makes no sense.
        """
        if not isinstance(raw, Mapping):
            raise EpisodeError(f"decision: expected a mapping, found {raw!r:.80}")
        try:
            scores = {str(k): None if v is None else float(v) for k, v in raw["scores"].items()}
            findings = tuple(Finding.from_json(f) for f in raw["findings"])
            first, last = raw["span"]
            return cls(
                episode=str(raw["episode"]),
                name=str(raw["name"]),
                verdict=raw["verdict"],
                reason=str(raw["reason"]),
                span=(int(first), int(last)),
                scores=scores,
                abstained={str(k): str(v) for k, v in raw["abstained"].items()},
                findings=findings,
                evidence=dict(raw["evidence"]),
                revision=int(raw["revision"]),
                by=str(raw["by"]),
                state_hash=str(raw["state_hash"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as err:
            raise EpisodeError(f"decision: {type(err).__name__} {err} in {raw!r:.200}") from err


def override(
    previous: Decision,
    verdict: Verdict,
    reason: str,
    *,
    by: str,
    span: tuple[int, int] | None = None,
) -> Decision:
    """A person's decision: the next revision, on the same scores, findings and evidence.

    Raises:
        EpisodeError: if no person is named, or the verdict makes no sense.
    """
    if not by or by == CURATOR:
        raise EpisodeError(
            f"override of {previous.episode}: by {by!r}: expected the name of a person"
        )
    return replace(
        previous,
        verdict=verdict,
        reason=reason,
        by=by,
        span=previous.span if span is None else span,
        revision=previous.revision + 1,
    )


def in_force(decisions: Iterable[Decision]) -> dict[str, Decision]:
    """The decision that counts for each episode.

    A person outranks the curator, whatever the curator decides later. Among equals the highest
    revision counts, and the later one of equal revisions.

    Args:
        decisions: in the order of their logs.
    """
    found: dict[str, Decision] = {}
    for decision in decisions:
        held = found.get(decision.episode)
        if held is None or _rank(decision) >= _rank(held):
            found[decision.episode] = decision
    return found


def own_decisions(decisions: Iterable[Decision]) -> dict[str, Decision]:
    """The curator's last decision for each episode, whatever people decided.

    Args:
        decisions: in the order of their logs.
    """
    return in_force(d for d in decisions if d.by == CURATOR)


def _rank(decision: Decision) -> tuple[bool, int]:
    return decision.by != CURATOR, decision.revision
