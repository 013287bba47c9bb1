"""Draws the figures of a report, as SVG whose text stays text."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import mean
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MultipleLocator, PercentFormatter

from curation_ros.core.episode.phases import PHASES
from curation_ros.reporting import published
from curation_ros.reporting.blocks import Figure, Panel
from curation_ros.reporting.findings import Row, at_keep, draws, is_plain, named

#: Okabe and Ito's colours, told apart by colour-blind eyes; a scorer has its own in all figures,
#: and a marker for print without colour.
_STYLES: dict[str, tuple[str, str]] = {
    "knn": ("#0072B2", "o"),
    "gripper_timing": ("#D55E00", "s"),
    "trajectory_alignment": ("#009E73", "^"),
    "ensemble": ("#CC79A7", "D"),
    "isolation_forest": ("#E69F00", "v"),
    "smoothness": ("#56B4E9", "P"),
    "entropy": ("#B8A800", "X"),
    "length": ("#000000", "*"),
}
_GREY, _DARK = "#767676", "#333333"
_SUCCEEDED, _FAILED = "#0072B2", "#D55E00"
#: Baselines that are drawn as lines across: row -> dashes.
_LINES: dict[str, Any] = {
    "oracle": "--",
    "reference": "-.",
    "everything": ":",
    "decided": (0, (8, 2)),
    "decided+random_cut": (0, (1, 3)),
}
#: Least distance of two points in AUROC, so that equal ones can be told apart.
_BESIDE = 0.02
_TWIN = "_label_free"
#: Where an SVG names an id.
_USES = re.compile(r'(url\(#|href="#)([^)"]+)')
RC: Any = {  # typed by matplotlib as one of its 400 keys
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
    "text.parse_math": False,  # a name with dollars in it is a name
    "figure.facecolor": "white",
}


@dataclass(frozen=True)
class Drawing:
    """A panel that can be drawn alone and beside others.

    Attributes:
        draw: onto a figure or a part of one.
        alt: what it shows, for those who do not see it.
        size_in: width and height, inches.
    """

    draw: Callable[[Canvas], None]
    alt: str
    size_in: tuple[float, float] = (4.6, 4.2)


def figure(name: str, caption: str, drawings: Sequence[Drawing], columns: int = 2) -> Figure:
    """Draw all panels; in the file of the figure they stand side by side."""
    panels = tuple(
        Panel(_inline(_svg(d.draw, d.size_in), f"{name}-{k}", d.alt), d.alt)
        for k, d in enumerate(drawings)
    )
    return Figure(name, caption, panels, _together(panels, drawings[0].size_in, columns))


def _together(panels: Sequence[Panel], size_in: tuple[float, float], columns: int) -> str:
    """One SVG of panels of equal size."""
    columns = min(columns, len(panels))
    width, height = (72 * inches for inches in size_in)  # an SVG of matplotlib counts in points
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


def _svg(draw: Callable[[Canvas], None], size_in: tuple[float, float]) -> str:
    with mpl.rc_context(RC):
        canvas = Canvas(figsize=size_in, layout="constrained")
        draw(canvas)
        _settle(canvas)
        out = io.StringIO()
        # Without date and version the same figures give the same bytes.
        nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        canvas.savefig(out, format="svg", metadata=nothing)
    # A hundredth of a point is finer than any screen, and a third of the bytes.
    svg = re.sub(r' d="[^"]*"', lambda d: re.sub(r"(\.\d\d)\d+", r"\1", d[0]), out.getvalue())
    return _numbered(svg)


def _settle(canvas: Canvas) -> None:
    """Lay out, and round: the solver of the layout gives other last bits each time."""
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")
    for axes in canvas.axes:
        left, bottom, width, height = (round(x, 4) for x in axes.get_position().bounds)
        axes.set_position((left, bottom, width, height))


def _numbered(svg: str) -> str:
    """An SVG with the ids that it uses, numbered: shorter than matplotlib's hashes."""
    used = {
        i: f"i{k}" for k, i in enumerate(dict.fromkeys(name for _, name in re.findall(_USES, svg)))
    }

    def own(found: re.Match[str]) -> str:
        return f' id="{used[found[1]]}"' if found[1] in used else ""

    svg = re.sub(r' id="([^"]+)"', own, svg)
    return re.sub(_USES, lambda found: f"{found[1]}{used[found[2]]}", svg)


