"""Values that the paper published, for comparison with ours.

Source: Bedi, What Demonstration Curation Metrics Do to Your Policy, arXiv 2606.10229, 2026,
Tables I and II. The paper joined its scores with labels and demonstrations by position, in two
different orders. `joined` marks what its released scores give with the rows joined by name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class PublishedAuroc:
    """A row of Table I.

    Attributes:
        raw: AUROC on whole episodes.
        truncated: AUROC on episodes truncated to T = 324.
        joined: the latter with rows joined by name; None if it cannot be computed.
    """

    raw: float
    truncated: float
    joined: float | None

    def to_json(self) -> dict[str, Any]:
        """As `curation audit --json` prints it."""
        return {
            "raw": self.raw,
            "truncated": self.truncated,
            "truncated_joined_by_name": self.joined,
        }


#: Table I in its order: scorer -> published values.
TABLE_1: dict[str, PublishedAuroc] = {
    "length_path": PublishedAuroc(1.000, 0.500, None),
    "ensemble": PublishedAuroc(1.000, 0.761, 0.952),
    "isolation_forest": PublishedAuroc(1.000, 0.440, 0.338),
    "knn": PublishedAuroc(1.000, 0.712, 0.859),
    "trajectory_alignment": PublishedAuroc(1.000, 0.638, 0.773),
    "smoothness": PublishedAuroc(0.979, 0.447, 0.391),
    "gripper_timing": PublishedAuroc(0.957, 0.804, 0.973),
    "entropy": PublishedAuroc(0.000, 0.280, 0.139),
}


@dataclass(frozen=True)
class PublishedSuccess:
    """A row of Table II.

    Attributes:
        success: mean success over 3 seeds with 30 rollouts each.
        sd: population standard deviation over the seeds.
        gap_closed: as printed.
        auroc: AUROC at T = 324; None for the baselines.
        joined: the same with rows joined by name.
        clean_kept: number of the 20 demonstrations called clean in the released files that are
            among the 60 kept.
        clean_kept_joined: the same with rows joined by name.
    """

    success: float
    sd: float
    gap_closed: float
    auroc: float | None = None
    joined: float | None = None
    clean_kept: int | None = None
    clean_kept_joined: int | None = None


def _scored(
    name: str, success: float, sd: float, gap: float, kept: int, kept_joined: int
) -> PublishedSuccess:
    found = TABLE_1[name]
    return PublishedSuccess(success, sd, gap, found.truncated, found.joined, kept, kept_joined)


#: Table II in its order: row of a study -> published values. The last two values of a scorer are
#: computed from the released scores and selections.
TABLE_2: dict[str, PublishedSuccess] = {
    "oracle": PublishedSuccess(0.933, 0.0, 1.0),
    "ensemble": _scored("ensemble", 0.911, 0.016, 0.97, 17, 20),
    "trajectory_alignment": _scored("trajectory_alignment", 0.900, 0.0, 0.96, 16, 15),
    "entropy": _scored("entropy", 0.778, 0.126, 0.82, 11, 7),
    "smoothness": _scored("smoothness", 0.633, 0.307, 0.67, 15, 13),
    "knn": _scored("knn", 0.589, 0.417, 0.62, 18, 17),
    "gripper_timing": _scored("gripper_timing", 0.133, 0.166, 0.11, 19, 20),
    "isolation_forest": _scored("isolation_forest", 0.033, 0.0, 0.0, 15, 12),
    "everything": PublishedSuccess(0.033, 0.0, 0.0),
}
#: Number of demonstrations that the paper keeps, of 80.
KEEP = 60
#: Spearman's rho of AUROC and success as printed, and as computed from Table II with the exact p
#: and Bonett and Wright's interval.
RHO_PRINTED = -0.14
RHO, RHO_P, RHO_INTERVAL = 0.071, 0.91, (-0.72, 0.78)

#: What reports say about these values.
NOTE = (
    "The paper joined scores with labels and demonstrations by position in two different orders, "
    "so that its AUROC is not that of the scorer and its kept sets are close to random ones. "
    "'Joined' is computed from its released scores with the rows joined by name; no policy was "
    "trained on the sets that these would keep, so there is no success to show for it."
)
