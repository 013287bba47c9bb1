"""Rules of the house that can be measured. CONTRIBUTING.md explains them."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILES = [
    path
    for folder in ("curation_ros", "sim_node", "policy_node", "launch")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
CLASS_LINES, FUNCTION_LINES = 250, 60
#: Definitions that are longer. The list only gets shorter.
LONGER = {
    "curation_ros/testing/episodes.py:make_episode",
    "sim_node/libero/osc.py:control_step",
}


def _long_definitions() -> Iterator[str]:
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                limit = CLASS_LINES if isinstance(node, ast.ClassDef) else FUNCTION_LINES
                if (node.end_lineno or 0) - node.lineno >= limit:
                    yield f"{path.relative_to(ROOT)}:{node.name}"


def test_classes_and_functions_are_short() -> None:
    found = set(_long_definitions())
    assert found - LONGER == set(), "split them"
    assert LONGER - found == set(), "they are short now: take them off the list"


def test_exceptions_from_checks_name_the_check() -> None:
    """A bare `type: ignore` or `noqa` hides errors that nobody has seen."""
    bare = [
        f"{path.relative_to(ROOT)}:{number}"
        for path in FILES
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if line.rstrip().endswith(("# type: ignore", "# noqa"))
    ]
    assert bare == []
