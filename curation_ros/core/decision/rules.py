"""Rules: from scores to a verdict, on one episode or over a dataset."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from scipy.special import stdtrit

from curation_ros.core.decision.decision import Verdict
from curation_ros.core.decision.groups import METHODS, MIN_SCORES, split_scores
from curation_ros.core.decision.selection import TieKey, keep_count, ranking, tie_key
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

if TYPE_CHECKING:
    from typing_extensions import Self


class Rule(ABC):
    """Turns scores into a verdict; hyper-parameters and `fit` as scorers have them.

    Attributes:
        needs: what must be fitted first: nothing, the scores of trusted episodes (`fit`), or the
            scores of the dataset that is decided on (`fit_dataset`).
        min_references: how many trusted episodes at least.
        min_episodes: how many episodes of the dataset at least.
        consults: scorers that it asks before the one that it is given.
    """

    needs: Literal["nothing", "reference", "dataset"] = "nothing"
    min_references: ClassVar[int] = 0
    min_episodes: ClassVar[int] = 0
    consults: ClassVar[tuple[str, ...]] = ()

    def __init__(self, *, scorer: str) -> None:
        """Store the name of the scorer that decides."""
        self.scorer = scorer

    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
        """Learn from the deciding scorer's scores of trusted episodes.

        Args:
            reference_scores: one an episode, each by a scorer that had not seen that episode.
            resolution: `Scorer.resolution`: the difference that counts as none.
        """
        return self

    def fit_consulted(self, reference_scores: Mapping[str, Sequence[float]]) -> Self:
        """Learn from what the consulted scorers say of the reference, where there is one.

        Args:
            reference_scores: scorer -> scores of the trusted episodes that it can tell.
        """
        return self

    def without_reference(self, why: str) -> Self | None:
        """The rule where it needs a reference and there is none that it can learn from.

        Returns:
            None where it cannot judge then.
        """
        return None

    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        """Learn from the deciding scorer's scores of the dataset that is decided on.

        Args:
            scores: episode id -> score, of those that it did not abstain on.
            resolution: as in `fit`.
            tie: episode id -> key that orders equal scores; by default a hash of the id.

        Raises:
            EpisodeError: if there are fewer than `min_episodes`.
        """
        return self

    @abstractmethod
    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Decide on one episode.

        Args:
            scores: scorer -> score, None where it abstained.
            abstained: scorer -> why.
            words: scorer -> what is to be seen in the episode, where a scorer can say it.
            episode: its id: a rule that keeps a number of episodes draws lots at the cut.

        Returns:
            The verdict and its reason; `salvage` if the episode broke, and its good beginning is
            worth keeping where there is one.
        """

    def decider(self, scores: Mapping[str, float | None]) -> str:
        """The scorer whose score of an episode decides."""
        return self.scorer

    def params(self) -> dict[str, Any]:
        """Hyper-parameters by name."""
        return {k: v for k, v in vars(self).items() if not k.endswith("_")}

    def fitted(self) -> dict[str, Any]:
        """Learned values by name."""
        return {k: v for k, v in vars(self).items() if k.endswith("_")}

    @property
    def cut(self) -> float | None:
        """The score at or above which it keeps, where it has one."""
        return None

    def describe(self) -> str:
        """One line for people."""
        return "review: every episode is for a person to decide"

    def _score(
        self, scores: Mapping[str, float | None], abstained: Mapping[str, str]
    ) -> float | str:
        """The deciding score, or why there is none."""
        score = scores.get(self.scorer)
        if score is None:
            return f"{self.scorer} cannot tell: {abstained.get(self.scorer, 'it was not asked')}"
        return score