def _inline(svg: str, prefix: str, alt: str) -> str:
    """A numbered SVG that can stand in a page beside others: no prolog, and ids of its own."""
    svg = svg[svg.index("<svg") :].strip()
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{prefix}-", svg)
    quoted = alt.replace("&", "&amp;").replace('"', "&quot;").replace("<", "&lt;")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{quoted}" ', 1)


def style(scorer: str) -> dict[str, Any]:
    """Colour and marker of a scorer; a twin without labels has an open one."""
    color, marker = _STYLES.get(scorer.removesuffix(_TWIN), (_GREY, "h"))
    face = "white" if scorer.endswith(_TWIN) else color
    return {"color": color, "marker": marker, "markerfacecolor": face}


def _of(stage: Row) -> str:
    """Name and kind of a stage, once where they are the same."""
    return (
        stage["name"] if stage["kind"] in stage["name"] else f"{stage['name']} ({stage['kind']})"
    )


def safe(name: str) -> str:
    """A name that may stand in a file's name."""
    return "".join(c if c.isalnum() or c in "._-" else "_" for c in name)


def spoken(name: str) -> str:
    """A name as people read it."""
    return name.replace("_", " ")


def detection_panel(
    stage: Row, pool: str, variant: str, rows: Sequence[Row], keep: int
) -> Drawing:
    """AUROC against success, a point a scorer at one number kept."""
    points = [r for r in at_keep(rows, keep) if r["rate"] is not None and r["auroc"] is not None]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        _lines(axes, rows)
        places = _apart([r["auroc"] for r in points], _BESIDE, floor=-1.0)
        for x, row in zip(places, points, strict=True):
            y = row["rate"]
            look = style(row["scorer"])
            axes.errorbar(
                x,
                y,
                xerr=_error(x, row["auroc_ci"]),
                yerr=_error(y, row["interval"]),
                label=spoken(row["scorer"]),
                elinewidth=0.9,
                linestyle="none",
                markersize=7,
                zorder=3,
                **look,
            )
            seeds = [c["successes"] / c["n"] for c in row["counts"]]
            axes.plot([x] * len(seeds), seeds, ".", color=look["color"], alpha=0.6, markersize=5)
        _detection_axes(axes, f"{_of(stage)}: {pool}, {variant}, {keep} kept")
        _legend(canvas, axes, 3)

    alt = (
        f"AUROC against success, {_of(stage)}, pool {pool}, observations {variant}, {keep} kept: "
        + ", ".join(f"{spoken(r['scorer'])} {r['auroc']:.2f}, {r['rate']:.0%}" for r in points)
    )
    return Drawing(draw, alt)


def published_panel() -> Drawing:
    """The paper's own figure, and where its points are with the rows joined by name."""
    scored = [(k, p, p.auroc) for k, p in published.TABLE_2.items() if p.auroc is not None]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        _labelled(axes, {k: published.TABLE_2[k].success for k in ("oracle", "everything")})
        for name, one, auroc in scored:
            look = style(name)
            axes.errorbar(
                auroc,
                one.success,
                yerr=one.sd,
                label=spoken(name),
                elinewidth=0.9,
                linestyle="none",
                markersize=7,
                zorder=3,
                **look,
            )
            if one.joined is not None:
                axes.plot([auroc, one.joined], [one.success] * 2, color=look["color"], lw=0.7)
                hollow = {**look, "markerfacecolor": "white"}
                axes.plot(one.joined, one.success, markersize=5, linestyle="none", **hollow)
        _detection_axes(axes, f"the paper: {published.KEEP} kept (small, open: joined by name)")
        _legend(canvas, axes, 3)

    alt = "AUROC against success as the paper has it: " + ", ".join(
        f"{spoken(k)} {auroc:.2f}, {p.success:.0%}" for k, p, auroc in scored
    )
    return Drawing(draw, alt)


