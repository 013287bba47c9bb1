"""The defects that can be injected into demonstrations, by name."""

from __future__ import annotations

from sim_node.defects import early_release, none
from sim_node.defects.defect import Defect, DefectiveController

DEFECTS: dict[str, Defect] = {
    "none": none.DEFECT,
    "early_release": early_release.DEFECT,
}
"""Every defect that can be asked for."""

__all__ = ["DEFECTS", "Defect", "DefectiveController"]