class NoRule(Rule):
    """Every episode is for a person to decide: scores are shown, nothing is concluded."""

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Review, always."""
        return "review", "no rule: a person decides"


class Threshold(Rule):
    """Keep at or above a threshold of one scorer, discard below, review where it abstained.

    The threshold is given, or fitted on the reference as the lower of two bounds:

    - min - resolution: below every reference score by more than the scorer can tell apart. This
      one decides where references are saturated (a timing of 1.0 throughout) and the spread is 0;
    - median - k * 1.4826 * MAD, with k the one-sided prediction factor of Student's t,
      t(1 - false_alarm, n - 1) * sqrt(1 + 1 / n): it reaches further below the smaller n is.

    Aim: `false_alarm` = 1 % of good demonstrations discarded if scores are normal. Because the
    MAD of few numbers is itself uncertain, simulated rates with normal scores are 5 % at n = 3,
    3 % at 4 to 6, 2 % at 8 to 12 and 1 % from 20 on; with exponential tails about three times
    that. It cannot protect against a defective reference: such an episode lowers the threshold.

    Attributes:
        threshold_: after `fit`; always finite.
        n_: number of references.
        low_, median_: smallest and middle of their scores.
    """

    min_references = 3

    def __init__(
        self, *, scorer: str, threshold: float | None = None, false_alarm: float = 0.01
    ) -> None:
        """Store the parameters.

        Args:
            scorer: name of the scorer that decides.
            threshold: keep at or above; None: fit it.
            false_alarm: share of good demonstrations that a fitted threshold may discard.

        Raises:
            ConfigError: if a number makes no sense.
        """
        super().__init__(scorer=scorer)
        if threshold is not None and not math.isfinite(threshold):
            raise ConfigError(f"rule 'threshold': threshold {threshold} is not finite")
        if not 0 < false_alarm < 0.5:
            raise ConfigError(
                f"rule 'threshold': false_alarm {false_alarm}: expected a number from 0 to 0.5"
            )
        self.threshold = threshold
        self.false_alarm = false_alarm
        self.needs = "reference" if threshold is None else "nothing"

    def fit(self, reference_scores: Sequence[float], *, resolution: float = 0.0) -> Self:
        """Learn the threshold, if none was given.

        Raises:
            EpisodeError: if there are fewer than `min_references`, or a score is not finite.
        """
        if self.threshold is not None:
            return self
        scores = np.asarray(reference_scores, dtype=np.float64)
        n = len(scores)
        if n < self.min_references:
            raise EpisodeError(
                f"a threshold needs {self.min_references} reference episodes, there are {n}"
            )
        if not np.isfinite(scores).all():
            raise EpisodeError("a reference score is not finite")
        median = float(np.median(scores))
        sigma = 1.4826 * float(np.median(np.abs(scores - median)))
        k = float(stdtrit(n - 1, 1.0 - self.false_alarm)) * math.sqrt(1.0 + 1.0 / n)
        self.low_, self.median_, self.n_ = float(scores.min()), median, n
        self.threshold_ = min(self.low_ - resolution, median - k * sigma)
        return self

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Compare the score with the threshold."""
        score = self._score(scores, abstained)
        if isinstance(score, str):
            return "review", score
        threshold = self.cut
        if threshold is None:
            raise NotFittedError("rule 'threshold' has no threshold: give one, or fit it")
        given = self.threshold is not None
        origin = "as configured" if given else f"fitted on {self.n_} references"
        keep = score >= threshold
        if not keep and self.scorer in words:
            return "discard", words[self.scorer]
        shown, limit = _told_apart(score, threshold)
        relation = "at or above" if keep else "below"
        text = f"{self.scorer} {shown} {relation} {limit}, {origin}"
        return ("keep" if keep else "discard"), text

    @property
    def cut(self) -> float | None:
        """The threshold, given or fitted; None before."""
        if self.threshold is not None:
            return self.threshold
        fitted: float | None = getattr(self, "threshold_", None)
        return fitted

    def describe(self) -> str:
        """The threshold and where it comes from."""
        if self.threshold is not None:
            return f"keep where {self.scorer} >= {self.threshold:.6g} (as configured)"
        if not hasattr(self, "threshold_"):
            return f"review: no threshold for {self.scorer}"
        return (
            f"keep where {self.scorer} >= {self.threshold_:.6g} (fitted on {self.n_} references, "
            f"lowest {self.low_:.6g}, median {self.median_:.6g})"
        )


