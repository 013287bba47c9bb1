"""What was found in an episode, before any rule: scores, findings, explanations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from curation_ros.core.decision.decision import untrustworthy
from curation_ros.core.decision.rules import Case
from curation_ros.core.episode.findings import Finding
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import Span

Scores = Mapping[str, float | None]


@dataclass(frozen=True)
class Part:
    """The sound part of an episode whose recording is bad at an end.

    Attributes:
        span: nanoseconds from the start stamp of the episode, inclusive.
        without: what was left out, for people.
        scores, abstained, explanations: as in Examination, of this part alone.
    """

    span: Span
    without: str
    scores: Scores
    abstained: Mapping[str, str] = field(default_factory=dict)
    explanations: Mapping[str, str] = field(default_factory=dict)

    def case(self, episode: str) -> Case:
        """What a rule decides on, if this part were all of the episode."""
        return Case(episode, self.scores, self.abstained, self.explanations)


@dataclass(frozen=True)
class Break:
    """Where an episode that was right until then went wrong, as a scorer sees it.

    Attributes:
        at_ns: nanoseconds from the start stamp of the episode.
        margin_s: seconds that the good beginning ends before it.
        span: of that beginning, nanoseconds from the start stamp, inclusive; None if nothing
            worth keeping is left.
    """

    at_ns: int
    margin_s: float
    span: Span | None

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back."""
        span = None if self.span is None else list(self.span)
        return {"at_ns": self.at_ns, "margin_s": self.margin_s, "span": span}

    @classmethod
    def from_json(cls, raw: Any) -> Break:
        """Read what `to_json` wrote."""
        span = None if raw["span"] is None else _span(raw["span"])
        return cls(int(raw["at_ns"]), float(raw["margin_s"]), span)


@dataclass(frozen=True)
class Examination:
    """Everything that a rule decides on: a function of the episode and of the fitted scorers.

    It does not depend on the rule, so it is computed once per episode and kept.

    Attributes:
        episode, name: identity of the episode.
        steps: its length T.
        span: of the whole episode, nanoseconds from its start stamp, inclusive.
        scores: scorer -> score, None where it abstained.
        abstained: scorer -> why.
        explanations: scorer -> one sentence for the operator, where it has one.
        findings: faults of the recording, unusual motion, failed task.
        evidence: plain JSON values that go with the decision.
        content: digest of the values, the same for copies under other names.
        part: the sound part of a recording that is bad at an end.
        breaks: scorer -> where it sees the episode break, for the scorers that see a break.
    """

    episode: str
    name: str
    steps: int
    span: Span
    scores: Scores
    abstained: Mapping[str, str] = field(default_factory=dict)
    explanations: Mapping[str, str] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()
    evidence: Mapping[str, Any] = field(default_factory=dict)
    content: str = ""
    part: Part | None = None
    breaks: Mapping[str, Break] = field(default_factory=dict)

    @property
    def case(self) -> Case:
        """What a rule decides on."""
        return Case(self.episode, self.scores, self.abstained, self.explanations)

    @property
    def is_trusted(self) -> bool:
        """Whether its recording has no fault that needs a person; a ranking takes no other."""
        return not untrustworthy(self.findings)

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal examination.

        Explanations have the key `words`, as in examinations that were kept before.
        """
        part = self.part
        return {
            "episode": self.episode,
            "name": self.name,
            "steps": self.steps,
            "span": list(self.span),
            "scores": dict(self.scores),
            "abstained": dict(self.abstained),
            "words": dict(self.explanations),
            "findings": [f.to_json() for f in self.findings],
            "evidence": dict(self.evidence),
            "content": self.content,
            "part": None
            if part is None
            else {
                "span": list(part.span),
                "without": part.without,
                "scores": dict(part.scores),
                "abstained": dict(part.abstained),
                "words": dict(part.explanations),
            },
            "breaks": {name: one.to_json() for name, one in self.breaks.items()},
        }

    @classmethod
    def from_json(cls, raw: Any) -> Examination:
        """Read what `to_json` wrote.

        Raises:
            EpisodeError: if a key is missing or a value makes no sense.
        """
        try:
            part = raw["part"]
            return cls(
                episode=raw["episode"],
                name=raw["name"],
                steps=raw["steps"],
                span=_span(raw["span"]),
                scores=raw["scores"],
                abstained=raw["abstained"],
                explanations=raw["words"],
                findings=tuple(Finding.from_json(f) for f in raw["findings"]),
                evidence=raw["evidence"],
                content=raw["content"],
                part=None
                if part is None
                else Part(
                    span=_span(part["span"]),
                    without=part["without"],
                    scores=part["scores"],
                    abstained=part["abstained"],
                    explanations=part["words"],
                ),
                breaks={name: Break.from_json(one) for name, one in raw["breaks"].items()},
            )
        except (KeyError, TypeError, ValueError, IndexError, AttributeError) as err:
            raise EpisodeError(f"examination: {type(err).__name__} {err} in {raw!r:.200}") from err


def _span(raw: Any) -> Span:
    first, last = raw
    return int(first), int(last)
