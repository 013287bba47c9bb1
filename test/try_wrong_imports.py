"""Tries imports against the contracts of pyproject.toml, one by one: each has to be refused.

Run it for the figures: python test/try_wrong_imports.py
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from copy import deepcopy
from itertools import permutations
from pathlib import Path
from typing import NamedTuple

from grimp import ImportGraph, build_graph
from importlinter.application.use_cases import read_user_options
from importlinter.configuration import configure
from importlinter.contracts.acyclic_siblings import AcyclicSiblingsContract
from importlinter.contracts.forbidden import ForbiddenContract
from importlinter.contracts.layers import LayersContract
from importlinter.contracts.protected import ProtectedContract
from importlinter.domain.contract import Contract

ROOT = Path(__file__).resolve().parents[1]
_TYPES: tuple[type[Contract], ...] = (
    AcyclicSiblingsContract,
    ForbiddenContract,
    LayersContract,
    ProtectedContract,
)


class Import(NamedTuple):
    """One import: `importer` contains `import imported`."""

    importer: str
    imported: str


#: Imports that have to fail, and why somebody would write them.
CHOSEN = (
    # The core knows nothing of files, datasets, nodes or commands.
    Import("curation_ros.core.episode.episode", "curation_ros.batch.workers"),
    Import("curation_ros.core.episode.builder", "curation_ros.bags.reader"),
    Import("curation_ros.core.episode.topic_map", "curation_ros.files"),
    Import("curation_ros.core.evidence.checks", "curation_ros.configuration"),
    Import("curation_ros.core.decision.decision", "curation_ros.dataset.dataset"),
    Import("curation_ros.core.scorers.knn", "curation_ros.dataset.index"),
    Import("curation_ros.core.statistics.detection", "curation_ros.batch.audit"),
    Import("curation_ros.core.types", "curation_ros.cli.output"),
    Import("curation_ros.core.errors", "curation_ros.core.episode.findings"),
    # Inside the core: episode < evidence < scorers < decision.
    Import("curation_ros.core.episode.episode", "curation_ros.core.scorers"),
    Import("curation_ros.core.episode.episode", "curation_ros.core.evidence.gripper"),
    Import("curation_ros.core.episode.findings", "curation_ros.core.decision.decision"),
    Import("curation_ros.core.evidence.carrying", "curation_ros.core.scorers.object_coupling"),
    Import("curation_ros.core.scorers.scorer", "curation_ros.core.decision.decision"),
    Import("curation_ros.core.statistics.ranks", "curation_ros.core.episode.episode"),
    # Bags know no dataset, datasets no batch, batch no curator.
    Import("curation_ros.bags.reader", "curation_ros.batch.examine"),
    Import("curation_ros.bags.reader", "curation_ros.dataset.dataset"),
    Import("curation_ros.bags.writer", "curation_ros.live.recorder"),
    Import("curation_ros.bags.episodes", "curation_ros.sources"),
    Import("curation_ros.sources.mcap", "curation_ros.dataset.layout"),
    Import("curation_ros.sources.source", "curation_ros.batch.examine"),
    Import("curation_ros.dataset.dataset", "curation_ros.live.curator"),
    Import("curation_ros.dataset.dataset", "curation_ros.configuration"),
    Import("curation_ros.dataset.manifests", "curation_ros.batch.examine"),
    Import("curation_ros.configuration", "curation_ros.batch.workers"),
    Import("curation_ros.batch.examine", "curation_ros.live.curator"),
    Import("curation_ros.batch.workers", "curation_ros.study.units"),
    Import("curation_ros.files", "curation_ros.bags.reader"),
    # Nobody knows the commands or the report.
    Import("curation_ros.reporting.page", "curation_ros.cli.output"),
    Import("curation_ros.study.plan", "curation_ros.reporting.page"),
    Import("curation_ros.study.running", "curation_ros.cli.benchmark"),
    Import("curation_ros.live.curator", "curation_ros.nodes.messages"),
    Import("curation_ros.nodes.recorder", "curation_ros.cli.output"),
    Import("curation_ros.nodes.messages", "curation_ros.nodes.health"),
    # Nodes meet over topics.
    Import("curation_ros.nodes.recorder", "curation_ros.nodes.curator"),
    Import("curation_ros.nodes.curator", "sim_node.libero.env"),
    Import("curation_ros.nodes.replay", "policy_node.policy"),
    Import("sim_node.node", "policy_node.policy"),
    Import("sim_node.libero.env", "policy_node.policy"),
    Import("policy_node.node", "sim_node.libero.env"),
    Import("policy_node.controller", "sim_node.libero.env"),
    # The simulator, policies and training are plain Python.
    Import("sim_node.libero.env", "curation_ros.nodes.messages"),
    Import("sim_node.libero.env", "curation_ros.bags.reader"),
    Import("sim_node.starts", "curation_ros.dataset.dataset"),
    Import("sim_node.libero.env", "sim_node.node"),
    Import("policy_node.policy", "policy_node.train"),
    Import("policy_node.train", "curation_ros.bags.reader"),
    Import("policy_node.policy", "curation_ros.nodes.qos"),
    # Scoring needs no simulator, policy or ROS.
    Import("curation_ros.bags.reader", "sim_node.starts"),
    Import("curation_ros.batch.audit", "policy_node.policy"),
    Import("curation_ros.live.recorder", "sim_node.libero.env"),
    Import("curation_ros.cli.score", "curation_ros.nodes.watcher"),
    Import("curation_ros.cli.select", "sim_node.starts"),
    Import("curation_ros.study.plan", "sim_node.starts"),
    # Packages that lie in several layers stay empty, and the front door is for others.
    Import("curation_ros.core", "curation_ros.cli.main"),
    Import("sim_node", "sim_node.libero.env"),
    Import("curation_ros.nodes", "curation_ros.core.errors"),
    Import("curation_ros.core.errors", "curation_ros"),
    Import("curation_ros.cli.score", "curation_ros"),
    # Circles inside one layer.
    Import("curation_ros.bags.mcap_file", "curation_ros.bags.reader"),
    Import("curation_ros.batch.workers", "curation_ros.batch.examine"),
    # Libraries have one home.
    Import("curation_ros.core.episode.builder", "rclpy"),
    Import("curation_ros.core.episode.builder", "mcap"),
    Import("curation_ros.core.scorers.knn", "torch"),
    Import("curation_ros.live.recorder", "rclpy"),
    Import("curation_ros.cli.record", "rclpy"),
    Import("curation_ros.dataset.dataset", "rosbags"),
    Import("curation_ros.study.units", "mujoco"),
    Import("curation_ros.study.units", "torch"),
    Import("policy_node.policy", "torch"),
    Import("policy_node.observation", "rclpy"),
    Import("sim_node.libero.env", "rclpy"),
)


class Contracts:
    """The contracts of pyproject.toml, and the import graph of this tree, read once."""

    def __init__(self, root: Path = ROOT) -> None:
        """Read them; the packages are those that Python finds first, as for `lint-imports`."""
        configure()
        options = read_user_options(str(root / "pyproject.toml"))
        session = options.session_options
        types = {kind.type_name: kind for kind in _TYPES}  # type: ignore[attr-defined]
        self._contracts = [
            types[one["type"]](one["name"], session, one) for one in options.contracts_options
        ]
        self.packages: list[str] = session["root_packages"]
        self.graph: ImportGraph = build_graph(
            *self.packages, include_external_packages=True, cache_dir=None
        )
        drawings = [one["layers"] for one in options.contracts_options if "layers" in one]
        if len(drawings) != 1:
            raise ValueError(f"pyproject.toml has {len(drawings)} contracts of layers, not one")
        #: Modules of each layer, the highest first.
        self.layers = [[name.strip() for name in layer.split("|")] for layer in drawings[0]]

    @property
    def modules(self) -> list[str]:
        """Every module of the tree, packages included."""
        return sorted(m for m in self.graph.modules if m.partition(".")[0] in self.packages)

    def refused_by(self, tried: Import | None = None) -> str:
        """The first contract that is broken once an import is added; empty if none is.

        Args:
            tried: the import; none: the tree as it is.

        Raises:
            ValueError: if the importer or an imported module of ours does not exist.
        """
        graph = deepcopy(self.graph)
        if tried is not None:
            for name in tried:
                if name not in graph.modules:
                    raise ValueError(f"{name} does not exist: has it moved?")
            if tried.imported in graph.find_modules_directly_imported_by(tried.importer):
                raise ValueError(f"{tried.importer} imports {tried.imported} already")
            graph.add_import(
                importer=tried.importer,
                imported=tried.imported,
                line_number=1,
                line_contents=f"import {tried.imported}",
            )
        for contract in self._contracts:
            if not contract.check(deepcopy(graph), verbose=False).kept:
                return contract.name
        return ""

    def upward(self, *, reach: int | None = None) -> Iterator[Import]:
        """One import upwards for each pair of layers, and one for each pair of siblings.

        Args:
            reach: how many layers up from each layer; None: all.
        """
        for k, lower in enumerate(self.layers):
            for higher in reversed(self.layers[:k][-reach if reach else 0 :]):
                yield Import(self._a_module_of(lower[-1]), self._a_module_of(higher[0]))
        for layer in self.layers:
            for one, other in permutations(layer, 2):
                yield Import(self._a_module_of(one), self._a_module_of(other))

    def _a_module_of(self, name: str) -> str:
        """A module inside a package, or the module itself."""
        return max(self.graph.find_descendants(name), default=name)


def main() -> int:
    """Try all, and print what was let through and how many were refused."""
    contracts = Contracts()
    tried = [*contracts.upward(), *CHOSEN]
    passed = [one for one in tried if not contracts.refused_by(one)]
    for one in passed:
        sys.stdout.write(f"let through: {one.importer} imports {one.imported}\n")
    sys.stdout.write(f"{len(tried)} wrong imports tried, {len(tried) - len(passed)} refused\n")
    return 1 if passed else 0


if __name__ == "__main__":
    # Beside this script lie folders of tests with the names of our packages.
    sys.path[0] = str(ROOT)
    raise SystemExit(main())
