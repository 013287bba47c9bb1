"""The manifest: a selection on disk, and all that training reads."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from curation_ros.core.decision.balance import Balance
from curation_ros.core.errors import ConfigError
from curation_ros.core.types import Span


@dataclass(frozen=True)
class Entry:
    """A selected episode; `span` None is the whole, else nanoseconds from its start, inclusive."""

    episode: str
    name: str
    span: Span | None = None


@dataclass(frozen=True)
class Manifest:
    """A selection on disk: all that training reads.

    Attributes:
        name: decides the file name.
        created_at: ISO 8601.
        dataset: where the episodes are, as the writer named it.
        scorer: scorer that ranked, empty where none did.
        rule: one of RULES, or the name of another source (`oracle`, `random`).
        rule_params: its value, seed and the like, as plain JSON.
        state_hash: fitted states that the scores or decisions come from, empty where none.
        entries: what is kept; an episode may appear with several spans.
        kept_of: number of episodes chosen from.
        abstained: ids of the episodes that the rule could not decide on.
        phases: how much of each phase the entries show; None where they were not counted.
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
                raise ConfigError(
                    f"{where}: episode {entry.episode}: span {entry.span} makes no sense"
                )
        n_episodes = len({e.episode for e in self.entries})
        if n_episodes > self.kept_of:
            raise ConfigError(f"{where}: {n_episodes} episodes kept of {self.kept_of}")

    def warnings(self) -> list[str]:
        """What is to be known before training on it, one line each."""
        lines = [] if self.phases is None else self.phases.warnings()
        asked = self.rule_params.get("value")
        if self.rule == "top-k" and asked is not None and len(self.entries) < asked:
            lines.insert(
                0,
                f"top-k {asked:g} keeps {len(self.entries)}: no other of the {self.kept_of} "
                "episodes has a score that counts",
            )
        return lines

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
        """Check and read what `to_json` wrote; unknown keys are ignored.

        Raises:
            ConfigError: if a key is missing or a value makes no sense.
        """
        if not isinstance(raw, Mapping):
            raise ConfigError(f"selection: expected a mapping, found {raw!r:.80}")
        if "entries" not in raw:
            raise ConfigError(
                "not a selection: expected a file that `curation select` writes into "
                f"DATASET/selections, found {', '.join(map(str, raw)) or 'no keys':.80}"
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
