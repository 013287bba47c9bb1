"""The panels of a report's figures."""

from __future__ import annotations

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MultipleLocator, PercentFormatter

from curation_ros.batch import published
from curation_ros.core.types import JsonObject
from curation_ros.reporting.drawing import Drawing
from curation_ros.reporting.plotting import (
    BLUE,
    DARK,
    GREY,
    ORANGE,
    PURPLE,
    draw_baselines,
    draw_control,
    draw_legend,
    draw_lines,
    draw_points,
    error_bar,
    seed_rates,
    spoken,
    spread_apart,
    stage_title,
    style,
    success_axis,
)
from curation_ros.reporting.rows import draws_of, is_resolved, is_scorer_row, kept_by_scorers

#: Least distance of two points in AUROC, so that equal ones can be told apart.
_POINT_GAP = 0.02
_SUCCEEDED, _FAILED = BLUE, ORANGE


def detection_panel(
    stage: JsonObject, pool: str, variant: str, rows: Sequence[JsonObject], keep: int
) -> Drawing:
    """AUROC against success at one number kept, with one point per scorer."""
    points = [
        r for r in kept_by_scorers(rows, keep) if r["rate"] is not None and r["auroc"] is not None
    ]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        draw_baselines(axes, rows)
        places = spread_apart([r["auroc"] for r in points], _POINT_GAP, floor=-1.0)
        for x, row in zip(places, points, strict=True):
            y = row["rate"]
            look = style(row["scorer"])
            axes.errorbar(
                x,
                y,
                xerr=error_bar(x, row["auroc_ci"]),
                yerr=error_bar(y, row["interval"]),
                label=spoken(row["scorer"]),
                elinewidth=0.9,
                linestyle="none",
                markersize=7,
                zorder=3,
                **look,
            )
            rates = seed_rates(row)
            axes.plot([x] * len(rates), rates, ".", color=look["color"], alpha=0.6, markersize=5)
        _detection_axes(axes, f"{stage_title(stage)}: {pool}, {variant}, {keep} kept")
        draw_legend(canvas, axes, 3)

    alt = (
        f"AUROC against success, {stage_title(stage)}, pool {pool}, observations {variant}, "
        f"{keep} kept: "
        + ", ".join(f"{spoken(r['scorer'])} {r['auroc']:.2f}, {r['rate']:.0%}" for r in points)
    )
    return Drawing(draw, alt)


def published_panel() -> Drawing:
    """The paper's own figure, and its points with the rows joined by name."""
    scored = [(k, p, p.auroc) for k, p in published.TABLE_2.items() if p.auroc is not None]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        draw_lines(axes, {k: published.TABLE_2[k].success for k in ("oracle", "everything")})
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
        draw_legend(canvas, axes, 3)

    alt = "AUROC against success as the paper has it: " + ", ".join(
        f"{spoken(k)} {auroc:.2f}, {p.success:.0%}" for k, p, auroc in scored
    )
    return Drawing(draw, alt)


def _detection_axes(axes: Axes, title: str) -> None:
    axes.axvline(0.5, color="#dddddd", linewidth=0.8, zorder=0)
    axes.set_xlim(-0.03, 1.03)
    axes.set_xlabel("AUROC of the score")
    success_axis(axes)
    axes.set_title(title, loc="left")


def keep_panel(
    results: JsonObject,
    stage: JsonObject,
    pool: str,
    variant: str,
    rows: Sequence[JsonObject],
    scorer: str,
) -> Drawing:
    """Success and purity of what one scorer keeps, against the number kept."""
    curve = sorted(
        (r for r in rows if is_scorer_row(r) and r["scorer"] == scorer), key=lambda r: r["keep"]
    )
    done = [r for r in curve if r["rate"] is not None]

    def draw(canvas: Canvas) -> None:
        upper, lower = canvas.subplots(2, 1, sharex=True, height_ratios=(3, 1.2))
        look = style(scorer)
        draw_baselines(upper, rows)
        draw_control(upper, draws_of(rows, "oracle"), "oracle @ K", color=DARK, linestyle="--")
        draw_control(
            upper, draws_of(rows, "random"), "random @ K", color=GREY, linestyle="-", band=True
        )
        draw_points(upper, done, spoken(scorer), look)
        upper.set_title(f"{spoken(scorer)}\n{stage_title(stage)}: {pool}, {variant}", loc="left")
        success_axis(upper)
        ceiling = results["pools"][pool]["purity_ceiling"]
        xs = sorted(int(k) for k in ceiling)
        lower.plot(xs, [ceiling[str(k)] for k in xs], color=DARK, linestyle="--", lw=1)
        pure = [r for r in curve if r["contamination"] is not None]
        lower.plot([r["keep"] for r in pure], [1 - r["contamination"] for r in pure], lw=1, **look)
        lower.set_ylim(-0.06, 1.06)
        lower.yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
        lower.set_ylabel("good of kept")
        lower.set_xlabel("number kept (lower, dashed: most that can be good)")
        draw_legend(canvas, upper, 3)

    alt = f"{spoken(scorer)}, success by number kept, {pool}, {variant}: " + ", ".join(
        f"{r['keep']}: {r['rate']:.0%}" for r in done
    )
    return Drawing(draw, alt, (4.2, 4.4))


