"""The parts of a report, before it becomes HTML or Markdown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class Text:
    """A paragraph; `is_warning` makes it stand out."""

    text: str
    is_warning: bool = False


def missing(what: str) -> Text:
    """A warning about something that a report would show if there were data."""
    return Text(f"Missing: {what}", is_warning=True)


@dataclass(frozen=True)
class Points:
    """A bulleted list."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it shows.
        headings: headings of the columns.
        rows: one text per column in each.
        text: indices of the columns that hold words, aligned left; the others are aligned right.
    """

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class Panel:
    """A part of a figure; on a narrow screen the parts stand below each other.

    Attributes:
        svg: SVG element for a page.
        alt: what it shows, for people who cannot see it.
    """

    svg: str
    alt: str


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        name: name of its file, without `.svg`.
        caption: what it shows and how to read it.
        panels: its parts, for a page.
        whole: SVG of all parts side by side, for the file.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    whole: str


Block: TypeAlias = Text | Points | Table | Figure


@dataclass(frozen=True)
class Section:
    """A heading and the blocks below it."""

    title: str
    blocks: tuple[Block, ...]


@dataclass(frozen=True)
class Page:
    """A whole report."""

    title: str
    subtitle: str
    sections: tuple[Section, ...]

    @property
    def figures(self) -> tuple[Figure, ...]:
        """All figures, in order."""
        return tuple(b for s in self.sections for b in s.blocks if isinstance(b, Figure))