#: Scorers of a law of the task, the strongest first -> what it means that nothing broke.
LAWFUL: dict[str, str] = {
    "object_coupling": "what was grasped stayed with the effector until it was let go",
    "grip_consistency": "the fingers held something for as long as something was to be carried",
    "phase_events": "the gripper stayed closed for as long as something was to be carried",
}
#: The same, in the same order, by the kind of their evidence.
_LAWS: tuple[tuple[str, ...], ...] = (
    ("object_coupling",),
    ("grip_consistency", "phase_events"),
)
#: Below this a law was broken: 1 but for the resolution of these scorers.
_INTACT = 0.98


class Evidence(Threshold):
    """The first evidence that can tell decides; what broke is cut, not thrown away.

    1. Object pose: `object_coupling`. What was grasped stayed with the effector until it was let
       go, or it did not.
    2. Gripper and phase: `grip_consistency` (what the fingers held) and `phase_events` (what was
       commanded). One that says that it broke outweighs one that does not.
    3. A trusted reference: a threshold on the scorer that the rule is given, see `Threshold`.
    4. Else a person.

    The first two are laws of the task and need no threshold: an intact episode is kept, of a
    broken one the beginning is salvaged. Where the pose says that an object left, and the fingers
    held on with no command to open, the pose may be wrong: then a person is asked. What they
    could not know is said in the reason. Without a reference, the third is left out.

    Attributes:
        no_reference_: why there is no threshold; empty where there is one.
        void_: scorers whose law is none here: most of the trusted episodes break it.
    """

    consults = tuple(LAWFUL)

    def __init__(
        self, *, scorer: str, threshold: float | None = None, false_alarm: float = 0.01
    ) -> None:
        """Store the parameters; see `Threshold`, they are of the third step."""
        super().__init__(scorer=scorer, threshold=threshold, false_alarm=false_alarm)
        self.no_reference_ = ""
        self.void_: tuple[str, ...] = ()

    def fit_consulted(self, reference_scores: Mapping[str, Sequence[float]]) -> Self:
        """Leave out the laws that most of the trusted episodes break."""
        self.void_ = tuple(
            name
            for name, scores in reference_scores.items()
            if 2 * sum(score < _INTACT for score in scores) > len(scores)
        )
        return self

    def without_reference(self, why: str) -> Self:
        """Judge by the first two kinds of evidence alone."""
        self.no_reference_ = why
        return self

    def decider(self, scores: Mapping[str, float | None]) -> str:
        """The first scorer that can tell, of one kind of evidence the one that saw it break."""
        for names in _LAWS:
            told = {n: scores.get(n) for n in names if n not in self.void_}
            known = {n: s for n, s in told.items() if s is not None}
            if known:
                broken = [n for n, score in known.items() if score < _INTACT]
                return (broken or list(known))[0]
        return self.scorer

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Ask one after the other."""
        name = self.decider(scores)
        silent = {n: f"cannot tell: {abstained[n]}" for n in self.consults if n in abstained}
        silent |= dict.fromkeys(self.void_, "is no law here: most of the reference breaks it")
        stronger = self.consults[: self.consults.index(name)] if name in LAWFUL else self.consults
        blind = "".join(f"; {n} {silent[n]}" for n in stronger if n in silent)
        score = scores.get(name)
        if score is not None and name in LAWFUL:
            if score >= _INTACT:
                return "keep", f"{name}: {LAWFUL[name]}{blind}"
            if name == _LAWS[0][0] and self._is_doubted(scores):
                doubt = f"grip_consistency: {LAWFUL['grip_consistency']}"
                return "review", f"{words.get(name, name)}; but {doubt}"
            return "salvage", f"{words.get(name, f'{name} {score:.2f}')}{blind}"
        if self.cut is None:
            why = self.no_reference_ or "no reference"
            return "review", f"{blind[2:]}; {why}" if blind else why
        verdict, text = super().judge(scores, abstained, words, episode)
        return verdict, f"{text}{blind}"

    def _is_doubted(self, scores: Mapping[str, float | None]) -> bool:
        """Whether the fingers held on to what is said to have left, and nobody told them not to.

        Then the pose may be wrong: it jumped, came late, or is another object's.
        """
        held, told = (
            scores.get(name) if name not in self.void_ else None
            for name in ("grip_consistency", "phase_events")
        )
        opened = told is not None and told < _INTACT
        return held is not None and held >= _INTACT and not opened

    def describe(self) -> str:
        """What is asked, in which order."""
        laws = ", then ".join(" and ".join(names) for names in _LAWS)
        last = f"review: {self.no_reference_}" if self.no_reference_ else super().describe()
        return f"the first that can tell: {laws}; then {last}"


class _Ranked(Rule):
    """Keeps a number of episodes, the best of the dataset; discards the rest.

    Equal scores at the cut are kept or not by lot, that is by their tie keys, so that the number
    comes out; the reason says so. With fewer than `min_episodes` it does not judge: the best of
    two may be bad.

    Attributes:
        cut_: lowest score that is kept.
        by_lot_: sorted ids of the kept episodes that share it with others that are not.
        n_kept_, n_: episodes kept, and how many there were.
        n_tied_: episodes with a score equal to the cut.
    """

    needs = "dataset"
    min_episodes = 4
    keep_rule: ClassVar[str]

    def __init__(self, *, scorer: str, value: float) -> None:
        """Store what the rule takes."""
        super().__init__(scorer=scorer)
        self.value = value

    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        """Rank the dataset."""
        _enough(self, scores)
        order = ranking(scores, tie or _by_id)
        n_kept = min(keep_count(self.keep_rule, self.value, len(order)), len(order))
        kept = order[:n_kept]
        self.n_, self.n_kept_ = len(order), n_kept
        self.cut_ = scores[kept[-1]] if kept else math.inf
        tied = [i for i in order if scores[i] == self.cut_]
        self.n_tied_ = len(tied)
        held = sorted(set(tied) & set(kept))
        self.by_lot_ = tuple(held) if len(held) < len(tied) else ()
        return self

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Compare the score with the cut; where it is equal, the lot has the say."""
        score = self._score(scores, abstained)
        if isinstance(score, str):
            return "review", score
        if not hasattr(self, "cut_"):
            raise NotFittedError(f"rule {self.keep_rule!r} has seen no dataset: fit it first")
        by_lot = score == self.cut_ and bool(self.by_lot_)
        keep = episode in self.by_lot_ if by_lot else score >= self.cut_
        shown, limit = _told_apart(score, self.cut_)
        place = f"among the best {self.n_kept_} of {self.n_}"
        if by_lot:
            text = (
                f"{self.scorer} {shown} is the cut of the best {self.n_kept_} of {self.n_}, which "
                f"{self.n_tied_} episodes share: {'kept' if keep else 'left out'} by lot"
            )
        elif keep:
            text = f"{self.scorer} {shown} is {place}"
        else:
            text = f"{self.scorer} {shown} is not {place} (cut {limit})"
            text = f"{words[self.scorer]}; {text}" if self.scorer in words else text
        return ("keep" if keep else "discard"), text

    @property
    def cut(self) -> float | None:
        """The lowest score that is kept; None before, or where nothing is kept."""
        fitted: float = getattr(self, "cut_", math.inf)
        return fitted if math.isfinite(fitted) else None


