"""Names of the phases of the pick-and-place task, in their order."""

from __future__ import annotations

PHASES = ("PREGRASP", "DESCEND", "GRASP", "LIFT", "TRANSPORT", "RELEASE")
