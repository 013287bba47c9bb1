"""The contracts of imports in pyproject.toml: they cover every module, and wrong imports fail."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("importlinter")

from try_wrong_imports import CHOSEN, ROOT, Contracts, Import

# A package that lies in several layers has no layer of its own.
FRONT_DOOR = "curation_ros"


@pytest.fixture(scope="module")
def contracts() -> Contracts:
    return Contracts()


def test_every_module_has_a_layer(contracts: Contracts) -> None:
    layers = {name for layer in contracts.layers for name in layer}
    split = {parent for name in layers for parent in _parents(name)}
    for module in set(contracts.modules) - layers - split:
        assert layers.intersection(_parents(module)), (
            f"{module} has no layer. Add it to the layers in pyproject.toml: above the modules "
            "that it imports, below those that import it."
        )


def test_packages_in_several_layers_are_kept_empty(contracts: Contracts) -> None:
    split = {parent for layer in contracts.layers for name in layer for parent in _parents(name)}
    for package in split - {FRONT_DOOR}:
        module = next(m for m in contracts.modules if m.startswith(f"{package}."))
        assert contracts.refused_by(Import(package, module)), (
            f"{package} lies in several layers, so its __init__ must import nothing: name it in "
            "the contract of such packages in pyproject.toml."
        )


def test_the_tree_keeps_the_contracts(contracts: Contracts) -> None:
    assert contracts.refused_by() == ""


def test_each_layer_is_kept_from_the_next_one_and_from_its_siblings(contracts: Contracts) -> None:
    """try_wrong_imports.py tries every pair of layers, which takes longer."""
    tried = list(contracts.upward(reach=1))
    assert len(tried) >= len(contracts.layers) - 1
    assert [one for one in tried if not contracts.refused_by(one)] == []


def test_every_pair_of_layers_can_be_tried(contracts: Contracts) -> None:
    n = len(contracts.layers)
    tried = list(contracts.upward())
    assert len(tried) == len(set(tried)) >= n * (n - 1) / 2


@pytest.mark.parametrize("wrong", CHOSEN, ids=" to ".join)
def test_wrong_import_is_refused(contracts: Contracts, wrong: Import) -> None:
    assert contracts.refused_by(wrong)


@pytest.mark.parametrize(
    "wrong",
    [
        Import("curation_ros.core.episode.episode", "curation_ros.batch.workers"),
        Import("curation_ros.core", "curation_ros.files"),
        Import("policy_node.policy", "torch"),
    ],
    ids=" to ".join,
)
def test_the_program_refuses_what_is_refused_here(tmp_path: Path, wrong: Import) -> None:
    """The same imports, written into a copy of the tree and checked as `make check` does."""
    tree = tmp_path / "tree"
    tree.mkdir()
    shutil.copy(ROOT / "pyproject.toml", tree)
    for package in ("curation_ros", "sim_node", "policy_node"):
        shutil.copytree(ROOT / package, tree / package, ignore=shutil.ignore_patterns("*.pyc"))
    assert "0 broken" in _lint_imports(tree)
    module = tree / wrong.importer.replace(".", "/")
    path = module / "__init__.py" if module.is_dir() else module.with_suffix(".py")
    path.write_text(f"{path.read_text()}\nimport {wrong.imported}\n")
    assert "1 broken" in _lint_imports(tree)


def _lint_imports(tree: Path) -> str:
    code = f"import sys; sys.path.insert(0, {str(tree)!r}); "
    code += "from importlinter.cli import lint_imports; lint_imports(no_cache=True)"
    return subprocess.run(
        [sys.executable, "-c", code], cwd=tree, capture_output=True, text=True, timeout=60
    ).stdout


def _parents(name: str) -> list[str]:
    """Packages around a module, the innermost first."""
    words = name.split(".")
    return [".".join(words[:k]) for k in range(len(words) - 1, 0, -1)]
