"""Copies are found by content alone."""

from __future__ import annotations

from dataclasses import replace

from curation_ros.batch.copies import Copies
from curation_ros.core.decision.examination import Examination
from curation_ros.core.episode.findings import Finding

FIRST = Examination("a", "pick-1", 5, (0, 9), {}, content="ab" * 32)


def test_copy_is_found_by_its_content() -> None:
    copies = Copies()
    assert copies.note(FIRST) == FIRST
    assert copies.note(replace(FIRST, episode="b", content="cd" * 32)).findings == ()
    [found] = copies.note(replace(FIRST, episode="c")).findings
    assert (found.id, found.message) == ("duplicate", "same content as episode a")
    [found] = copies.note(FIRST).findings
    assert found.message == "the same episode is there more than once"


def test_empty_episodes_are_no_copies() -> None:
    copies = Copies()
    copies.note(FIRST)
    empty = replace(FIRST, episode="d", steps=0)
    assert copies.note(empty) == empty


def test_bad_copy_does_not_make_the_good_one_a_copy() -> None:
    copies = Copies()
    bad = replace(FIRST, findings=(Finding("gap", "silent", (0, 9)),))
    assert copies.note(bad) == bad
    assert copies.note(replace(FIRST, episode="b")).findings == ()