def control_panel(
    stage: JsonObject, pool: str, variant: str, rows: Sequence[JsonObject]
) -> Drawing:
    """Success of the sets that no scorer makes, against the number kept."""

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        draw_baselines(axes, rows)
        looks = {"oracle": ("--", "o"), "shuffled": ("-", "s"), "worst": ("-", "v")}
        colors = {"oracle": DARK, "shuffled": PURPLE, "worst": ORANGE}
        for k, (name, (line, marker)) in enumerate(looks.items(), -1):
            # Intervals at one place would hide each other, so each control is moved a little.
            moved = [
                {**r, "keep": keep + 0.5 * k}
                for keep, some in draws_of(rows, name).items()
                for r in some
            ]
            done = [r for r in moved if r["rate"] is not None]
            look = {"color": colors[name], "marker": marker, "markerfacecolor": "white"}
            draw_points(axes, done, f"{name} @ K", look, line)
        draw_control(
            axes, draws_of(rows, "random"), "random @ K", color=GREY, linestyle="-", band=True
        )
        success_axis(axes)
        axes.set_xlabel("number kept")
        axes.set_title(f"controls\n{stage_title(stage)}: {pool}, {variant}", loc="left")
        draw_legend(canvas, axes, 2)

    alt = f"success of the controls by number kept, {pool}, {variant}"
    return Drawing(draw, alt, (4.2, 4.4))


def margin_panel(
    stage: JsonObject,
    pool: str,
    variant: str,
    swept: Sequence[tuple[int, JsonObject]],
    others: Sequence[JsonObject],
) -> Drawing:
    """Success against the salvage margin.

    Args:
        stage: stage of the rows.
        pool: pool of the rows.
        variant: observations of the rows.
        swept: margin (control steps before the break) and row.
        others: rows without a margin, drawn as lines.
    """
    done = [{**row, "keep": margin} for margin, row in swept if row["rate"] is not None]

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        draw_baselines(axes, others)
        look = {"color": BLUE, "marker": "o", "markerfacecolor": BLUE}
        draw_points(axes, done, "decided + salvaged", look)
        for row in done:
            rates = seed_rates(row)
            axes.plot([row["keep"]] * len(rates), rates, ".", color=GREY, markersize=5)
        success_axis(axes)
        axes.set_xticks([margin for margin, _ in swept])
        axes.set_xlabel("margin before the break, control steps")
        axes.set_title(f"{stage_title(stage)}: {pool}, {variant}", loc="left")
        draw_legend(canvas, axes, 1)

    alt = f"success by margin, {pool}, {variant}: " + ", ".join(
        f"{row['keep']} steps: {row['rate']:.0%}" for row in done
    )
    return Drawing(draw, alt)


def contrast_panel(stage: JsonObject) -> Drawing:
    """Planned contrasts: differences with their intervals."""
    planned = list(stage["contrasts"])
    height = 0.9 + 0.46 * len(planned)

    def draw(canvas: Canvas) -> None:
        axes = canvas.subplots()
        for k, one in enumerate(planned):
            _draw_contrast(axes, k, one)
        axes.axvline(0, color=DARK, linewidth=0.8, zorder=0)
        axes.set_xlim(-1.02, 1.02)
        axes.set_ylim(len(planned) - 0.4, -0.8)
        axes.set_yticks([])
        axes.spines["left"].set_visible(False)
        axes.xaxis.set_major_locator(MultipleLocator(0.5))
        axes.xaxis.set_major_formatter(PercentFormatter(1, decimals=0, symbol=""))
        axes.set_xlabel("success of the first minus the second, percentage points")

    alt = f"{len(planned)} planned contrasts of stage {stage['name']}; the table has the figures"
    return Drawing(draw, alt, (5.4, height))


def _draw_contrast(axes: Axes, line: int, one: JsonObject) -> None:
    """Draw one contrast on its line: its name, and its difference if there are data."""
    name = f"{one['a']} minus {one['b']} ({one['pool']}, {one['variant']})"
    value = one.get("value")
    axes.text(
        -1,
        line - 0.3,
        name if value is not None else f"{name}: no data",
        fontsize=8,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5},
    )
    if value is None:
        return
    axes.errorbar(
        value,
        line,
        xerr=error_bar(value, one["interval"]),
        fmt="o",
        color=BLUE if is_resolved(one) else GREY,
        markerfacecolor=BLUE if is_resolved(one) else "white",
        markersize=5,
    )


def traces_panel(
    traces: Sequence[JsonObject], phases: Sequence[str], kept: set[str], title: str
) -> Drawing:
    """Object height and gripper of kept and discarded demonstrations, phase by phase.

    Args:
        traces: `traces` of a pool.
        phases: names of their phases, each of which has the same number of points.
        kept: ids of the episodes that are kept.
        title: title of the panel.
    """

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
            _phase_axis(grid[1, column], some, phases)
        grid[0, 0].set_ylabel("object height, m")
        grid[1, 0].set_ylabel("gripper")
        grid[1, 0].set_yticks([-1, 1], ["open", "close"])
        grid[1, 0].set_ylim(-1.3, 1.3)

    return Drawing(draw, f"object height and gripper over the phases, {title}", (4.8, 4.0))


def _phase_axis(axes: Axes, traces: Sequence[JsonObject], phases: Sequence[str]) -> None:
    """Name the phases on the horizontal axis, and draw their limits in the axes above, too."""
    n = max((len(t["gripper"]) for t in traces), default=0)
    axes.set_xticks([])
    if not n or not phases:
        return
    width = n / len(phases)
    axes.set_xlim(-0.5, n - 0.5)
    axes.set_xticks(
        [width * (k + 0.5) - 0.5 for k in range(len(phases))],
        [phase.lower() for phase in phases],
        rotation=60,
        ha="right",
        rotation_mode="anchor",
        fontsize=8,
    )
    for above in axes.get_shared_x_axes().get_siblings(axes):
        above.tick_params(axis="x", length=0)
        for k in range(1, len(phases)):
            above.axvline(width * k - 0.5, color="#e4e4e4", linewidth=0.6, zorder=0)
