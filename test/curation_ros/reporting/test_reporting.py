"""Reports: whole files that load nothing, with everything in them that they announce."""

from __future__ import annotations

import html
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from made_study import made_results, small_plan  # noqa: E402 - needs LIBERO
from reading import MOST_BYTES  # noqa: E402 - as above

from curation_ros.core.errors import ConfigError  # noqa: E402 - as above
from curation_ros.reporting import write_report  # noqa: E402 - as above
from curation_ros.reporting.answers import answers  # noqa: E402 - as above


def test_the_page_loads_nothing_and_is_small(report: list[Path]) -> None:
    page = report[0]
    text = page.read_text()
    assert page.name == "report.html"
    assert len(text.encode()) < MOST_BYTES
    loaded = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', text)
    assert [x for x in loaded if not x.startswith("#")] == []
    assert not re.search(r"@import|url\((?!#)|<script|<link|<iframe|<img", text)


def test_ids_in_the_page_are_its_own_and_known(report: list[Path]) -> None:
    text = report[0].read_text()
    ids = re.findall(r'\bid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:url\(#|href="#)([^)"]+)', text)) <= set(ids)


def test_names_from_outside_are_escaped(found: dict[str, Any], tmp_path: Path) -> None:
    bad = '<script>alert("x")</script> & $a_b$'
    text = json.dumps(found).replace('"paired"', json.dumps(bad)).replace("does <it>", "<b>it")
    spoilt = json.loads(text)
    spoilt["name"] = bad
    spoilt["problems"] = [bad]
    written = write_report(spoilt, tmp_path)
    page = written[0].read_text()
    assert "<script" not in page
    assert "<b>" not in page
    assert html.escape(bad) in page
    for path in written[2:]:
        assert path.parent == tmp_path
        ET.parse(path)
    lines = written[1].read_text().splitlines()
    assert not [line for line in lines if re.search(r"(?<!\\)<(script|b)>", line)]


def test_markdown_tables_keep_their_columns(report: list[Path]) -> None:
    text = report[1].read_text()
    assert r"is it worth \| anything?" in text
    widths: list[int] = []
    for line in text.splitlines():
        if not line.startswith("|"):
            assert len(set(widths)) <= 1
            widths = []
            continue
        widths.append(len(re.findall(r"(?<!\\)\|", line)))


def test_markdown_shows_the_figures_that_are_written(report: list[Path]) -> None:
    shown = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", report[1].read_text())
    assert shown == [path.name for path in report[2:]]
    assert "figure-main.svg" in shown
    for path in report[2:]:
        assert ET.parse(path).getroot().tag.endswith("svg")


def test_equal_results_give_equal_bytes(
    found: dict[str, Any], report: list[Path], tmp_path: Path
) -> None:
    again = write_report(found, tmp_path)
    assert [p.name for p in again] == [p.name for p in report]
    for one, other in zip(again, report, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


def test_traces_are_drawn_with_the_phases_of_their_pool(
    found: dict[str, Any], report: list[Path], tmp_path: Path
) -> None:
    name = "figure-traces-paired.svg"
    assert "second</text>" in (report[0].parent / name).read_text()
    found["pools"]["paired"].pop("phases")  # as in results of older versions
    write_report(found, tmp_path)
    old = (tmp_path / name).read_text()
    assert "descend</text>" in old
    assert "second</text>" not in old


def test_text_in_figures_is_text(report: list[Path]) -> None:
    text = (report[0].parent / "figure-main.svg").read_text()
    assert "gripper timing</text>" in text
    assert "@font-face" not in text


def test_nothing_is_written_if_these_are_no_results(found: dict[str, Any], tmp_path: Path) -> None:
    found.pop("stages")
    with pytest.raises(ConfigError, match="no key 'stages'"):
        write_report(found, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_without_outcomes_the_report_names_what_is_missing(
    nothing_done: dict[str, Any], tmp_path: Path
) -> None:
    text = html.unescape(write_report(nothing_done, tmp_path)[0].read_text())
    n = nothing_done["stages"][0]["missing"]
    assert f"Missing: {n} outcomes of stage paper." in text
    assert "Missing: no pool has outcomes of three scorers" in text
    assert "Missing: data for 2 of 2 contrasts" in text
    assert "Missing: outcomes of stage screening" in text
    assert "policy <x>: it did not converge" in text
    message = answers(nothing_done)
    assert f"{n} in stage paper" in message[0]
    assert "is open" in message[1]
    assert "2 have no data" in " ".join(message)


def test_a_report_without_stages_or_pools_is_written(
    found: dict[str, Any], tmp_path: Path
) -> None:
    found["stages"], found["pools"] = [], {}
    text = write_report(found, tmp_path)[0].read_text()
    assert "planned no contrasts" in text


def test_screens_are_marked(found: dict[str, Any], report: list[Path]) -> None:
    message = " ".join(answers(found))
    assert "Stage screening (a look, not a claim)" in message
    text = report[0].read_text()
    assert "nothing is claimed from them" in text
    assert "screening: paired, relative, 12 kept" in text


def test_looks_at_the_official_starts_are_counted(report: list[Path]) -> None:
    text = html.unescape(report[0].read_text())
    assert "Looks at the official starts: 2, namely" in text
    assert "before: a prototype's" in text
    assert "stage confirmation of this study" in text


def test_stages_that_were_left_out_are_named(salvaged: dict[str, Any], tmp_path: Path) -> None:
    part = {**salvaged, "stages_left_out": ["sure"]}
    page = write_report(part, tmp_path)[0].read_text()
    assert "Missing: the last run was not asked for stages sure." in page


def test_without_matplotlib_the_report_names_its_extra(tmp_path: Path) -> None:
    code = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from pathlib import Path\n"
        "from curation_ros.cli.main import main\n"
        "raise SystemExit(main(['report', sys.argv[1], '--out', sys.argv[2]]))"
    )
    path = tmp_path / "results.json"
    made = made_results(tmp_path / "study", small_plan(), share=0.0)
    path.write_text(json.dumps(made))
    done = subprocess.run(
        [sys.executable, "-c", code, path, tmp_path / "out"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode != 0
    assert "pip install '.[report]'" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
