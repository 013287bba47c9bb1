"""Findings: what was noticed about an episode, with a stable id, a kind and a time span."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["recording", "motion", "task"]

#: Every finding that there is: id -> (kind, what it means). The only list; docs are made from it.
FINDINGS: dict[str, tuple[Kind, str]] = {
    "aborted": ("recording", "the owner of the episode gave it up"),
    "clock-back": ("recording", "stamps of a topic went back inside the episode"),
    "duplicate-stamp": ("recording", "two samples of one topic and stamp have different values"),
    "gap": ("recording", "a topic was silent for longer than max_gap_s"),
    "gripper-meaning": ("recording", "the fingers contradict the declared meaning of the gripper"),
    "incomplete": ("recording", "fewer samples than the owner of the episode counted"),
    "missing-topic": ("recording", "a mapped topic has no sample"),
    "not-finite": ("recording", "a value is NaN or infinite"),
    "recovered": ("recording", "the bag was recovered after its recorder died"),
    "unknown-loss": (
        "recording",
        "a topic has several publishers: lost messages cannot be counted",
    ),
    "unknown-phase": ("recording", "a phase name is not in the topic map"),
    "undecodable": ("recording", "messages of a topic do not fit its declared type"),
    "no-bag": ("recording", "the bag could not be read; the live episode stands"),
}


@dataclass(frozen=True)
class Finding:
    """Something noticed about an episode; spans are nanoseconds from its start stamp."""

    id: str
    message: str
    span: tuple[int, int]

    @property
    def kind(self) -> Kind:
        """Broken recording, odd motion or failed task: never mixed."""
        return FINDINGS[self.id][0]

    def to_json(self) -> dict[str, object]:
        """As printed by `curation score`."""
        return {
            "id": self.id,
            "kind": self.kind,
            "message": self.message,
            "span": list(self.span),
        }
