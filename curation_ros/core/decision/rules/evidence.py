"""Rule `evidence`: laws of the task first, then a threshold, then a person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from typing_extensions import override

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.rules.rule import Case
from curation_ros.core.decision.rules.threshold import Threshold

if TYPE_CHECKING:
    from typing_extensions import Self

#: Scorers of a law of the task, the strongest first -> what it means that nothing broke.
LAWFUL: dict[str, str] = {
    "object_coupling": "what was grasped stayed with the effector until it was let go",
    "grip_consistency": "the fingers held something for as long as something was to be carried",
    "phase_events": "the gripper stayed closed for as long as something was to be carried",
}
#: The same scorers in the same order, grouped by the kind of their evidence.
_LAWS: tuple[tuple[str, ...], ...] = (
    ("object_coupling",),
    ("grip_consistency", "phase_events"),
)
#: Below this a law was broken. It is 1 less the resolution of these scorers.
_INTACT = 0.98


class Evidence(Threshold):
    """The strongest evidence that is conclusive decides; what broke is cut, not thrown away.

    1. Object pose: `object_coupling`. The grasped object stayed with the effector until it was
       let go, or it did not.
    2. Gripper and phase: `grip_consistency` (what the fingers held) and `phase_events` (what was
       commanded). One that saw a break outweighs one that saw none.
    3. A trusted reference: a threshold on the scorer that the rule is given, see `Threshold`.
    4. Else a person.

    The first two are laws of the task and need no threshold. An intact episode is kept. Of a
    broken one the beginning is salvaged. If the pose says that the object left while the fingers
    held on with no command to open, the pose may be wrong, and a person is asked. The reason
    names the evidence that was missing. Without a reference the third step is left out.

    Attributes:
        no_reference_: why there is no threshold; empty where there is one.
        void_: scorers whose law does not hold here: most of the trusted episodes break it.
    """

    name = "evidence"
    summary = "keep by the strongest evidence, and salvage the good beginning of what broke"
    selects = False
    instead = (
        "it decides on whole examinations, not on scores alone: run curation score DATASET "
        "--write, then curation select --rule decisions"
    )
    consults = tuple(LAWFUL)

    def __init__(
        self, *, scorer: str, threshold: float | None = None, false_alarm: float = 0.01
    ) -> None:
        """Store the parameters of the third step; see `Threshold`."""
        super().__init__(scorer=scorer, threshold=threshold, false_alarm=false_alarm)

    @override
    def fit_consulted(self, reference_scores: Mapping[str, Sequence[float]]) -> Self:
        self.no_reference_ = ""
        self.void_ = tuple(
            name
            for name, scores in reference_scores.items()
            if 2 * sum(score < _INTACT for score in scores) > len(scores)
        )
        return self

    @override
    def without_reference(self, why: str) -> Self:
        self.no_reference_ = why
        return self

    @override
    def decider(self, scores: Mapping[str, float | None]) -> str:
        for names in _LAWS:
            valid = {n: scores.get(n) for n in names if n not in self._void}
            known = {n: s for n, s in valid.items() if s is not None}
            if known:
                broken = [n for n, score in known.items() if score < _INTACT]
                return (broken or list(known))[0]
        return self.scorer

    @override
    def verdict(self, case: Case) -> tuple[Verdict, str]:
        name = self.decider(case.scores)
        missing = {
            n: f"cannot tell: {case.abstained[n]}" for n in self.consults if n in case.abstained
        }
        missing |= dict.fromkeys(self._void, "is no law here: most of the reference breaks it")
        stronger = self.consults[: self.consults.index(name)] if name in LAWFUL else self.consults
        blind = "".join(f"; {n} {missing[n]}" for n in stronger if n in missing)
        score = case.scores.get(name)
        if score is not None and name in LAWFUL:
            if score >= _INTACT:
                return "keep", f"{name}: {LAWFUL[name]}{blind}"
            explanations = case.explanations
            if name == _LAWS[0][0] and self._is_doubted(case.scores):
                doubt = f"grip_consistency: {LAWFUL['grip_consistency']}"
                return "review", f"{explanations.get(name, name)}; but {doubt}"
            return "salvage", f"{explanations.get(name, f'{name} {score:.2f}')}{blind}"
        if self.cut is None:
            why = self._no_reference or "no reference"
            return "review", f"{blind[2:]}; {why}" if blind else why
        verdict, text = super().verdict(case)
        return verdict, f"{text}{blind}"

    def _is_doubted(self, scores: Mapping[str, float | None]) -> bool:
        """Whether the fingers held on to the object that left, with no command to open.

        Then the pose may be wrong: it jumped, came late, or is another object's.
        """
        held, closed = (
            scores.get(name) if name not in self._void else None
            for name in ("grip_consistency", "phase_events")
        )
        opened = closed is not None and closed < _INTACT
        return held is not None and held >= _INTACT and not opened

    @override
    def describe(self) -> str:
        laws = ", then ".join(" and ".join(names) for names in _LAWS)
        why = self._no_reference
        last = f"review: {why}" if why else super().describe()
        return f"the first that can tell: {laws}; then {last}"

    @property
    def _void(self) -> tuple[str, ...]:
        """As fitted; without a fit every law holds."""
        return getattr(self, "void_", ())

    @property
    def _no_reference(self) -> str:
        return getattr(self, "no_reference_", "")
