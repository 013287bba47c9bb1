"""A report as Markdown; its figures are files in the same folder."""

from __future__ import annotations

import re
from collections.abc import Sequence

from typing_extensions import assert_never

from curation_ros.reporting.blocks import Block, Figure, Page, Points, Table, Text


def to_markdown(page: Page) -> str:
    """The whole Markdown file."""
    parts = [f"# {_plain(page.title)}", _plain(page.subtitle)]
    for k, section in enumerate(page.sections, 1):
        parts.append(f"## {k}. {_plain(section.title)}")
        parts += [_block(block) for block in section.blocks]
    return "\n\n".join(parts) + "\n"


def _block(block: Block) -> str:
    match block:
        case Text():
            return f"**{_plain(block.text)}**" if block.is_warning else _plain(block.text)
        case Points():
            return "\n".join(f"- {_plain(item)}" for item in block.items)
        case Table():
            return _table(block)
        case Figure():
            alt = _plain(block.caption).replace("[", "(").replace("]", ")")
            return f"![{alt}]({block.name}.svg)\n\n{_plain(block.caption)}"
        case _:
            assert_never(block)


def _table(table: Table) -> str:
    sides = [":--" if k in table.text else "--:" for k in range(len(table.headings))]
    rows = [table.headings, sides, *table.rows]
    return _plain(table.caption) + "\n\n" + "\n".join(_line(row) for row in rows)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(_plain(cell) or " " for cell in cells) + " |"


def _plain(text: str) -> str:
    """Text in which nothing is Markdown syntax."""
    return re.sub(r"([\\`*_<>|#])", r"\\\1", " ".join(text.split()))
