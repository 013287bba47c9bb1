"""Outcomes of rollouts for tests."""

from __future__ import annotations


def outcomes(rows: list[list[int]]) -> dict[tuple[int, str], bool]:
    """Outcome by (seed, start), from one row of zeros and ones per seed."""
    return {
        (seed, f"start-{k}"): bool(one)
        for seed, row in enumerate(rows)
        for k, one in enumerate(row)
    }
