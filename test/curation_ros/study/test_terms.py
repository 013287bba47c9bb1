from __future__ import annotations

import pytest

from curation_ros.core.errors import ConfigError
from curation_ros.study.terms import Term, parse_row


def test_rows_are_read_term_by_term() -> None:
    assert parse_row("reference + knn@16") == (Term("reference"), Term("knn", 16))
    assert parse_row("random@16#3") == (Term("random", 16, 3),)
    assert parse_row("button%10") == (Term("button", wrong=10),)
    assert parse_row("oracle") == (Term("oracle"),)
    assert parse_row("random@16")[0].is_drawn
    assert not parse_row("random@16#0")[0].is_drawn
    assert parse_row("decided+salvaged-15") == (Term("decided"), Term("salvaged", margin=15))
    assert parse_row("salvaged-0")[0].margin == 0
    assert parse_row("salvaged")[0].margin is None
    assert parse_row("random_cut")[0].is_drawn
    assert parse_row("oracle+more@16") == (Term("oracle"), Term("more", 16))


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("knn", "knn needs a number to keep"),
        ("knn@0", "knn needs a number to keep"),
        ("everything@3", "everything takes no @K"),
        ("nobody@3", "unknown term 'nobody@3'; known are everything"),
        ("knn@3#1", "knn has no draws"),
        ("button", "%P is for button"),
        ("knn@3%10", "%P is for button"),
        ("decided-15", "-M is for salvaged"),
        ("decided@3", "decided takes no @K"),
        ("salvaged#2", "salvaged has no draws"),
        ("more", "more needs a number to keep"),
        ("", "unknown term ''"),
        ("knn@16+", "unknown term ''"),
    ],
)
def test_invalid_rows_are_named(row: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_row(row)
