"""What the panels of a report share: colours, names, axes, baselines, intervals and legends."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import mean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MultipleLocator, PercentFormatter

from curation_ros.core.types import JsonObject
from curation_ros.reporting.rows import row_named

BLUE, ORANGE, GREEN, PURPLE = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
GREY, DARK = "#767676", "#333333"
#: Okabe and Ito's colours, which colour-blind readers can tell apart. A scorer has the same
#: colour in all figures, and a marker of its own for print without colour.
_STYLES: dict[str, tuple[str, str]] = {
    "knn": (BLUE, "o"),
    "gripper_timing": (ORANGE, "s"),
    "trajectory_alignment": (GREEN, "^"),
    "ensemble": (PURPLE, "D"),
    "isolation_forest": ("#E69F00", "v"),
    "smoothness": ("#56B4E9", "P"),
    "entropy": ("#B8A800", "X"),
    "length": ("#000000", "*"),
}
#: Baselines drawn as horizontal lines: row -> dashes.
_LINES: dict[str, Any] = {
    "oracle": "--",
    "reference": "-.",
    "everything": ":",
    "decided": (0, (8, 2)),
    "decided+random_cut": (0, (1, 3)),
}
_TWIN = "_label_free"
#: Least distance between the labels of two horizontal lines, in success.
_LABEL_GAP = 0.065


def style(scorer: str) -> dict[str, Any]:
    """Colour and marker of a scorer; a label-free twin has an open marker."""
    color, marker = _STYLES.get(scorer.removesuffix(_TWIN), (GREY, "h"))
    face = "white" if scorer.endswith(_TWIN) else color
    return {"color": color, "marker": marker, "markerfacecolor": face}


def stage_title(stage: JsonObject) -> str:
    """Name and kind of a stage; the kind is left out if the name contains it."""
    if stage["kind"] in stage["name"]:
        return str(stage["name"])
    return f"{stage['name']} ({stage['kind']})"


def file_name(name: str) -> str:
    """A name in which every character may appear in a file name."""
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in name)


def spoken(name: str) -> str:
    """A name as people read it."""
    return name.replace("_", " ")


def seed_rates(row: JsonObject) -> list[float]:
    """Success rate of each training seed's policy."""
    return [c["successes"] / c["n"] for c in row["counts"]]


def success_axis(axes: Axes) -> None:
    """Make the vertical axis one of success rates."""
    axes.set_ylim(-0.04, 1.04)
    axes.set_ylabel("success")
    axes.yaxis.set_major_locator(MultipleLocator(0.2))
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))


def draw_points(
    axes: Axes, rows: Sequence[JsonObject], label: str, look: Mapping[str, Any], line: str = "-"
) -> None:
    """Draw success with intervals over the number kept, and a dot for each training seed."""
    if not rows:
        return
    errors = [error_bar(r["rate"], r["interval"]) or [[0.0], [0.0]] for r in rows]
    axes.errorbar(
        [r["keep"] for r in rows],
        [r["rate"] for r in rows],
        yerr=[[e[side][0] for e in errors] for side in (0, 1)],
        label=label,
        linestyle=line,
        linewidth=1.4,
        elinewidth=0.9,
        markersize=5,
        zorder=3,
        **look,
    )
    dots = [(r["keep"], rate) for r in rows for rate in seed_rates(r)]
    axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color=look["color"], alpha=0.5)


def draw_control(
    axes: Axes,
    draws: Mapping[int, Sequence[JsonObject]],
    label: str,
    *,
    band: bool = False,
    **look: Any,
) -> None:
    """Draw the mean success of a control over its draws, and with `band` their range.

    Args:
        axes: where to draw.
        draws: number kept -> rows of the control, one for each draw.
        label: name in the legend.
        band: whether to fill the range of the draws.
        **look: colour and line style, as matplotlib takes them.
    """
    rates = {k: [r["rate"] for r in some if r["rate"] is not None] for k, some in draws.items()}
    rates = {k: some for k, some in rates.items() if some}
    if not rates:
        return
    axes.plot(list(rates), [mean(v) for v in rates.values()], label=label, linewidth=1, **look)
    if band and any(len(v) > 1 for v in rates.values()):
        low, high = [min(v) for v in rates.values()], [max(v) for v in rates.values()]
        color = look["color"]
        axes.fill_between(list(rates), low, high, color=color, alpha=0.18, lw=0, zorder=0)


def draw_baselines(axes: Axes, rows: Sequence[JsonObject]) -> None:
    """Draw the rows that keep no number as labelled horizontal lines."""
    baselines = {name: row_named(rows, name) for name in _LINES}
    draw_lines(axes, {k: r["rate"] for k, r in baselines.items() if r and r["rate"] is not None})


def draw_lines(axes: Axes, rates: Mapping[str, float]) -> None:
    """Draw success rates of baselines as labelled horizontal lines."""
    for name, y in zip(rates, spread_apart(list(rates.values()), _LABEL_GAP), strict=True):
        axes.axhline(rates[name], color=GREY, linewidth=0.9, linestyle=_LINES[name], zorder=1)
        axes.annotate(
            name,
            (1, y),
            xycoords=("axes fraction", "data"),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=GREY,
            annotation_clip=False,
        )


def spread_apart(values: Sequence[float], gap: float, floor: float = 0.0) -> list[float]:
    """Move values down, from the highest on, until they are `gap` apart; none below `floor`."""
    placed: dict[int, float] = {}
    above = math.inf
    for k in sorted(range(len(values)), key=lambda k: -values[k]):
        above = placed[k] = min(values[k], above - gap)
    too_low = max(0.0, floor - min(placed.values(), default=floor))
    return [placed[k] + too_low for k in range(len(values))]


def draw_legend(canvas: Canvas, axes: Axes, columns: int) -> None:
    """Draw the legend below the axes; nothing if nothing has a label."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        canvas.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=columns,
            handlelength=1.6,
            columnspacing=1.0,
            handletextpad=0.4,
        )


def error_bar(value: float, interval: Sequence[float] | None) -> list[list[float]] | None:
    """An interval as matplotlib takes it; a bound on the wrong side by rounding is the value."""
    if interval is None:
        return None
    return [[max(0.0, value - interval[0])], [max(0.0, interval[1] - value)]]
