"""Scorers: each judges one episode; higher is better. `SCORERS` is the only list of them."""

from __future__ import annotations

from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.entropy import Entropy
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.isolation_forest import IsolationForest
from curation_ros.core.scorers.knn import NearestNeighbours
from curation_ros.core.scorers.length import Length
from curation_ros.core.scorers.scorer import Abstain, Need, Scorer
from curation_ros.core.scorers.smoothness import Smoothness
from curation_ros.core.scorers.trajectory_alignment import TrajectoryAlignment

__all__ = ["SCORERS", "Abstain", "Need", "Scorer"]

#: Name -> class, in the order of the paper, then our own.
SCORERS: dict[str, type[Scorer]] = {
    "smoothness": Smoothness,
    "entropy": Entropy,
    "gripper_timing": GripperTiming,
    "isolation_forest": IsolationForest,
    "ensemble": Ensemble,
    "knn": NearestNeighbours,
    "trajectory_alignment": TrajectoryAlignment,
    "length": Length,
}
