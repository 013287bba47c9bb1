"""README and the pages of docs: links lead somewhere, and commands exist."""

from __future__ import annotations

import ast
import importlib
import json
import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from curation_ros.cli.main import COMMANDS, parser
from curation_ros.nodes.processes import NODE_MODULES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [path for folder in ("", "docs", "bags") for path in sorted((ROOT / folder).glob("*.md"))]
#: Most words of a sentence of prose, on average over a page.
MEAN_WORDS = 20

_LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]+")
_ID = {page: str(page.relative_to(ROOT)) for page in PAGES}

pages = pytest.mark.parametrize("page", PAGES, ids=_ID.get)


def code_of(text: str) -> list[str]:
    """Lines of code blocks, one that goes on as one line, and code spans."""
    blocks = "".join(block for _, block in _FENCE.findall(text)).replace("\\\n", " ")
    spans = re.findall(r"`([^`]+)`", _FENCE.sub("", text))
    return blocks.splitlines() + [" ".join(span.split()) for span in spans]


def calls_of(text: str) -> Iterator[tuple[str, str]]:
    """Subcommand and arguments of each `curation` in code, those after `: ` in comments too."""
    for code in code_of(text):
        line, _, comment = code.partition(" #")
        for call in (line, *re.split(r": ", comment)[1:]):
            found = re.match(r"\s*(?:\S*/)?curation ([a-z][a-z-]*)\b(.*)", call)
            if found:
                yield found[1], found[2]


@cache
def anchors_of(page: Path) -> frozenset[str]:
    """Anchors of a page's headings, as GitHub makes them."""
    text = _FENCE.sub("", page.read_text())
    headings = re.findall(r"^#+ +(.*)$", text, flags=re.MULTILINE)
    plain = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return frozenset(heading.strip().replace(" ", "-") for heading in plain)


@pages
def test_links_and_anchors_resolve(page: Path) -> None:
    for link in _LINK.findall(_FENCE.sub("", page.read_text())):
        if link.startswith(("http:", "https:")):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in anchors_of(target), link


@pages
def test_files_of_this_repository_exist(page: Path) -> None:
    folders = "core|curation_ros|sim_node|policy_node|test|benchmarks|config|docs|launch|results"
    for code in code_of(page.read_text()):
        for path in re.findall(rf"(?<![\w/.<])(?:{folders})/[\w/]+\.(?:py|md|yaml)\b", code):
            assert any((root / path).exists() for root in (ROOT, ROOT / "curation_ros")), path


@pages
def test_names_of_this_repository_exist(page: Path) -> None:
    for code in code_of(page.read_text()):
        packages = "curation_ros|sim_node|policy_node"
        for name in re.findall(rf"(?<![\w/.-])(?:{packages})(?:\.\w+){{2,}}", code):
            module, _, member = name.rpartition(".")
            home = ROOT / module.replace(".", "/")
            if not (home / f"{member}.py").is_file():
                source = home / "__init__.py" if home.is_dir() else home.with_suffix(".py")
                assert re.search(rf"\b{member}\b", source.read_text()), name


@pages
def test_commands_and_their_flags_exist(page: Path) -> None:
    for command, rest in calls_of(page.read_text()):
        assert command in COMMANDS, f"curation {command}{rest}"
        known = set(_FLAG.findall(_help(command)))
        assert set(_FLAG.findall(rest)) <= known, f"curation {command}{rest}"


@cache
def _help(command: str) -> str:
    try:
        top = parser(command)
    except ModuleNotFoundError as err:
        pytest.skip(f"curation {command} needs {err.name}")
    [commands] = [a for a in top._actions if a.dest == "command"]
    return commands.choices[command].format_help()


@pages
def test_commands_of_shell_blocks_can_be_run(page: Path) -> None:
    blocks = [block for kind, block in _FENCE.findall(page.read_text()) if kind == "sh"]
    for command, rest in calls_of("".join(f"```sh\n{block}```\n" for block in blocks)):
        _help(command)
        assert parser(command).parse_args([command, *shlex.split(rest)]).command == command


@pages
def test_make_targets_exist(page: Path) -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE))
    for code in code_of(page.read_text()):
        for words in re.findall(r"^\s*make((?: [A-Za-z_=./-]+)+)", code.partition("#")[0]):
            named = [word for word in words.split() if "=" not in word]
            assert set(named) <= targets, code


