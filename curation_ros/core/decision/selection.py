"""Selections: which episodes a policy is trained on, and the manifest that says so."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from curation_ros.core.decision.balance import Balance
from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.decision.groups import split_scores
from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.core.types import Span

TieKey = Callable[[str], str]

#: Rule -> what `value` means to it. The only list; the command line is made from it. All but
#: `all` leave out what a person has discarded or wants reviewed; what the curator has decided
#: counts for `decisions` alone.
KEEP_RULES: dict[str, str] = {
    "decisions": "keep what was decided to keep, and the spans to salvage; no value",
    "top-fraction": "keep the best share of the scored episodes, value from 0 to 1",
    "top-k": "keep the best, value a number of episodes",
    "threshold": "keep scores at or above the value",
    "gap": "keep the upper of two clearly separated groups; no value",
    "all": "keep every episode; no value",
}


@dataclass(frozen=True)
class Candidate:
    """An episode that may be selected.

    Attributes:
        episode, name: its identity.
        score: higher is better; None where the scorer abstained or was not asked.
        decision: the decision in force, None where there is none.
    """

    episode: str
    name: str
    score: float | None = None
    decision: Decision | None = None

    @property
    def is_refused(self) -> bool:
        """Whether a person has discarded it, or keeps it for review: no score outranks that."""
        decision = self.decision
        if decision is None or decision.by == CURATOR:
            return False
        return decision.verdict in ("review", "discard")


@dataclass(frozen=True)
class Entry:
    """A selected episode; `span` None is the whole, else nanoseconds from its start, inclusive."""

    episode: str
    name: str
    span: Span | None = None


@dataclass(frozen=True)
class Selection:
    """What a rule made of the candidates.

    Attributes:
        entries: what is kept, best first; where nothing ranks, in the order of the tie keys.
        abstained: ids of the episodes that the rule had nothing to judge by, or that lie between
            the groups of `gap`; not kept, except by the rule `all`, which asks for nothing.
        kept_of: number of candidates.
    """

    entries: tuple[Entry, ...]
    abstained: tuple[str, ...]
    kept_of: int


def tie_key(seed: int, *identity: object) -> str:
    """Key that orders episodes of equal score, by nothing but a hash.

    Args:
        seed: seed of the selection.
        identity: (task, start, repetition) where they are known, else the episode's id: never a
            time, a path or a running number of the collection.
    """
    text = "\x1f".join(str(part) for part in (seed, *identity))
    return hashlib.sha256(text.encode()).hexdigest()


def select(
    candidates: Iterable[Candidate],
    rule: str,
    value: float | None = None,
    *,
    seed: int = 0,
    tie: TieKey | None = None,
    resolution: float = 0.0,
) -> Selection:
    """Choose episodes by a keep rule.

    Args:
        candidates: the episodes to choose from; their order does not matter.
        rule: one of KEEP_RULES.
        value: what the rule takes.
        seed: seed of the tie keys.
        tie: episode id -> key that orders equal scores; by default `tie_key(seed, id)`. Where
            task, start and repetition are known, `tie_key(seed, task, start, repetition)`.
        resolution: difference in score that counts as none (`Scorer.resolution`), for `gap`.

    Raises:
        ConfigError: if the rule does not exist, its value makes no sense, an episode is there
            twice or has a score that is not finite, or top-k asks for more than are scored.
        CurationError: if gap finds no two groups.
    """
    pool = list(candidates)
    _check_candidates(pool)
    if rule not in KEEP_RULES:
        raise ConfigError(f"no keep rule {rule!r}; there are {', '.join(KEEP_RULES)}")
    _check_value(rule, value)
    by_id = _by_id(seed)
    first_key = tie or by_id

    def ties(candidate: Candidate) -> tuple[str, str]:
        return first_key(candidate.episode), by_id(candidate.episode)

    pool.sort(key=ties)
    if rule == "all":
        return Selection(tuple(Entry(c.episode, c.name) for c in pool), (), len(pool))
    if rule == "decisions":
        entries = tuple(
            Entry(c.episode, c.name, c.decision.span if c.decision.verdict == "salvage" else None)
            for c in pool
            if c.decision is not None and c.decision.verdict in ("keep", "salvage")
        )
        silent = tuple(c.episode for c in pool if c.decision is None)
        return Selection(entries, silent, len(pool))
    known = {c.episode: c for c in pool}
    pool = [c for c in pool if not c.is_refused]
    scores = {c.episode: c.score for c in pool if c.score is not None}
    silent = tuple(c.episode for c in pool if c.score is None)
    order = ranking(scores, lambda i: ties(known[i]))
    if rule == "gap":
        split = split_scores(list(scores.values()), resolution=resolution)
        if split.cut is None:
            raise CurationError(
                f"keep rule 'gap': no two groups to choose from: {split.why}; nothing is "
                "selected: have a person review the episodes, or choose by another rule and its "
                "value (top-fraction, top-k, threshold)"
            )
        low, high = split.doubt
        silent += tuple(i for i in order if low < scores[i] < high)
        order = [i for i in order if scores[i] > split.cut and i not in silent]
        n_kept = len(order)
    elif rule == "threshold":
        n_kept = sum(score >= float(value or 0.0) for score in scores.values())
    else:
        n_kept = keep_count(rule, value, len(order))
        if n_kept > len(order):
            raise ConfigError(
                f"top-k {n_kept}: only {len(order)} of {len(known)} episodes have a score"
            )
    kept = tuple(Entry(i, known[i].name) for i in order[:n_kept])
    return Selection(kept, silent, len(known))


def ranking(scores: Mapping[str, float], tie: Callable[[str], Any]) -> list[str]:
    """Ids from the best score to the worst, equal scores in the order of their tie keys.

    Args:
        scores: id -> score.
        tie: id -> key that can be ordered.
    """
    return sorted(scores, key=lambda i: (-scores[i], tie(i)))


def keep_count(rule: str, value: float | None, n: int) -> int:
    """How many of n ranked episodes a rule keeps; `top-k` may ask for more than there are.

    Raises:
        ConfigError: if the rule takes no such value.
    """
    _check_value(rule, value)
    if rule == "top-k":
        return int(value or 0)
    return math.floor(float(value or 0.0) * n + 0.5)


def _by_id(seed: int) -> TieKey:
    def key(episode_id: str) -> str:
        return tie_key(seed, episode_id)

    return key


def _check_candidates(pool: Sequence[Candidate]) -> None:
    seen = set()
    for candidate in pool:
        if candidate.episode in seen:
            raise ConfigError(f"selection: episode {candidate.episode} is there twice")
        seen.add(candidate.episode)
        if candidate.score is not None and not math.isfinite(candidate.score):
            raise ConfigError(
                f"selection: episode {candidate.episode} has the score {candidate.score}; "
                "one that abstained has None"
            )


def _check_value(rule: str, value: float | None) -> None:
    good = {
        "decisions": value is None,
        "all": value is None,
        "top-fraction": value is not None and 0 < value <= 1,
        "top-k": value is not None and value >= 1 and float(value).is_integer(),
        "threshold": value is not None and math.isfinite(value),
        "gap": value is None,
    }
    if not good[rule]:
        raise ConfigError(f"keep rule {rule!r} with value {value!r}: {KEEP_RULES[rule]}")


@dataclass(frozen=True)
class Manifest:
    """A selection on disk: all that training reads.

    Attributes:
        name: decides the file name.
        created_at: ISO 8601.
        dataset: where the episodes are, as the writer named it.
        scorer: scorer that ranked, empty where none did.
        rule: one of KEEP_RULES, or a word of whoever made the selection (`oracle`, `random`).
        rule_params: its value, seed and the like, as plain JSON.
        state_hash: fitted state that the scores or decisions come from, empty where none.
        entries: what is kept; an episode may appear with several spans.
        kept_of: number of episodes chosen from.
        abstained: ids of those that could not be judged.
        phases: how much of each phase the entries show; None where nobody has counted.
    """

    name: str
    created_at: str
    dataset: str
    scorer: str
    rule: str
    entries: tuple[Entry, ...]
    kept_of: int
    rule_params: Mapping[str, Any] = field(default_factory=dict)
    state_hash: str = ""
    abstained: tuple[str, ...] = ()
    phases: Balance | None = None

    def __post_init__(self) -> None:
        where = f"selection {self.name!r}"
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", self.name):
            raise ConfigError(f"{where}: a name has letters, digits, '.', '_' and '-' only")
        try:
            # Python 3.10 does not read the Z of ISO 8601.
            datetime.fromisoformat(self.created_at.replace("Z", "+00:00"))
        except ValueError:
            raise ConfigError(f"{where}: created_at {self.created_at!r} is not ISO 8601") from None
        if not self.rule:
            raise ConfigError(f"{where}: no rule")
        if len(set(self.entries)) < len(self.entries):
            raise ConfigError(f"{where}: an entry is there twice")
        for entry in self.entries:
            if not entry.episode:
                raise ConfigError(f"{where}: an entry has no episode id")
            if entry.span is not None and not 0 <= entry.span[0] <= entry.span[1]:
                raise ConfigError(f"{where}: episode {entry.episode}: span {entry.span} is none")
        n_episodes = len({e.episode for e in self.entries})
        if n_episodes > self.kept_of:
            raise ConfigError(f"{where}: {n_episodes} episodes kept of {self.kept_of}")

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal manifest."""
        return {
            "name": self.name,
            "created_at": self.created_at,
            "dataset": self.dataset,
            "scorer": self.scorer,
            "rule": self.rule,
            "rule_params": dict(self.rule_params),
            "state_hash": self.state_hash,
            "kept_of": self.kept_of,
            "entries": [
                {
                    "episode": e.episode,
                    "name": e.name,
                    "span": None if e.span is None else list(e.span),
                }
                for e in self.entries
            ],
            "abstained": list(self.abstained),
            **({"phases": self.phases.to_json()} if self.phases is not None else {}),
        }

    @classmethod
    def from_json(cls, raw: object) -> Manifest:
        """Check and read what `to_json` wrote; keys that it does not know are left alone.

        Raises:
            ConfigError: if a key is missing or a value makes no sense.
        """
        if not isinstance(raw, Mapping):
            raise ConfigError(f"selection: expected a mapping, found {raw!r:.80}")
        if "entries" not in raw:
            raise ConfigError(
                "no selection: expected what `curation select` writes into DATASET/selections, "
                f"found a file with {', '.join(map(str, raw)) or 'nothing in it':.80}"
            )
        try:
            return cls(
                name=str(raw["name"]),
                created_at=str(raw["created_at"]),
                dataset=str(raw["dataset"]),
                scorer=str(raw["scorer"]),
                rule=str(raw["rule"]),
                rule_params=dict(raw["rule_params"]),
                state_hash=str(raw["state_hash"]),
                kept_of=int(raw["kept_of"]),
                entries=tuple(
                    Entry(str(e["episode"]), str(e["name"]), _span(e["span"]))
                    for e in raw["entries"]
                ),
                abstained=tuple(str(i) for i in raw["abstained"]),
                phases=Balance.from_json(raw["phases"]) if "phases" in raw else None,
            )
        except (KeyError, TypeError, ValueError) as err:
            raise ConfigError(f"selection: {type(err).__name__} {err} in {raw!r:.200}") from err


def _span(raw: Sequence[int] | None) -> Span | None:
    if raw is None:
        return None
    first, last = raw
    return int(first), int(last)
