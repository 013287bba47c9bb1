"""What scoring gives: results per episode, and counts over them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

from curation_ros.core.decision.decision import Decision, Verdict
from curation_ros.core.decision.examination import Examination, Scores
from curation_ros.core.errors import CurationError


@dataclass(frozen=True)
class Scored:
    """An episode that was scored and decided on.

    Attributes:
        path: of its recording; for an episode in memory, its id.
        examination: what was found in it.
        decision: what becomes of it. With logging it is the decision in force, which may be a
            person's; scores and findings are those of now in any case.
        is_known: whether the examination was kept from an earlier run.
        is_logged: whether a line was added to its decision log.
        replaced: verdict that was in force before, if logging has changed it.
        overridden_by: without logging, the decision of a person that is in force in the dataset
            and has another verdict.
        warning: why the decision was not logged, although it should have been; empty otherwise.
    """

    path: Path
    examination: Examination
    decision: Decision
    is_known: bool = False
    is_logged: bool = False
    replaced: Verdict | None = None
    overridden_by: Decision | None = None
    warning: str = ""

    @property
    def scores(self) -> Scores:
        """Scorer -> score, None where it abstained."""
        return self.examination.scores

    @property
    def verdict(self) -> Verdict:
        """Verdict of the decision."""
        return self.decision.verdict

    def to_json(self) -> dict[str, Any]:
        """As `curation score --json` prints it."""
        decision = self.decision
        return {
            "episode": decision.episode,
            "name": decision.name,
            "path": str(self.path),
            "length": self.examination.steps,
            "scores": dict(decision.scores),
            "decision": decision.verdict,
            "reason": decision.reason,
            "span": list(decision.span),
            "findings": [f.to_json() for f in decision.findings],
        }


@dataclass(frozen=True)
class Unreadable:
    """A path without a recording, or a recording that cannot be read.

    Attributes:
        path: as given, or of the recording.
        error: what is wrong with it.
    """

    path: Path
    error: CurationError

    def to_json(self) -> dict[str, Any]:
        """As `curation score --json` prints it."""
        finding = getattr(self.error, "finding", "")
        return {"path": str(self.path), "error": str(self.error), "finding": finding}


ScoringResult: TypeAlias = Scored | Unreadable


@dataclass
class ScoringCounts:
    """Counts over the results of a run.

    Attributes:
        verdicts: verdict -> episodes with that decision.
        n_known: episodes with an examination that was kept from an earlier run.
        n_unreadable: paths without a recording, and recordings that could not be read.
        n_in_reference: scored episodes that are in the reference, too.
        n_with_findings: episodes with a finding.
        replaced: (verdict before, verdict now) -> decisions that logging has changed.
        overridden: results with a verdict that a person has overridden.
    """

    verdicts: Counter[Verdict] = field(default_factory=Counter)
    n_known: int = 0
    n_unreadable: int = 0
    n_in_reference: int = 0
    n_with_findings: int = 0
    replaced: Counter[tuple[Verdict, Verdict]] = field(default_factory=Counter)
    overridden: list[Scored] = field(default_factory=list)

    @property
    def n_scored(self) -> int:
        """Episodes that were scored."""
        return self.verdicts.total()

    def add(self, result: ScoringResult, reference_ids: Sequence[str]) -> None:
        """Count one more result."""
        if isinstance(result, Unreadable):
            self.n_unreadable += 1
            return
        decision = result.decision
        self.verdicts[decision.verdict] += 1
        self.n_known += result.is_known
        self.n_in_reference += decision.episode in reference_ids
        self.n_with_findings += bool(decision.findings)
        if result.replaced is not None:
            self.replaced[result.replaced, decision.verdict] += 1
        if result.overridden_by is not None:
            self.overridden.append(result)