def _detection_axes(axes: Axes, title: str) -> None:
    axes.axvline(0.5, color="#dddddd", linewidth=0.8, zorder=0)
    axes.set_xlim(-0.03, 1.03)
    axes.set_xlabel("AUROC of the score")
    _success_axis(axes)
    axes.set_title(title, loc="left")


def _success_axis(axes: Axes) -> None:
    axes.set_ylim(-0.04, 1.04)
    axes.set_ylabel("success")
    axes.yaxis.set_major_locator(MultipleLocator(0.2))
    axes.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))


def keep_panel(
    found: Row, stage: Row, pool: str, variant: str, rows: Sequence[Row], scorer: str
) -> Drawing:
    """Success and purity of what one scorer keeps, against how many it keeps."""
    curve = sorted(
        (r for r in rows if is_plain(r) and r["scorer"] == scorer), key=lambda r: r["keep"]
    )
    done = [r for r in curve if r["rate"] is not None]

    def draw(canvas: Canvas) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
        look = style(scorer)
        _lines(upper, rows)
        _curve(upper, draws(rows, "oracle"), "oracle @ K", color=_DARK, linestyle="--")
        _curve(upper, draws(rows, "random"), "random @ K", color=_GREY, linestyle="-", band=True)
        _with_intervals(upper, done, spoken(scorer), look)
        upper.set_title(f"{spoken(scorer)}\n{_of(stage)}: {pool}, {variant}", loc="left")
        _success_axis(upper)
        ceiling = found["pools"][pool]["purity_ceiling"]
        xs = sorted(int(k) for k in ceiling)
        lower.plot(xs, [ceiling[str(k)] for k in xs], color=_DARK, linestyle="--", lw=1)
        pure = [r for r in curve if r["contamination"] is not None]
        lower.plot([r["keep"] for r in pure], [1 - r["contamination"] for r in pure], lw=1, **look)
        lower.set_ylim(-0.06, 1.06)
        lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        lower.set_ylabel("good of kept")
        lower.set_xlabel("number kept (lower, dashed: most that can be good)")
        _legend(canvas, upper, 3)

    alt = f"{spoken(scorer)}, success by number kept, {pool}, {variant}: " + ", ".join(
        f"{r['keep']}: {r['rate']:.0%}" for r in done
    )
    return Drawing(draw, alt, (4.2, 4.4))


