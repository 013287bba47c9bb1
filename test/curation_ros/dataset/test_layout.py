"""Nothing outside of `curation_ros/dataset` knows what is where in a dataset."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from curation_ros.dataset import layout
from curation_ros.dataset.dataset import Dataset

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = ("curation_ros", "sim_node", "policy_node", "launch", "benchmarks")
#: Names that stand for nothing else, and words that are names of folders where a path is made.
NAMES = {layout.PARTIAL, layout.COLLECTING, layout.QUARANTINE, layout.INDEX, layout.TRUTH}
WORDS = {layout.EPISODES, layout.DECISIONS, layout.SELECTIONS, layout.POLICIES}
SQL = re.compile(r"\b(SELECT\b.*\bFROM|INSERT\b.*\bINTO|DELETE FROM|CREATE TABLE|PRAGMA)\b", re.S)
#: A study has a folder of policies, too.
STUDIES = ("curation_ros/study/", "benchmarks/giving_up.py")


def _problems(source: str) -> Iterator[str]:
    """Names of a dataset's files, SQL, and imports of sqlite3."""
    tree = ast.parse(source)
    formatted = {id(p) for n in ast.walk(tree) if isinstance(n, ast.JoinedStr) for p in n.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import) and any(a.name == "sqlite3" for a in node.names):
            yield "sqlite3"
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            if SQL.search(node.value):
                yield "SQL"
            if node.value in NAMES and id(node) not in formatted:
                yield node.value
        for text in _in_paths(node):
            yield from {text, text.split("/")[0], text.rpartition("/")[2]} & (NAMES | WORDS)


def _in_paths(node: ast.AST) -> list[str]:
    """Texts that are part of a path, or compared with the name of one."""
    parts: list[ast.expr] = []
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
        parts = [node.left, node.right]
    elif isinstance(node, ast.Call):
        function = node.func
        name = function.attr if isinstance(function, ast.Attribute) else ""
        name = function.id if isinstance(function, ast.Name) else name
        if name in ("Path", "joinpath", "glob", "rglob", "with_name", "join"):
            parts = list(node.args)
    elif isinstance(node, ast.Compare):
        sides = [node.left, *node.comparators]
        if any(isinstance(s, ast.Attribute) and s.attr in ("name", "stem") for s in sides):
            parts = sides
    elif isinstance(node, ast.JoinedStr):  # f"{folder}/episodes"
        parts = [
            ast.Constant(p.value.strip("/").split()[0])
            for p in node.values
            if isinstance(p, ast.Constant) and p.value.startswith("/") and p.value.strip("/ \n")
        ]
    return [p.value for p in parts if isinstance(p, ast.Constant) and isinstance(p.value, str)]


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('folder / "episodes" / name', ["episodes"]),
        ('Path("data", "decisions")', ["decisions"]),
        ('folder.glob("selections/*.json")', ["selections"]),
        ('path.parent.name == "episodes"', ["episodes"]),
        ('f"{folder}/policies"', ["policies"]),
        ('name = "truth.jsonl"', ["truth.jsonl"]),
        ('db.execute("SELECT * FROM episodes")', ["SQL"]),
        ("import sqlite3", ["sqlite3"]),
        ('{"episodes": 3, "decisions": f"{n} decisions"}', []),
        ('rule == "decisions"', []),
    ],
)
def test_check_finds_what_it_is_for(source: str, found: list[str]) -> None:
    assert list(dict.fromkeys(_problems(source))) == found


def test_only_dataset_knows_the_layout_and_sql() -> None:
    found = {
        (str(path.relative_to(ROOT)), problem)
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        if not path.is_relative_to(ROOT / "curation_ros" / "dataset")
        for problem in _problems(path.read_text())
    }
    of_studies = {x for x in found if x[0].startswith(STUDIES) and x[1] == layout.POLICIES}
    assert found - of_studies == set()


def test_bag_is_covered_by_its_dataset_or_by_the_folder_around_it(
    dataset: Dataset, tmp_path: Path
) -> None:
    assert layout.home_of(dataset.bag_path("x")) == (dataset.path.resolve(), "episodes/x")
    assert layout.home_of(tmp_path / "bags" / "x.mcap") == (
        (tmp_path / "bags").resolve(),
        "x.mcap",
    )
    assert layout.is_dataset(dataset.path)
    assert not layout.is_dataset(tmp_path)
