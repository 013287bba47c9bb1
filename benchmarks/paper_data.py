"""Records the datasets of the paper's experiment on the graph: real LIBERO, real DDS, real bags.

    python benchmarks/paper_data.py FOLDER

makes FOLDER/reference (50 clean demonstrations), FOLDER/independent (16 clean demonstrations and
64 early releases, each from another start state) and FOLDER/paired (the same numbers, with the
early releases from the start states of the clean ones). Datasets that exist are left alone. No
two datasets share a start state, and none uses an official one.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from recorded import record

from curation_ros.dataset.dataset import Dataset

_CONTAMINATED: dict[str, Any] = {"episodes": 80, "contamination": 0.8, "defect": "early_release"}
DATASETS: dict[str, dict[str, Any]] = {
    "reference": {"episodes": 50, "seed": 11, "starts": "generated:11:50"},
    "independent": {**_CONTAMINATED, "seed": 13, "starts": "generated:13:80"},
    "paired": {**_CONTAMINATED, "seed": 12, "starts": "generated:12:16", "paired": True},
}
_PATIENCE_S = 3600.0


def main(arguments: list[str]) -> int:
    """Record the datasets that are missing."""
    if len(arguments) != 1:
        print(__doc__)
        return 2
    for name, parameters in DATASETS.items():
        folder = Path(arguments[0]) / name
        if not Dataset(folder, create=True).truth_log.lines():
            record(folder, patience_s=_PATIENCE_S, **parameters)
        print(folder, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