def control_panel(stage: Row, pool: str, variant: str, rows: Sequence[Row]) -> Drawing:
    """Success of the sets that no scorer makes, against how many are kept."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        _lines(axes, rows)
        looks = {"oracle": ("--", "o"), "shuffled": ("-", "s"), "worst": ("-", "v")}
        colors = {"oracle": _DARK, "shuffled": "#CC79A7", "worst": "#D55E00"}
        for k, (name, (line, marker)) in enumerate(looks.items(), -1):
            # Side by side: intervals that lie upon each other cannot be read.
            found = [
                {**r, "keep": keep + 0.5 * k}
                for keep, some in draws(rows, name).items()
                for r in some
            ]
            done = [r for r in found if r["rate"] is not None]
            look = {"color": colors[name], "marker": marker, "markerfacecolor": "white"}
            _with_intervals(axes, done, f"{name} @ K", look, line)
        _curve(axes, draws(rows, "random"), "random @ K", color=_GREY, linestyle="-", band=True)
        _success_axis(axes)
        axes.set_xlabel("number kept")
        axes.set_title(f"controls\n{_of(stage)}: {pool}, {variant}", loc="left")
        _legend(canvas, axes, 2)

    alt = f"success of the controls by number kept, {pool}, {variant}"
    return Drawing(draw, alt, (4.2, 4.4))


def _with_intervals(
    axes: Axes, rows: Sequence[Row], label: str, look: Mapping[str, Any], line: str = "-"
) -> None:
    if not rows:
        return
    errors = [_error(r["rate"], r["interval"]) or [[0.0], [0.0]] for r in rows]
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
    dots = [(r["keep"], c["successes"] / c["n"]) for r in rows for c in r["counts"]]
    axes.plot([x for x, _ in dots], [y for _, y in dots], ".", color=look["color"], alpha=0.5)


def _curve(
    axes: Axes, found: Mapping[int, Sequence[Row]], label: str, *, band: bool = False, **look: Any
) -> None:
    """A control's mean over its draws, and their range."""
    rates = {k: [r["rate"] for r in some if r["rate"] is not None] for k, some in found.items()}
    rates = {k: some for k, some in rates.items() if some}
    if not rates:
        return
    axes.plot(list(rates), [mean(v) for v in rates.values()], label=label, linewidth=1, **look)
    if band and any(len(v) > 1 for v in rates.values()):
        low, high = [min(v) for v in rates.values()], [max(v) for v in rates.values()]
        color = look["color"]
        axes.fill_between(list(rates), low, high, color=color, alpha=0.18, lw=0, zorder=0)


def margin_panel(
    stage: Row, pool: str, variant: str, swept: Sequence[tuple[int, Row]], others: Sequence[Row]
) -> Drawing:
    """Success against how far before the break what is salvaged ends, control steps.

    Args:
        stage: of the rows.
        pool: of the rows.
        variant: of the rows.
        swept: margin and row.
        others: rows without a margin.
    """
    done = [{**row, "keep": margin} for margin, row in swept if row["rate"] is not None]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        _lines(axes, others)
        look = {"color": _SUCCEEDED, "marker": "o", "markerfacecolor": _SUCCEEDED}
        _with_intervals(axes, done, "decided + salvaged", look)
        for row in done:
            seeds = [c["successes"] / c["n"] for c in row["counts"]]
            axes.plot([row["keep"]] * len(seeds), seeds, ".", color=_GREY, markersize=5)
        _success_axis(axes)
        axes.set_xticks([margin for margin, _ in swept])
        axes.set_xlabel("margin before the break, control steps")
        axes.set_title(f"{_of(stage)}: {pool}, {variant}", loc="left")
        _legend(canvas, axes, 1)

    alt = f"success by margin, {pool}, {variant}: " + ", ".join(
        f"{row['keep']} steps: {row['rate']:.0%}" for row in done
    )
    return Drawing(draw, alt)


def contrast_panel(stage: Row) -> Drawing:
    """Planned contrasts: differences with their intervals."""
    planned = list(stage["contrasts"])
    height = 0.9 + 0.46 * len(planned)

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        for k, one in enumerate(planned):
            name = f"{one['a']} minus {one['b']} ({one['pool']}, {one['variant']})"
            value = one.get("value")
            axes.text(
                -1,
                k - 0.3,
                name if value is not None else f"{name}: no data",
                fontsize=8,
                bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
            )
            if value is None:
                continue
            p = one["p_holm"]
            is_resolved = p is not None and p < 0.05
            axes.errorbar(
                value,
                k,
                xerr=_error(value, one["interval"]),
                fmt="o",
                color="#0072B2" if is_resolved else _GREY,
                markerfacecolor="#0072B2" if is_resolved else "white",
                markersize=5,
            )
        axes.axvline(0, color=_DARK, linewidth=0.8, zorder=0)
        axes.set_xlim(-1.02, 1.02)
        axes.set_ylim(len(planned) - 0.4, -0.8)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.xaxis.set_major_locator(MultipleLocator(0.5))
        axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0, symbol=""))
        axes.set_xlabel("success of the first minus the second, percentage points")

    alt = f"{len(planned)} planned contrasts of stage {stage['name']}; the table has the figures"
    return Drawing(draw, alt, (5.4, height))


