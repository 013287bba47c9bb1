"""Findings: what was found in an episode, with a stable id, a kind and a time span."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

Kind = Literal["recording", "motion", "task"]

#: Every finding: id -> (kind, what it means). The only list; docs are made from it. After a fault
#: of the recording the data do not show what happened, and the episode is not judged. Odd motion
#: is unusual, and a failed task shows no success. Neither keeps an episode from being judged.
FINDINGS: dict[str, tuple[Kind, str]] = {
    # The file: it could not be read, or not as an episode (`CurationError.finding`).
    "ambiguous": ("recording", "more than one file, topic or definition would do"),
    "bad-config": ("recording", "a topic map or parameter makes no sense for these data"),
    "bad-definition": ("recording", "the definition of a message type cannot be read"),
    "bad-metadata": ("recording", "what the recorder noted in the bag makes no sense"),
    "checksum": ("recording", "a checksum is wrong: bytes have changed since the recording"),
    "empty-file": ("recording", "the file has 0 bytes"),
    "foreign-encoding": ("recording", "messages or schemas are in an encoding that is not ours"),
    "foreign-format": ("recording", "the file is something else than MCAP, and known"),
    "malformed": ("recording", "lengths or indexes in the file contradict its bytes"),
    "missing-file": ("recording", "a file that should be there is not"),
    "no-clock": ("recording", "the clock topic has no message: nothing says when it happened"),
    "no-header": ("recording", "a type has no header although its stamp is to be read there"),
    "no-topic-map": ("recording", "the bag has no topic map and none was given"),
    "not-mcap": ("recording", "the file does not begin as MCAP does"),
    "too-large": ("recording", "it claims more bytes than are ever read"),
    "truncated": ("recording", "the file ends before its end"),
    "unknown-channel": ("recording", "messages belong to a channel that nothing describes"),
    "unreadable": ("recording", "the file cannot be opened or read"),
    "unsupported-compression": ("recording", "compressed in a way that is not read"),
    "unusable": ("recording", "no episode could be made of it"),
    "wrong-id": ("recording", "the folder is named after another episode than the bag is of"),
    "wrong-type": ("recording", "a topic has another type than the topic map says"),
    # The samples: found by the builder, the owner of the episode or the recorder.
    "aborted": ("recording", "the owner of the episode gave it up"),
    "clock-back": ("recording", "stamps of a topic went back inside the episode"),
    "duplicate-stamp": ("recording", "two samples of one topic and stamp have different values"),
    "gap": ("recording", "a topic was silent for longer than max_gap_s"),
    "gripper-meaning": ("recording", "the data contradict the declared meaning of the gripper"),
    "incomplete": ("recording", "fewer samples than the owner of the episode counted"),
    "missing-topic": ("recording", "a mapped topic has no sample"),
    "no-bag": ("recording", "the bag could not be read; the live episode stands"),
    "not-finite": ("recording", "a value is NaN or infinite"),
    "recovered": ("recording", "the bag was recovered after its recorder died"),
    "undecodable": ("recording", "messages of a topic do not fit its declared type"),
    "unknown-loss": (
        "recording",
        "a topic has several publishers: lost messages cannot be counted",
    ),
    "unknown-phase": ("recording", "a phase name is not in the topic map"),
    # The arrays: found by `checks.check_episode`; `duplicate` among several episodes.
    "clipped-start": ("recording", "it begins in mid-motion: its beginning was not recorded"),
    "duplicate": ("recording", "another episode has the same values at the same times"),
    "frozen": ("recording", "a measured topic repeats one value while the robot moves"),
    "padded-tail": ("recording", "it ends with copies of one row, or with zeros"),
    "rate": ("recording", "the clock is irregular, or not at the rate of the reference"),
    "too-short": ("recording", "too few steps to be a demonstration"),
    "idle": ("motion", "the robot rests for long and then goes on"),
    "jump": ("motion", "the effector moves from one step to the next as no other step does"),
    "grip-lost": ("task", "the fingers held nothing while something was to be carried"),
    "never-grasped": ("task", "the gripper was never commanded to close"),
    "not-carried": ("task", "what the gripper closed on did not come along"),
    "object-lost": ("task", "what was grasped left the effector before it was to be let go"),
    "opened-early": ("task", "the gripper opened before the task was at that point"),
    "unfinished": ("task", "the last phase or the release was never reached"),
}


@dataclass(frozen=True)
class Finding:
    """Something found in an episode; its span is in nanoseconds from the start stamp."""

    id: str
    message: str
    span: tuple[int, int]

    @property
    def kind(self) -> Kind:
        """Fault of the recording, odd motion or failed task."""
        return FINDINGS[self.id][0]

    def to_json(self) -> dict[str, object]:
        """As printed by `curation score`."""
        return {
            "id": self.id,
            "kind": self.kind,
            "message": self.message,
            "span": list(self.span),
        }

    @classmethod
    def from_json(cls, raw: Mapping[str, Any]) -> Finding:
        """Read what `to_json` wrote.

        Raises:
            KeyError, TypeError, ValueError: if it is no finding.
        """
        first, last = raw["span"]
        return cls(str(raw["id"]), str(raw["message"]), (int(first), int(last)))
