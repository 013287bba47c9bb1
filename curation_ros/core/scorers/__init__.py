"""Scorers: each scores one episode; higher is better. `registry` knows which there are."""

from __future__ import annotations

from curation_ros.core.scorers.pool import PoolScorer
from curation_ros.core.scorers.registry import (
    DEFAULT_SCORERS,
    SCORERS,
    all_scorers,
    find_scorer,
    is_scorer,
    scorer_names,
)
from curation_ros.core.scorers.scorer import Abstain, Look, Need, Scorer

__all__ = [
    "DEFAULT_SCORERS",
    "SCORERS",
    "Abstain",
    "Look",
    "Need",
    "PoolScorer",
    "Scorer",
    "all_scorers",
    "find_scorer",
    "is_scorer",
    "scorer_names",
]