class TopFraction(_Ranked):
    """Keep the best share of the dataset (the paper's: 0.75), whatever their scores are.

    It keeps bad episodes where more than that share is bad, and discards good ones where less is.
    """

    keep_rule = "top-fraction"

    def __init__(self, *, scorer: str, value: float = 0.75) -> None:
        """Store the share.

        Raises:
            ConfigError: if it is no share.
        """
        super().__init__(scorer=scorer, value=value)
        keep_count(self.keep_rule, value, 1)

    def describe(self) -> str:
        """The share."""
        return f"keep the best {self.value:.0%} of the dataset by {self.scorer}"


class TopK(_Ranked):
    """Keep the best K of the dataset, or all where there are fewer."""

    keep_rule = "top-k"

    def __init__(self, *, scorer: str, value: float = 60) -> None:
        """Store the number.

        Raises:
            ConfigError: if it is no whole number from 1.
        """
        super().__init__(scorer=scorer, value=value)
        keep_count(self.keep_rule, value, 1)

    def describe(self) -> str:
        """The number."""
        return f"keep the best {self.value:.0f} of the dataset by {self.scorer}"


class Gap(Rule):
    """Keep the upper of two clearly separated groups of scores, discard the lower.

    Where the scores do not separate, or an episode lies between the groups, a person is asked:
    never a fixed share in silence. It takes the upper group for the good one; a scorer whose sign
    depends on the majority makes that wrong, and no rule can tell.

    Attributes:
        cut_: where the groups part; None where there is one group.
        doubt_: scores between these two are in doubt.
        n_upper_, n_: episodes in the upper group, and in all.
        why_: what was found.
    """

    needs = "dataset"
    min_episodes = MIN_SCORES

    def __init__(self, *, scorer: str, method: str = "mixture") -> None:
        """Store the method, one of `separation.METHODS`.

        Raises:
            ConfigError: if there is no such method.
        """
        super().__init__(scorer=scorer)
        if method not in METHODS:
            raise ConfigError(f"rule 'gap': method {method!r} is none of {', '.join(METHODS)}")
        self.method = method

    def fit_dataset(
        self,
        scores: Mapping[str, float],
        *,
        resolution: float = 0.0,
        tie: TieKey | None = None,
    ) -> Self:
        """Look for two groups."""
        _enough(self, scores)
        split = split_scores(list(scores.values()), resolution=resolution, method=self.method)
        self.cut_, self.doubt_, self.why_ = split.cut, split.doubt, split.why
        self.n_, self.n_upper_ = len(scores), split.n_upper
        return self

    def judge(
        self,
        scores: Mapping[str, float | None],
        abstained: Mapping[str, str],
        words: Mapping[str, str],
        episode: str = "",
    ) -> tuple[Verdict, str]:
        """Say which group the score is in."""
        score = self._score(scores, abstained)
        if isinstance(score, str):
            return "review", score
        if not hasattr(self, "cut_"):
            raise NotFittedError("rule 'gap' has seen no dataset: fit it first")
        if self.cut_ is None:
            return "review", f"{self.scorer}: no two groups among {self.n_} episodes: {self.why_}"
        shown, limit = _told_apart(score, self.cut_)
        if self.doubt_[0] < score < self.doubt_[1]:
            return "review", f"{self.scorer} {shown} lies between the two groups (cut {limit})"
        keep = score > self.cut_
        size = self.n_upper_ if keep else self.n_ - self.n_upper_
        group = f"the {'upper' if keep else 'lower'} group, {size} of {self.n_}, cut {limit}"
        text = f"{self.scorer} {shown} is in {group}"
        if not keep and self.scorer in words:
            text = f"{words[self.scorer]}; {text}"
        return ("keep" if keep else "discard"), text

    @property
    def cut(self) -> float | None:
        """Where the groups part."""
        fitted: float | None = getattr(self, "cut_", None)
        return fitted

    def describe(self) -> str:
        """The method, and what it found."""
        found = f": {self.why_}" if hasattr(self, "why_") else ""
        return f"keep the upper group by {self.scorer} ({self.method}{found})"


def _by_id(episode_id: str) -> str:
    return tie_key(0, episode_id)


def _enough(rule: Rule, scores: Mapping[str, float]) -> None:
    if len(scores) < rule.min_episodes:
        raise EpisodeError(
            f"the rule needs {rule.min_episodes} scored episodes; there are {len(scores)}"
        )


def _told_apart(a: float, b: float) -> tuple[str, str]:
    """Two numbers with two decimals, or as many as it takes to tell them apart."""
    for digits in range(2, 17):
        first, second = f"{a:.{digits}f}", f"{b:.{digits}f}"
        if first != second or a == b:
            return first, second
    return repr(a), repr(b)


#: Name -> class. The only list of rules.
RULES: dict[str, type[Rule]] = {
    "evidence": Evidence,
    "threshold": Threshold,
    "top-fraction": TopFraction,
    "top-k": TopK,
    "gap": Gap,
    "none": NoRule,
}
