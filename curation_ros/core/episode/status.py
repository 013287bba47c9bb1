"""The one place that writes and reads the keys of our DiagnosticStatus messages (no ROS needed).

Integers are decimal, floats are `repr`, an abstained score is the empty string.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

from curation_ros.core.episode.findings import FINDINGS, Finding
from curation_ros.core.errors import EpisodeError

OK, WARN, ERROR = 0, 1, 2
_COUNT, _SCORE = "count/", "score/"

EventKind = Literal["started", "ended", "aborted"]


@dataclass(frozen=True)
class Status:
    """A diagnostic_msgs/DiagnosticStatus as plain data; `level` is 0 OK, 1 WARN or 2 ERROR."""

    level: int
    name: str
    message: str
    hardware_id: str = ""
    values: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class EpisodeEvent:
    """An event of the topic `episode`; only its owner decides where an episode starts and ends.

    Attributes:
        id, name: identity of the episode.
        event: started, ended or aborted.
        start_ns, end_ns: window, inclusive; end_ns is None until the end.
        counts: topic of the map -> number of distinct stamps in the window, at the end.
        source: live or replay.
        reason: why it was aborted, and what the owner knows about the recording, see
            `owner_findings`.
    """

    id: str
    name: str
    event: EventKind
    start_ns: int
    end_ns: int | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    source: str = "live"
    reason: str = ""


def _stamp(raw: Any) -> int:
    stamp_ns = int(raw)
    if not 0 <= stamp_ns < 1 << 63:
        raise ValueError(f"stamp {stamp_ns} is not from 0 to 2**63")
    return stamp_ns


def event_to_status(event: EpisodeEvent) -> Status:
    """Write an episode event."""
    values = {"start_stamp": str(event.start_ns), "source": event.source}
    if event.end_ns is not None:
        values["end_stamp"] = str(event.end_ns)
    values |= counts_to_values(event.counts)
    if event.reason:
        values["reason"] = event.reason
    level = ERROR if event.event == "aborted" else OK
    return Status(level, event.name, event.event, event.id, values)


def event_from_status(status: Status) -> EpisodeEvent:
    """Read an episode event.

    Raises:
        EpisodeError: if it is none, naming what was found.
    """
    kind = status.message
    if kind not in get_args(EventKind) or not status.hardware_id:
        raise EpisodeError(
            f"episode event {kind!r} of {status.hardware_id!r}: expected started, ended or "
            "aborted, and an episode id"
        )
    try:
        end = status.values.get("end_stamp")
        return EpisodeEvent(
            id=status.hardware_id,
            name=status.name,
            event=kind,  # type: ignore[arg-type]  # checked above
            start_ns=_stamp(status.values["start_stamp"]),
            end_ns=None if end is None else _stamp(end),
            counts=counts_from_status(status),
            source=status.values.get("source", "live"),
            reason=status.values.get("reason", ""),
        )
    except (KeyError, ValueError) as err:
        raise EpisodeError(
            f"episode event of {status.hardware_id}: {type(err).__name__} {err} "
            f"in {dict(status.values)}"
        ) from err


def counts_to_values(counts: Mapping[str, int]) -> dict[str, str]:
    """Write the number of samples per topic."""
    return {_COUNT + topic: str(n) for topic, n in sorted(counts.items())}


def counts_from_status(status: Status) -> dict[str, int]:
    """Read the number of samples per topic.

    Raises:
        ValueError: if one is no number.
    """
    return {
        k.removeprefix(_COUNT): int(v) for k, v in status.values.items() if k.startswith(_COUNT)
    }


def event_to_json(event: EpisodeEvent) -> dict[str, Any]:
    """As the recorder stores it in a bag's custom data."""
    return {
        "id": event.id,
        "name": event.name,
        "event": event.event,
        "start_stamp": event.start_ns,
        "end_stamp": event.end_ns,
        "counts": dict(event.counts),
        "source": event.source,
        "reason": event.reason,
    }


def event_from_json(raw: Mapping[str, Any]) -> EpisodeEvent:
    """Read what `event_to_json` wrote.

    Raises:
        EpisodeError: if a key is missing or has the wrong type.
    """
    try:
        end = raw["end_stamp"]
        if raw["event"] not in get_args(EventKind) or not raw["id"]:
            raise ValueError(f"event {raw['event']!r} of id {raw['id']!r}")
        return EpisodeEvent(
            id=str(raw["id"]),
            name=str(raw["name"]),
            event=raw["event"],
            start_ns=_stamp(raw["start_stamp"]),
            end_ns=None if end is None else _stamp(end),
            counts={str(k): int(v) for k, v in raw["counts"].items()},
            source=str(raw["source"]),
            reason=str(raw.get("reason", "")),
        )
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as err:
        raise EpisodeError(f"episode record: {type(err).__name__} {err} in {raw!r:.200}") from err


def owner_findings(event: EpisodeEvent) -> list[Finding]:
    """Findings that no sample shows, from the lines `id: message` of an event's `reason`.

    They travel with the event, so live, replayed and offline episodes have the same ones.
    """
    whole = (0, max(0, (event.end_ns or event.start_ns) - event.start_ns))
    found = []
    for line in filter(None, event.reason.splitlines()):
        finding_id, _, message = line.partition(": ")
        if finding_id in FINDINGS:
            found.append(Finding(finding_id, message, whole))
        elif event.event == "aborted":
            found.append(Finding("aborted", line, whole))
    if event.event == "aborted" and not any(f.id == "aborted" for f in found):
        found.append(Finding("aborted", "the owner gave no reason", whole))
    return found


def phase_to_status(episode_id: str, label: str, index: int, progress: float) -> Status:
    """Write a phase."""
    values = {"index": str(index), "progress": repr(float(progress))}
    return Status(OK, "phase", label, episode_id, values)


def alert_to_status(episode_id: str, name: str, finding: Finding) -> Status:
    """Write an alert: what went wrong while the episode runs."""
    values = {
        "reason": finding.message,
        "span_start": str(finding.span[0]),
        "span_end": str(finding.span[1]),
    }
    return Status(ERROR, name, finding.id, episode_id, values)


#: Verdict -> level of its status.
VERDICT_LEVEL = {"keep": OK, "salvage": WARN, "review": WARN, "discard": ERROR}


def decision_to_status(
    *,
    episode_id: str,
    name: str,
    verdict: str,
    reason: str,
    span: tuple[int, int],
    revision: int,
    scores: Mapping[str, float | None],
) -> Status:
    """Write a decision; spans are nanoseconds from the episode's start."""
    values = {
        "verdict": verdict,
        "reason": reason,
        "span_start": str(span[0]),
        "span_end": str(span[1]),
        "revision": str(revision),
    }
    values |= {_SCORE + k: "" if v is None else repr(float(v)) for k, v in scores.items()}
    return Status(VERDICT_LEVEL[verdict], name, verdict, episode_id, values)
