"""What a report is made of, before it is HTML or Markdown."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias


@dataclass(frozen=True)
class Text:
    """A paragraph; `is_warning` where a reader must not miss it."""

    text: str
    is_warning: bool = False


@dataclass(frozen=True)
class Points:
    """A list."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        caption: what it shows, in a line or two.
        headings: of the columns.
        rows: texts, as many in each as there are headings.
        text: numbers of the columns that hold words and stand left; the others hold figures.
    """

    caption: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class Panel:
    """A part of a figure, that can stand below the others on a narrow screen."""

    svg: str
    alt: str


@dataclass(frozen=True)
class Figure:
    """A figure.

    Attributes:
        name: of its file, without `.svg`.
        caption: what it shows and how to read it.
        panels: its parts.
        whole: SVG of all parts side by side, for the file.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    whole: str


Block: TypeAlias = Text | Points | Table | Figure


@dataclass(frozen=True)
class Section:
    """A heading and what is below it."""

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
