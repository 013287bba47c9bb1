"""Draws figures as SVG: text stays text, and equal figures give equal bytes."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure as Canvas

from curation_ros.reporting.blocks import Figure, Panel

#: Where an SVG refers to an id.
_REFERENCES = re.compile(r'(url\(#|href="#)([^)"]+)')
_RC: Any = {  # matplotlib types the keys as literals
    "svg.fonttype": "none",
    "svg.hashsalt": "curation",
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans", "Verdana", "Arial"],
    "font.size": 9,
    "axes.titlesize": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 8,
    "text.parse_math": False,  # a name may contain dollar signs
    "figure.facecolor": "white",
}


@dataclass(frozen=True)
class Drawing:
    """A panel, not drawn yet.

    Attributes:
        draw: draws it onto an empty figure.
        alt: what it shows, for people who cannot see it.
        size_in: width and height, inches.
    """

    draw: Callable[[Canvas], None]
    alt: str
    size_in: tuple[float, float] = (4.6, 4.2)


def figure(name: str, caption: str, drawings: Sequence[Drawing], columns: int = 2) -> Figure:
    """Draw all panels of a figure.

    Args:
        name: name of its file, without the ending; it must differ between figures of a page.
        caption: what it shows and how to read it.
        drawings: its panels, of equal size.
        columns: number of panels side by side in the file.
    """
    panels = tuple(
        Panel(inline_svg(_svg(d), f"{name}-{k}", d.alt), d.alt) for k, d in enumerate(drawings)
    )
    return Figure(name, caption, panels, _together(panels, drawings[0].size_in, columns))


def save_png(drawing: Drawing, path: Path, dpi: float) -> None:
    """Write a panel as a PNG file."""
    with mpl.rc_context(_RC):
        _canvas(drawing).savefig(path, dpi=dpi)


def _canvas(drawing: Drawing) -> Canvas:
    canvas = Canvas(figsize=drawing.size_in, layout="constrained")
    drawing.draw(canvas)
    return canvas


def _together(panels: Sequence[Panel], size_in: tuple[float, float], columns: int) -> str:
    """One SVG of panels of equal size."""
    columns = min(columns, len(panels))
    width, height = (72 * inches for inches in size_in)  # matplotlib's SVGs are in points
    whole = f"{columns * width:g}", f"{math.ceil(len(panels) / columns) * height:g}"
    parts = []
    for k, panel in enumerate(panels):
        place = f'<svg x="{k % columns * width:g}" y="{k // columns * height:g}" '
        part = panel.svg.replace("<svg ", place, 1)
        parts.append(re.sub(r' (width|height)="([\d.]+)pt"', r' \1="\2"', part, count=2))
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" '
        f'width="{whole[0]}pt" height="{whole[1]}pt" viewBox="0 0 {whole[0]} {whole[1]}">\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def _svg(drawing: Drawing) -> str:
    with mpl.rc_context(_RC):
        canvas = _canvas(drawing)
        _fix_layout(canvas)
        out = io.StringIO()
        # With a date or a version in it, equal figures would give different bytes.
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas.savefig(out, format="svg", metadata=nothing)
    # Two decimals are finer than any screen, and take a third of the bytes.
    svg = re.sub(r' d="[^"]*"', lambda d: re.sub(r"(\.\d\d)\d+", r"\1", d[0]), out.getvalue())
    return number_ids(svg)


def _fix_layout(canvas: Canvas) -> None:
    """Lay out and round, because the last bits of the layout differ between runs."""
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")
    for axes in canvas.axes:
        left, bottom, width, height = (round(x, 4) for x in axes.get_position().bounds)
        axes.set_position((left, bottom, width, height))


def number_ids(svg: str) -> str:
    """Replace the ids in an SVG by short numbers, and drop those without a reference."""
    referenced = dict.fromkeys(name for _, name in re.findall(_REFERENCES, svg))
    used = {name: f"i{k}" for k, name in enumerate(referenced)}

    def own(found: re.Match[str]) -> str:
        return f' id="{used[found[1]]}"' if found[1] in used else ""

    svg = re.sub(r' id="([^"]+)"', own, svg)
    return re.sub(_REFERENCES, lambda found: f"{found[1]}{used[found[2]]}", svg)


def inline_svg(svg: str, prefix: str, alt: str) -> str:
    """Make an SVG fit to be part of a page.

    Args:
        svg: a whole file with numbered ids.
        prefix: put before each id, to tell it from those of other figures.
        alt: text for people who cannot see the figure.

    Returns:
        The SVG element, without the prolog of the file.
    """
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    quoted = alt.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{quoted}" ', 1)
