"""How much of each phase of a task a set of demonstrations shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from curation_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from curation_ros.core.episode.episode import Episode

#: A phase that a smaller share of the demonstrations shows than this one is worth a warning.
LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Shown:
    """How many demonstrations have a step of a phase, and their steps in all."""

    demonstrations: int
    steps: int


@dataclass(frozen=True)
class Balance:
    """What a set of demonstrations shows of each phase.

    Attributes:
        n: demonstrations in the set.
        n_known: those of them whose phases are known.
        phases: name -> how much is shown of it, for all phases of their topic maps.
    """

    n: int
    n_known: int
    phases: Mapping[str, Shown]

    def warnings(self) -> list[str]:
        """A line for people about each phase that too few demonstrations show."""
        return [
            f"{name} is shown by {shown.demonstrations} of {self.n_known} demonstrations kept: "
            "a policy sees little of it; record more demonstrations that reach it, or check "
            "whether some were cut too early or left out wrongly"
            for name, shown in self.phases.items()
            if shown.demonstrations < LEAST_SHARE * self.n_known
        ]

    def describe(self) -> str:
        """One line for people."""
        if not self.n_known:
            return "phases: unknown, because the topic map names none"
        shown = ", ".join(f"{name} {s.demonstrations}" for name, s in self.phases.items())
        missing = self.n - self.n_known
        unknown = f"; unknown for {missing} others" if missing else ""
        return f"phases shown by {self.n_known} demonstrations: {shown}{unknown}"

    def to_json(self) -> dict[str, Any]:
        """Plain data that `from_json` reads back to an equal balance."""
        return {
            "of": self.n,
            "known": self.n_known,
            "shown": {name: dict(vars(shown)) for name, shown in self.phases.items()},
        }

    @classmethod
    def from_json(cls, raw: Mapping[str, Any]) -> Balance:
        """Read what `to_json` wrote.

        Raises:
            ConfigError: if a key is missing or a value makes no sense.
        """
        try:
            shown = {
                str(name): Shown(int(s["demonstrations"]), int(s["steps"]))
                for name, s in raw["shown"].items()
            }
            return cls(int(raw["of"]), int(raw["known"]), shown)
        except (KeyError, TypeError, ValueError, AttributeError) as err:
            raise ConfigError(f"phases: {type(err).__name__} {err} in {raw!r:.200}") from err


def phase_steps(episode: Episode, span: tuple[int, int] | None = None) -> dict[str, int] | None:
    """How many steps of each phase an episode has.

    Args:
        episode: only its phase is needed.
        span: of the episode, nanoseconds from its start, inclusive; None: all of it.

    Returns:
        Every phase of its topic map -> steps, 0 where it shows none; None if the map has no phase.
    """
    part = episode if span is None else episode.within(span)
    phase = part.phase
    if phase is None:
        return None
    return {name: int((phase == k).sum()) for k, name in enumerate(part.phase_labels)}


def balance_of(parts: Iterable[tuple[str, Mapping[str, int] | None]]) -> Balance:
    """What demonstrations show together.

    Args:
        parts: pairs of an episode id and its `phase_steps`, which are None if they are unknown. An
            episode with several spans is one demonstration.
    """
    steps: dict[str, int] = {}
    showing: dict[str, set[str]] = {}
    ids, known = set(), set()
    for episode_id, counts in parts:
        ids.add(episode_id)
        if not counts:
            continue
        known.add(episode_id)
        for name, n in counts.items():
            steps[name] = steps.get(name, 0) + n
            showing.setdefault(name, set()).update({episode_id} if n else ())
    shown = {name: Shown(len(showing[name]), steps[name]) for name in steps}
    return Balance(len(ids), len(known), shown)
