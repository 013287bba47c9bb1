"""Values of the paper that a report sets its own beside.

Source: Bedi, What Demonstration Curation Metrics Do to Your Policy, arXiv 2606.10229, 2026,
Tables I and II. Table I stands in `curation_ros.batch.audit.PAPER`, and so in `results.json`.
"""

from __future__ import annotations

from dataclasses import dataclass

from curation_ros.batch.audit import PAPER


@dataclass(frozen=True)
class Published:
    """A row of Table II.

    Attributes:
        success: mean over 3 seeds, 30 rollouts each.
        sd: population standard deviation over the seeds.
        gap_closed: as printed.
        auroc: at T = 324; None for the baselines.
        joined: the same from the released scores with the rows joined by name.
        clean_kept: of 60 kept, how many of the 20 called clean in the released files.
        clean_kept_joined: the same, had the rows been joined by name.
    """

    success: float
    sd: float
    gap_closed: float
    auroc: float | None = None
    joined: float | None = None
    clean_kept: int | None = None
    clean_kept_joined: int | None = None


def _scored(name: str, success: float, sd: float, gap: float, kept: int, right: int) -> Published:
    _, truncated, joined = PAPER[name]
    return Published(success, sd, gap, truncated, joined, kept, right)


#: Table II in its order: row of a study -> published values. The last two figures of a scorer are
#: computed from the released scores and selections.
TABLE_2: dict[str, Published] = {
    "oracle": Published(0.933, 0.0, 1.0),
    "ensemble": _scored("ensemble", 0.911, 0.016, 0.97, 17, 20),
    "trajectory_alignment": _scored("trajectory_alignment", 0.900, 0.0, 0.96, 16, 15),
    "entropy": _scored("entropy", 0.778, 0.126, 0.82, 11, 7),
    "smoothness": _scored("smoothness", 0.633, 0.307, 0.67, 15, 13),
    "knn": _scored("knn", 0.589, 0.417, 0.62, 18, 17),
    "gripper_timing": _scored("gripper_timing", 0.133, 0.166, 0.11, 19, 20),
    "isolation_forest": _scored("isolation_forest", 0.033, 0.0, 0.0, 15, 12),
    "everything": Published(0.033, 0.0, 0.0),
}
#: How many of 80 the paper keeps.
KEEP = 60
#: Spearman's rho of AUROC and success: printed, and computed from its own Table II with the exact
#: p and Bonett and Wright's interval.
RHO_PRINTED = -0.14
RHO, RHO_P, RHO_INTERVAL = 0.071, 0.91, (-0.72, 0.78)

NOTE = (
    "The paper joined scores with labels and demonstrations by position in two different orders, "
    "so that its AUROC is not that of the scorer and its kept sets are close to random ones. "
    "'Joined' is computed from its released scores with the rows joined by name; no policy was "
    "trained on the sets that these would keep, so there is no success to show for it."
)
