"""Writes docs/api.md from `curation_ros.__all__`.

python docs/make_api.py           writes it
python docs/make_api.py --check   compares it
"""

from __future__ import annotations

import inspect
import re
import sys
from functools import cached_property
from pathlib import Path
from typing import Any

import curation_ros

API = Path(__file__).resolve().parent / "api.md"
#: Functions first, then what they return, then the words that those use.
ORDER = (
    "open",
    "score",
    "read_episode",
    "read_topic_map",
    "Collection",
    "ScoredEpisodes",
    "Scored",
    "Episode",
    "TopicMap",
    "Decision",
    "Finding",
    "Manifest",
    "CurationError",
)
_WIDTH = 88
_SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")

HEAD = """# Python API

Made by `docs/make_api.py` from the docstrings. Edit those, then run `make docs`.

`import curation_ros as cr` takes less than 0.1 s. It needs no ROS, simulator or torch.
"""


def signature(name: str, value: Any) -> str:
    """The call as code; on several lines if it is long."""
    shown = inspect.signature(value)
    parameters = [p for k, p in shown.parameters.items() if k not in ("self", "cls")]
    returns = "" if shown.return_annotation is shown.empty else f" -> {shown.return_annotation}"
    texts = _texts(parameters)
    line = f"{name}({', '.join(texts)}){returns}"
    if len(line) <= _WIDTH:
        return line
    return f"{name}(\n" + "".join(f"    {text},\n" for text in texts) + f"){returns}"


def _texts(parameters: list[inspect.Parameter]) -> list[str]:
    """Parameters as they stand in the source; annotations are texts there."""
    texts, is_starred = [], False
    for parameter in parameters:
        is_starred = is_starred or parameter.kind is parameter.VAR_POSITIONAL
        if parameter.kind is parameter.KEYWORD_ONLY and not is_starred:
            texts.append("*")
            is_starred = True
        texts.append(str(parameter).replace(repr(parameter.annotation), parameter.annotation))
    return texts


def prose(value: Any) -> str:
    """A docstring as Markdown: examples as code, sections as lists."""
    doc = inspect.getdoc(value) or ""
    parts = []
    for block in doc.split("\n\n"):
        head, _, body = block.partition(":\n")
        if head == "Example":
            block = inspect.cleandoc(body)
        if block.startswith(">>>"):
            parts.append(f"```python\n{block}\n```")
        elif head in _SECTIONS:
            parts.append(_section(head, body))
        else:
            parts.append(block if block.startswith("- ") else " ".join(block.split()))
    return "\n\n".join(parts)


def _section(head: str, body: str) -> str:
    items = re.split(r"\n(?=    \S)", body)
    texts = [" ".join(item.split()) for item in items]
    if head in ("Returns", "Yields"):
        return f"{head}: {' '.join(texts)}"
    named = [re.sub(r"^([\w, *]+): ", r"`\1`: ", text) for text in texts]
    return f"{head}:\n\n" + "\n".join(f"- {text}" for text in named)


def members(kind: type) -> list[tuple[str, Any]]:
    """Public methods and properties that a class documents itself, in the order of its source."""
    found = []
    for name, value in vars(kind).items():
        if name.startswith("_"):
            continue
        inner = value
        if isinstance(value, property):
            inner = value.fget
        elif isinstance(value, cached_property):
            inner = value.func
        elif isinstance(value, (classmethod, staticmethod)):
            inner = value.__func__
        if callable(inner) and inspect.getdoc(inner):
            found.append((name, value))
    return found


def entry(name: str) -> str:
    """One name of the front door, with its members."""
    value = getattr(curation_ros, name)
    if not inspect.isclass(value):
        return f"## `{name}`\n\n```python\n{signature(name, value)}\n```\n\n{prose(value)}"
    parts = [f"## `{name}`", prose(value)]
    for member, found in members(value):
        if isinstance(found, property):
            parts += [f"### `{name}.{member}`", prose(found.fget)]
        elif isinstance(found, cached_property):
            parts += [f"### `{name}.{member}`", prose(found.func)]
        else:
            inner = found.__func__ if isinstance(found, (classmethod, staticmethod)) else found
            code = f"```python\n{signature(f'{name}.{member}', inner)}\n```"
            parts += [f"### `{name}.{member}`", code, prose(inner)]
    return "\n\n".join(parts)


def text() -> str:
    """The whole document."""
    names = set(curation_ros.__all__) - {"__version__"}
    assert names == set(ORDER), f"docs/make_api.py leaves out {names ^ set(ORDER)}"
    example = prose(curation_ros)
    return "\n\n".join([HEAD.strip(), example, *(entry(name) for name in ORDER)]) + "\n"


def main(arguments: list[str]) -> int:
    """Write or check; 1 if the committed document is not current."""
    new = text()
    if arguments == ["--check"]:
        if API.exists() and API.read_text() == new:
            return 0
        print(f"{API.name} is not current: run docs/{Path(__file__).name}")  # noqa: T201
        return 1
    API.write_text(new)
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
