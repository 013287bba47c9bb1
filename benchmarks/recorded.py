"""Records demonstrations on the graph: the simulator's expert, real DDS, real bags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from curation_ros.nodes.processes import Domain, Nodes


def record(folder: Path, *, patience_s: float = 300.0, **parameters: Any) -> Path:
    """Record a dataset.

    Args:
        folder: of the dataset.
        patience_s: how long it may take.
        **parameters: of the simulator's node.

    Returns:
        The folder.
    """
    domain = Domain()
    with Nodes(domain, folder / "logs") as nodes:
        nodes.start("recorder", {"dataset": folder})
        nodes.start("sim_node", {"dataset": folder, "wait_for": ["recorder"], **parameters})
        nodes.wait("sim_node", patience_s)
    domain.close()
    return folder
