"""The picture of a salvaged episode shows what the decision says, on any topic map."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from episodes import make_episode

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from decided import decide_on
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import Decision
from curation_ros.core.episode.episode import Episode
from curation_ros.reporting.salvage_picture import (
    salvage_drawing,
    salvage_figure,
    save_salvage_figure,
)

OPEN_AT = 150


@pytest.fixture(scope="module")
def dropped() -> Episode:
    return make_episode(open_at=OPEN_AT, name="pick-7")


@pytest.fixture(scope="module")
def decision(dropped: Episode) -> Decision:
    found = decide_on(Curation.fit(), dropped)
    assert found.verdict == "salvage"
    return found


def drawn(episode: Episode, decision: Decision) -> list[Axes]:
    canvas = Canvas()
    salvage_drawing(episode, decision).draw(canvas)
    return canvas.axes


def without(episode: Episode, *names: str, gripper: bool = True) -> Episode:
    """The same episode of a robot that has no such fields."""
    fields = {k: v for k, v in episode.fields.items() if k not in names}
    mapped = episode.topic_map
    specs = {k: v for k, v in mapped.fields.items() if k not in names}
    mapped = replace(mapped, fields=specs, gripper=mapped.gripper if gripper else None)
    return replace(episode, fields=fields, topic_map=mapped)


def texts_above(axes: Axes) -> list[str]:
    return [text.get_text() for text in axes.texts]


def lines_across(axes: Axes) -> list[float]:
    """Times of the lines that go from the bottom of a panel to its top."""
    return [float(x[0]) for line in axes.lines if len(x := line.get_xdata()) == 2]


def test_every_panel_has_the_cut_and_the_break(dropped: Episode, decision: Decision) -> None:
    cut_s = decision.span[1] / 1e9
    broke_s = decision.evidence["salvage"]["broke_ns"] / 1e9
    assert broke_s == (dropped.stamps_ns[OPEN_AT] - dropped.start_ns) / 1e9
    panels = drawn(dropped, decision)
    assert len(panels) == 3
    for axes in panels:
        assert lines_across(axes) == [cut_s, broke_s]
        [kept] = [p for p in axes.patches if p.get_alpha()]
        assert (kept.get_x(), kept.get_x() + kept.get_width()) == pytest.approx((0.01, cut_s))
    assert texts_above(panels[0]) == [
        f"told to open at {broke_s:.2f} s",
        f"cut: kept until {cut_s:.2f} s",
    ]


def test_curves_are_the_lost_object_and_the_effector(dropped: Episode, decision: Decision) -> None:
    heights, gripper, _ = drawn(dropped, decision)
    lines = {line.get_label(): line for line in heights.lines}
    assert np.array_equal(lines["bowl"].get_ydata(), dropped.field("bowl_position")[:, 2])
    assert np.array_equal(lines["effector"].get_ydata(), dropped.field("eef_position")[:, 2])
    assert "plate" not in lines
    command = gripper.lines[0].get_ydata()
    assert np.array_equal(command, -np.sign(dropped.field("gripper")[:, 0]))


def test_a_phase_has_a_bar_from_its_first_step_to_the_next_phase(
    dropped: Episode, decision: Decision
) -> None:
    phases = drawn(dropped, decision)[2]
    names = [label.get_text() for label in phases.get_yticklabels()]
    assert names == ["pregrasp", "descend", "grasp", "lift", "transport", "release"]
    [lift] = phases.collections[3].get_paths()
    steps = np.flatnonzero(dropped.phase == 3)
    first_s, next_s = (dropped.stamps_ns[[steps[0], steps[-1] + 1]] - dropped.start_ns) / 1e9
    assert (lift.vertices[:, 0].min(), lift.vertices[:, 0].max()) == pytest.approx(
        (first_s, next_s)
    )


def _no_object(e: Episode) -> Episode:
    return without(e, "bowl_position", "plate_position")


def _no_gripper(e: Episode) -> Episode:
    return without(e, "gripper", "finger_position", gripper=False)


def _no_phase(e: Episode) -> Episode:
    return without(e, "phase")


def _nothing_known(e: Episode) -> Episode:
    bare = without(_no_phase(_no_gripper(_no_object(e))), "eef_position")
    return replace(bare, topic_map=replace(bare.topic_map, clock="joint_position"))


@pytest.mark.parametrize(
    ("change", "n_panels", "curves"),
    [
        (_no_object, 3, {"effector"}),
        (_no_gripper, 2, {"effector", "bowl"}),
        (_no_phase, 2, {"effector", "bowl"}),
        (_nothing_known, 1, set()),
    ],
)
def test_panels_without_data_are_left_out(
    dropped: Episode,
    decision: Decision,
    change: Callable[[Episode], Episode],
    n_panels: int,
    curves: set[str],
) -> None:
    panels = drawn(change(dropped), decision)
    assert len(panels) == n_panels
    named = {str(line.get_label()) for line in panels[0].lines}
    assert {name for name in named if not name.startswith("_")} == curves
    assert lines_across(panels[-1])[0] == decision.span[1] / 1e9


def test_an_object_without_a_single_pose_is_left_out(dropped: Episode, decision: Decision) -> None:
    nowhere = np.full_like(dropped.field("bowl_position"), np.nan)
    blind = replace(dropped, fields={**dropped.fields, "bowl_position": nowhere})
    labels = {line.get_label() for line in drawn(blind, decision)[0].lines}
    assert "bowl" not in labels


def test_a_break_without_a_command_is_called_a_break(dropped: Episode, decision: Decision) -> None:
    left_ns = decision.evidence["seen"]["object_coupling"]["span"][0]
    cause = {**decision.evidence["salvage"], "broke_ns": left_ns}
    by_itself = replace(decision, evidence={**decision.evidence, "salvage": cause})
    assert texts_above(drawn(dropped, by_itself)[0])[0] == f"broke at {left_ns / 1e9:.2f} s"


def test_a_person_may_keep_a_span_from_the_middle(dropped: Episode) -> None:
    span = (2_000_000_000, 6_000_000_000)
    chosen = Decision(dropped.id, dropped.name, "salvage", "the middle is fine", span, by="ann")
    heights = drawn(dropped, chosen)[0]
    assert lines_across(heights) == [2.0, 6.0]
    assert texts_above(heights) == ["cut: kept until 6.00 s", "kept from 2.00 s"]


def test_reviewed_episode_has_no_cut_and_nothing_shaded(dropped: Episode) -> None:
    review = Decision(dropped.id, dropped.name, "review", "no rule", (0, 6_000_000_000))
    heights = drawn(dropped, review)[0]
    assert (lines_across(heights), texts_above(heights), list(heights.patches)) == ([], [], [])


def test_files_are_written_with_name_and_reason(
    dropped: Episode, decision: Decision, tmp_path: Path
) -> None:
    odd = replace(decision, name="a$b$ <7>", reason="long " * 200)
    png, svg = save_salvage_figure(dropped, odd, tmp_path)
    assert (png.name, svg.name) == ("salvaged.png", "salvaged.svg")
    assert png.read_bytes().startswith(b"\x89PNG")
    texts = [e.text or "" for e in ET.parse(svg).iter("{http://www.w3.org/2000/svg}text")]
    title = [text for text in texts if "long" in text]
    assert title[0].startswith("a$b$ <7>: salvage. long long")
    assert len(title) == 3
    assert title[-1].endswith("...")


def test_the_figure_of_a_report_is_the_same_each_time(
    dropped: Episode, decision: Decision
) -> None:
    one, other = (salvage_figure(dropped, decision, "picked") for _ in range(2))
    assert one == other
    assert one.name == "picked"
    assert decision.reason in one.caption
    assert decision.reason in one.panels[0].alt