@pages
def test_nodes_exist(page: Path) -> None:
    for code in code_of(page.read_text()):
        for node in re.findall(r"ros2 run curation_ros ([a-z]\w*)", code):
            assert node in NODE_MODULES, code
        for program in re.findall(r"\.venv/bin/([\w-]+)", code):
            tools = {"curation", "python", "pytest", "pre-commit"}
            assert program in {*NODE_MODULES, *tools}, code


@pages
def test_arguments_of_the_launch_file_exist(page: Path) -> None:
    source = (ROOT / "launch" / "record.launch.py").read_text()
    [arguments] = re.findall(r"^ARGUMENTS = (\(.*?^\))", source, flags=re.MULTILINE | re.DOTALL)
    known = {name for name, *_ in ast.literal_eval(arguments)}
    for code in code_of(page.read_text()):
        if "record.launch.py" in code:
            assert set(re.findall(r"(\w+):=", code)) <= known, code


@pytest.mark.ros
@pytest.mark.sim
def test_parameters_of_nodes_exist() -> None:
    for page in PAGES:
        for code in code_of(page.read_text()):
            run = re.match(r"ros2 run curation_ros ([a-z]\w*) (.*)", code)
            for name in re.findall(r"-p (\w+):=", run[2]) if run else ():
                assert name in _parameters(run[1]), code


@pytest.mark.ros
@pytest.mark.sim
@pytest.mark.parametrize("node", NODE_MODULES)
def test_page_of_the_graph_has_the_parameters_of_each_node(node: str) -> None:
    text = (ROOT / "docs" / "graph.md").read_text()
    section = text[text.index(f"### `{node}`") :].partition("\n##")[0]
    table = section.partition("| parameter |")[2]
    assert dict(re.findall(r"^\| `(\w+)` \| `(.*?)` \|", table, flags=re.M)) == _parameters(node)


@cache
def _parameters(node: str) -> dict[str, str]:
    pytest.importorskip("rclpy")
    table = importlib.import_module(NODE_MODULES[node]).PARAMETERS
    return {p.name: "[]" if p.default == () else json.dumps(p.default) for p in table}


def words_of_sentences(text: str) -> list[int]:
    """Words of each sentence of a page's prose: no headings, tables or code."""
    text = re.sub(r"<!--.*?-->", "", _FENCE.sub("\n", text), flags=re.DOTALL)
    blocks: list[list[str]] = [[]]
    for line in map(str.strip, text.splitlines()):
        if not line or line.startswith(("|", "#", "![")):
            blocks.append([])
        elif re.match(r"(- |\d+\. )", line):
            blocks.append([line.partition(" ")[2]])
        else:
            blocks[-1].append(line)
    sentences = []
    for block in blocks:
        prose = re.sub(r"`[^`]*`", "code", _LINK.sub("link", " ".join(block)))
        sentences += re.split(r"(?<=[.!?])[*)\"]*\s+(?=[A-Z0-9\"*(])", prose)
    counts = (len(re.findall(r"\S*\w\S*", sentence)) for sentence in sentences)
    return [n for n in counts if n > 1]


def test_design_stays_a_page_of_decisions() -> None:
    lines = (ROOT / "docs" / "design.md").read_text().splitlines()
    assert len(lines) < 200, "tables belong on pages of their own"
    assert max(map(len, lines)) <= 120


@pages
def test_sentences_are_short(page: Path) -> None:
    words = words_of_sentences(page.read_text())
    assert sum(words) <= MEAN_WORDS * len(words), f"{sum(words)} words in {len(words)} sentences"


def test_pages_are_taken_apart() -> None:
    text = (
        "# A heading of five words\n\nOne [link](a.md) and `code of words`. Two\nlines!\n\n"
        "- item one\n\n| a | table |\n\n```sh\ncuration index x \\\n"
        " --rebuild  # or: curation y z\n```\n"
    )
    assert words_of_sentences(text) == [4, 2, 2]
    assert list(calls_of(text)) == [("index", " x   --rebuild "), ("y", " z")]
    assert code_of(text)[-1] == "code of words"
