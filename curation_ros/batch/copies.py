"""Episodes that are there more than once, under whatever names."""

from __future__ import annotations

from dataclasses import replace

from curation_ros.core.decision.examination import Examination
from curation_ros.core.episode.findings import Finding


class Copies:
    """Finds episodes with the content of another one, in the order in which they come."""

    def __init__(self) -> None:
        """No episode was noted yet."""
        self._first: dict[bytes, tuple[str, str]] = {}

    def note(self, examination: Examination) -> Examination:
        """The examination, with a finding if an earlier one has the same content."""
        if not examination.content or not examination.steps:
            return examination
        # Eight bytes, because tens of thousands of episodes must fit into little memory.
        key = bytes.fromhex(examination.content[:16])
        original = self._first.get(key)
        if original is not None:
            return with_copy(examination, original)
        if examination.is_trusted:  # a bad copy does not make the good one a copy
            self._first[key] = (examination.episode, examination.name)
        return examination


def with_copy(examination: Examination, original: tuple[str, str]) -> Examination:
    """An examination with the finding that another episode has the same content.

    Args:
        examination: of the copy.
        original: id and short name of the other episode.
    """
    # The message has the id alone, because the name may not be known yet.
    message = (
        "the same episode is there more than once"
        if original[0] == examination.episode
        else f"same content as episode {original[0]}"
    )
    finding = Finding("duplicate", message, examination.span)
    return replace(examination, findings=(*examination.findings, finding))
