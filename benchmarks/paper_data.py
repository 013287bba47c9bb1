"""Records the datasets of the paper's experiment on the graph: real LIBERO, real DDS, real bags.

    python benchmarks/paper_data.py FOLDER

makes FOLDER/reference (50 clean demonstrations), FOLDER/independent (16 clean and 64 early
releases, a start state each) and FOLDER/paired (the same with the defective ones on the starts of
the clean ones). What is there already is left alone. No start state is used twice among them, and
none is an official one.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from curation_ros.dataset.dataset import Dataset
from curation_ros.nodes.processes import Domain, Nodes

_CONTAMINATED: dict[str, Any] = {"episodes": 80, "contamination": 0.8, "defect": "early_release"}
DATASETS: dict[str, dict[str, Any]] = {
    "reference": {"episodes": 50, "seed": 11, "starts": "generated:11:50"},
    "independent": {**_CONTAMINATED, "seed": 13, "starts": "generated:13:80"},
    "paired": {**_CONTAMINATED, "seed": 12, "starts": "generated:12:16", "paired": True},
}
_PATIENCE_S = 3600.0


def record(folder: Path, parameters: dict[str, Any]) -> Path:
    """Record one dataset, if it is not there; returns its folder."""
    if Dataset(folder, create=True).truth_log.lines():
        return folder
    domain = Domain()
    with Nodes(domain, folder / "logs") as nodes:
        nodes.start("recorder", {"dataset": folder})
        nodes.start("sim_node", {"dataset": folder, "wait_for": ["recorder"], **parameters})
        nodes.wait("sim_node", _PATIENCE_S)
    domain.close()
    return folder


def main(arguments: list[str]) -> int:
    """Record what is missing."""
    if len(arguments) != 1:
        print(__doc__)
        return 2
    for name, parameters in DATASETS.items():
        print(record(Path(arguments[0]) / name, parameters), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
