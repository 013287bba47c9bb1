"""Draws one salvaged episode: heights, gripper, phases, the part that is kept, and the break."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from curation_ros.core.errors import EpisodeError
from curation_ros.core.evidence.carrying import carrying_of
from curation_ros.core.evidence.gripper import commanded
from curation_ros.core.types import NS_PER_S
from curation_ros.reporting.blocks import Figure
from curation_ros.reporting.drawing import Drawing, figure, save_png
from curation_ros.reporting.plotting import BLUE, GREEN, GREY, ORANGE, spoken

if TYPE_CHECKING:
    from curation_ros.core.decision.decision import Decision
    from curation_ros.core.episode.episode import Episode
    from curation_ros.core.types import Floats, Mask

_OBJECT, _EFFECTOR, _KEPT, _BROKE = BLUE, GREY, GREEN, ORANGE
_WIDTH_IN = 5.4
#: Heights in inches: of each panel, and of title, labels and time axis together.
_HEIGHTS_IN, _GRIPPER_IN, _PHASE_IN, _FRAME_IN = 1.7, 0.45, 0.16, 1.5
_REASON_COLUMNS, _REASON_LINES = 84, 3
#: At this resolution the text can be read in an image 400 pixels wide.
_PNG_DPI = 160
#: Height of a panel in inches, and the function that draws it.
_Panel: TypeAlias = tuple[float, Callable[[Axes], None]]


class _Mark(NamedTuple):
    """A vertical line at a time, with a text above it."""

    at_s: float
    text: str
    color: str
    dashes: str


def salvage_drawing(episode: Episode, decision: Decision) -> Drawing:
    """The picture of one decision; panels without data are left out.

    Args:
        episode: the whole episode.
        decision: the decision on it. Its span is the part that is kept.
    """
    times_s = (episode.stamps_ns - episode.start_ns) / NS_PER_S
    panels = [
        panel
        for panel in (
            _heights(episode, times_s),
            _gripper(episode, times_s),
            _phases(episode, times_s),
        )
        if panel is not None
    ] or [(_GRIPPER_IN, _nothing)]
    marks = _marks(episode, decision)

    def draw(canvas: Canvas) -> None:
        grid = canvas.subplots(
            len(panels), 1, sharex=True, squeeze=False, height_ratios=[h for h, _ in panels]
        )[:, 0]
        for axes, (_, panel) in zip(grid, panels, strict=True):
            panel(axes)
            if decision.verdict in ("keep", "salvage"):
                axes.axvspan(*_seconds(decision.span), color=_KEPT, alpha=0.13, lw=0, zorder=0)
            for mark in marks:
                axes.axvline(
                    mark.at_s, color=mark.color, linestyle=mark.dashes, linewidth=1.3, zorder=4
                )
        end_s = max((episode.end_ns - episode.start_ns) / NS_PER_S, 1.0 / NS_PER_S)
        grid[-1].set_xlim(0.0, end_s)
        grid[-1].set_xlabel("time from the start, s")
        _name_marks(grid[0], marks, end_s)
        canvas.suptitle(_title(decision), x=0.01, ha="left", fontsize=8.5)

    height = sum(h for h, _ in panels) + _FRAME_IN
    alt = f"{decision.name}: {decision.verdict}: {decision.reason}"
    return Drawing(draw, alt, (_WIDTH_IN, height))


def salvage_figure(episode: Episode, decision: Decision, name: str = "salvaged") -> Figure:
    """The picture as a figure of a report; see `salvage_drawing`."""
    caption = (
        f"{decision.name}: {decision.reason}. Shaded: what is kept for training; nothing is cut "
        "from the bag."
    )
    return figure(name, caption, [salvage_drawing(episode, decision)])


def save_salvage_figure(
    episode: Episode, decision: Decision, folder: Path, name: str = "salvaged"
) -> tuple[Path, Path]:
    """Write the picture as <name>.png and <name>.svg.

    Returns:
        Paths of the PNG and of the SVG file.
    """
    drawing = salvage_drawing(episode, decision)
    png, svg = folder / f"{name}.png", folder / f"{name}.svg"
    svg.write_text(figure(name, "", [drawing]).whole)
    save_png(drawing, png, _PNG_DPI)
    return png, svg


# --- panels ---------------------------------------------------------------------------------


def _heights(episode: Episode, times_s: Floats) -> _Panel | None:
    """Heights of the effector and of the object that was carried."""
    effectors = [
        s.name for s in episode.topic_map.with_role("effector") if _has_z(episode, s.name)
    ]
    lines = [(name, "effector", _EFFECTOR, "--") for name in effectors[:1]]
    carried = _object(episode)
    if carried:
        lines.append((carried, spoken(carried.removesuffix("_position")), _OBJECT, "-"))
    if not lines:
        return None

    def draw(axes: Axes) -> None:
        for name, label, color, dashes in lines:
            height_m = episode.fields[name][:, 2]
            axes.plot(times_s, height_m, dashes, color=color, label=label, linewidth=1.6)
        axes.set_ylabel("height, m")
        axes.margins(y=0.1)
        # An opaque legend hides the vertical lines behind it.
        axes.legend(loc="best", handlelength=1.8, frameon=True, framealpha=1, edgecolor="none")

    return _HEIGHTS_IN, draw


def _has_z(episode: Episode, name: str) -> bool:
    values = episode.fields.get(name)
    return values is not None and values.shape[1] >= 3 and bool(np.isfinite(values[:, 2]).any())


def _object(episode: Episode) -> str:
    """Field of the object that was lost, otherwise of the one that moved most up or down."""
    names = [s.name for s in episode.topic_map.with_role("object") if _has_z(episode, s.name)]
    try:
        worst = carrying_of(episode).worst
    except EpisodeError:  # without phases and gripper, the grasped object is unknown
        worst = None
    if worst is not None and worst.object in names:
        return worst.object
    return max(names, key=lambda n: float(_range(episode.fields[n][:, 2])), default="")


def _range(values: Floats) -> float:
    return float(np.nanmax(values) - np.nanmin(values))


def _gripper(episode: Episode, times_s: Floats) -> _Panel | None:
    """The commands to the gripper."""
    try:
        command = commanded(episode).astype(np.float64)
    except EpisodeError:
        return None
    command[command == 0] = np.nan  # before the first command

    def draw(axes: Axes) -> None:
        axes.step(times_s, command, where="post", color="#333333", linewidth=1.6)
        axes.set_yticks([-1, 1], ["closed", "open"])
        axes.set_ylim(-1.6, 1.6)

    return _GRIPPER_IN, draw


def _phases(episode: Episode, times_s: Floats) -> _Panel | None:
    """One row per phase, so that even the name of a short phase has room."""
    phase = episode.phase
    if phase is None:
        return None
    shown = [k for k in range(len(episode.phase_labels)) if bool((phase == k).any())]
    if not shown:
        return None
    period_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0

    def draw(axes: Axes) -> None:
        for row, k in enumerate(shown):
            axes.broken_barh(
                _runs(phase == k, times_s, period_s), (row - 0.35, 0.7), facecolors="#8C8C8C"
            )
        axes.set_yticks(
            range(len(shown)), [episode.phase_labels[k].lower() for k in shown], fontsize=8
        )
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(len(shown) - 0.4, -0.6)

    return _PHASE_IN * (len(shown) + 1), draw


def _runs(mask: Mask, times_s: Floats, period_s: float) -> list[tuple[float, float]]:
    """(start, duration) in seconds of every run of steps in which the mask is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [
        (float(times_s[first]), float(times_s[stop - 1] - times_s[first]) + period_s)
        for first, stop in zip(edges[::2], edges[1::2], strict=True)
    ]