def traces_panel(traces: Sequence[Row], kept: set[str], title: str) -> Drawing:
    """Object height and gripper of kept and discarded demonstrations, phase by phase."""

    def draw(canvas: Canvas) -> None:
        grid = canvas.subplots(2, 2, sharex=True, sharey="row", height_ratios=(2, 1))
        for column, is_kept in enumerate((True, False)):
            some = [t for t in traces if (t["episode"] in kept) == is_kept]
            for good, color in ((False, _FAILED), (True, _SUCCEEDED)):
                for one in (t for t in some if t["good"] == good):
                    for axes, key in zip(
                        grid[:, column], ("object_height_m", "gripper"), strict=True
                    ):
                        values = [math.nan if v is None else v for v in one[key]]
                        axes.plot(values, color=color, linewidth=0.8, alpha=0.45)
            n_good = sum(bool(t["good"]) for t in some)
            what = f"{title}\nkept" if is_kept else "discarded"
            grid[0, column].set_title(f"{what}: {len(some)}, {n_good} good", loc="left")
            _phase_axis(grid[1, column], some)
        grid[0, 0].set_ylabel("object height, m")
        grid[1, 0].set_ylabel("gripper")
        grid[1, 0].set_yticks([-1, 1], ["open", "close"])
        grid[1, 0].set_ylim(-1.3, 1.3)

    return Drawing(draw, f"object height and gripper over the phases, {title}", (4.8, 4.0))


def _phase_axis(axes: Axes, traces: Sequence[Row]) -> None:
    n = max((len(t["gripper"]) for t in traces), default=0)
    width = n / len(PHASES)
    axes.set_xticks([])
    if not n:
        return
    axes.set_xlim(-0.5, n - 0.5)
    axes.set_xticks(
        [width * (k + 0.5) - 0.5 for k in range(len(PHASES))],
        [phase.lower() for phase in PHASES],
        rotation=60,
        ha="right",
        rotation_mode="anchor",
        fontsize=8,
    )
    for above in axes.get_shared_x_axes().get_siblings(axes):
        above.tick_params(axis="x", length=0)
        for k in range(1, len(PHASES)):
            above.axvline(width * k - 0.5, color="#e4e4e4", linewidth=0.6, zorder=0)


def _lines(axes: Axes, rows: Sequence[Row]) -> None:
    """Baselines that keep no number, as lines across."""
    found = {name: named(rows, name) for name in _LINES}
    _labelled(axes, {k: r["rate"] for k, r in found.items() if r and r["rate"] is not None})


def _labelled(axes: Axes, rates: Mapping[str, float]) -> None:
    for name, y in zip(rates, _apart(list(rates.values()), 0.065), strict=True):
        axes.axhline(rates[name], color=_GREY, linewidth=0.9, linestyle=_LINES[name], zorder=1)
        axes.annotate(
            name,
            (1, y),
            xycoords=("axes fraction", "data"),
            xytext=(3, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
            color=_GREY,
            annotation_clip=False,
        )


def _apart(heights: Sequence[float], gap: float, floor: float = 0.0) -> list[float]:
    """Places of what would lie upon each other: moved down from the highest, not below a floor."""
    placed: dict[int, float] = {}
    above = math.inf
    for k in sorted(range(len(heights)), key=lambda k: -heights[k]):
        above = placed[k] = min(heights[k], above - gap)
    too_low = max(0.0, floor - min(placed.values(), default=floor))
    return [placed[k] + too_low for k in range(len(heights))]


def _legend(canvas: Canvas, axes: Axes, columns: int) -> None:
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


def _error(value: float, interval: Sequence[float] | None) -> list[list[float]] | None:
    """What matplotlib wants of an interval; a bound that rounding puts within is the value."""
    if interval is None:
        return None
    return [[max(0.0, value - interval[0])], [max(0.0, interval[1] - value)]]
