"""Scorers: each judges one episode; higher is better. `SCORERS` is the only list of them."""

from __future__ import annotations

from curation_ros.core.scorers.ensemble import Ensemble
from curation_ros.core.scorers.entropy import Entropy
from curation_ros.core.scorers.grip_consistency import GripConsistency
from curation_ros.core.scorers.gripper_timing import GripperTiming
from curation_ros.core.scorers.isolation_forest import IsolationForest, LabelFreeIsolationForest
from curation_ros.core.scorers.knn import LabelFreeNearestNeighbours, NearestNeighbours
from curation_ros.core.scorers.length import Length
from curation_ros.core.scorers.object_coupling import ObjectCoupling
from curation_ros.core.scorers.phase_events import PhaseEvents
from curation_ros.core.scorers.pool import PoolScorer
from curation_ros.core.scorers.scorer import Abstain, Look, Need, Scorer
from curation_ros.core.scorers.smoothness import Smoothness
from curation_ros.core.scorers.trajectory_alignment import (
    LabelFreeTrajectoryAlignment,
    TrajectoryAlignment,
)

__all__ = ["DEFAULT_SCORERS", "SCORERS", "Abstain", "Look", "Need", "PoolScorer", "Scorer"]

#: Name -> class: those of the paper in its order, the baseline, those of what became of the
#: object, the label-free twins.
SCORERS: dict[str, type[Scorer]] = {
    "smoothness": Smoothness,
    "entropy": Entropy,
    "gripper_timing": GripperTiming,
    "isolation_forest": IsolationForest,
    "ensemble": Ensemble,
    "knn": NearestNeighbours,
    "trajectory_alignment": TrajectoryAlignment,
    "length": Length,
    "object_coupling": ObjectCoupling,
    "grip_consistency": GripConsistency,
    "phase_events": PhaseEvents,
    "isolation_forest_label_free": LabelFreeIsolationForest,
    "knn_label_free": LabelFreeNearestNeighbours,
    "trajectory_alignment_label_free": LabelFreeTrajectoryAlignment,
}

#: What scores where nothing is asked for: a twin needs the whole dataset, so it must be asked for.
DEFAULT_SCORERS = tuple(name for name, scorer in SCORERS.items() if scorer.needs != "dataset")