def _nothing(axes: Axes) -> None:
    axes.set_yticks([])


# --- what was decided -----------------------------------------------------------------------


def _seconds(span: tuple[int, int]) -> tuple[float, float]:
    return span[0] / NS_PER_S, span[1] / NS_PER_S


def _marks(episode: Episode, decision: Decision) -> list[_Mark]:
    """The vertical lines: the ends of the part that is kept, and the break."""
    first_s, last_s = _seconds(decision.span)
    marks: list[_Mark] = []
    if decision.verdict == "salvage":
        if len(episode) and decision.span[0] > episode.span(0, 0)[0]:
            marks.append(_Mark(first_s, f"kept from {first_s:.2f} s", _KEPT, "-"))
        marks.append(_Mark(last_s, f"cut: kept until {last_s:.2f} s", _KEPT, "-"))
    broke_ns = decision.evidence.get("salvage", {}).get("broke_ns")
    if broke_ns is not None:
        at_s = broke_ns / NS_PER_S
        marks.append(_Mark(at_s, f"{_what_broke(decision)} at {at_s:.2f} s", _BROKE, "--"))
    return marks


def _what_broke(decision: Decision) -> str:
    """The break is the command to open if that came first, otherwise the loss itself."""
    broke = decision.evidence["salvage"]
    span = decision.evidence.get("seen", {}).get(broke["scorer"], {}).get("span")
    return "told to open" if span and broke["broke_ns"] < span[0] else "broke"


def _name_marks(axes: Axes, marks: Sequence[_Mark], end_s: float) -> None:
    """Write the text of each mark on a line of its own, so that near marks do not overlap."""
    for row, mark in enumerate(reversed(marks)):
        to_the_right = mark.at_s < 0.5 * end_s
        axes.annotate(
            mark.text,
            (mark.at_s, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(2 if to_the_right else -2, 3 + 11 * row),
            textcoords="offset points",
            ha="left" if to_the_right else "right",
            fontsize=8,
            color=mark.color,
            annotation_clip=False,
        )


def _title(decision: Decision) -> str:
    lines = textwrap.wrap(
        f"{decision.name}: {decision.verdict}. {decision.reason}",
        _REASON_COLUMNS,
        max_lines=_REASON_LINES,
        placeholder=" ...",
    )
    return "\n".join(lines)
