"""Reports say what results.json says, all of it, and nothing is loaded from anywhere."""

from __future__ import annotations

import html
import json
import re
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from made_study import made_results, salvage_plan, small_plan  # noqa: E402 - needs LIBERO

from curation_ros.core.errors import ConfigError  # noqa: E402
from curation_ros.reporting import findings, published, tables, write_report  # noqa: E402
from curation_ros.reporting.answers import answers  # noqa: E402
from curation_ros.reporting.blocks import Figure, Points, Table  # noqa: E402
from curation_ros.reporting.figures import _apart, _inline, _numbered  # noqa: E402
from curation_ros.reporting.salvage_section import salvage_blocks  # noqa: E402
from curation_ros.study.results import FORMAT  # noqa: E402

MOST_BYTES = 3_000_000
ROUNDING = 0.0006  # of three digits


@pytest.fixture(scope="module")
def _made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return made_results(tmp_path_factory.mktemp("study"), small_plan())


@pytest.fixture
def found(_made: dict[str, Any]) -> dict[str, Any]:
    return deepcopy(_made)


@pytest.fixture(scope="module")
def report(_made: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Files of a report on what was found, written once."""
    return write_report(_made, tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def nothing_done(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    problems = ("policy <x>: it did not converge",)
    folder = tmp_path_factory.mktemp("nothing")
    return made_results(folder, small_plan(), share=0.0, problems=problems)


def stage_of(found: dict[str, Any], name: str) -> dict[str, Any]:
    [stage] = [s for s in found["stages"] if s["name"] == name]
    return dict(stage)


def cells(table: Table) -> Iterator[dict[str, str]]:
    for row in table.rows:
        assert len(row) == len(table.headings)
        yield dict(zip(table.headings, row, strict=True))


def same(text: str, value: float | None, scale: float = 1.0) -> bool:
    """Whether a cell shows that value."""
    if value is None:
        return text == tables.NOTHING
    shown = float(text.removesuffix(" %").split(" ")[0])
    return abs(shown / scale - value) <= ROUNDING


def bounds(text: str) -> list[float]:
    return [float(x) for x in re.findall(r"-?\d+\.\d+", text)]


def test_every_row_of_every_stage_is_shown_with_its_figures(found: dict[str, Any]) -> None:
    for stage in found["stages"]:
        shown = list(cells(tables.all_rows(stage)))
        assert len(shown) == len(stage["rows"])
        for cell, row in zip(shown, stage["rows"], strict=True):
            assert cell["row"] == row["row"]
            assert cell["needs"] == ", ".join(row["needs"])
            assert same(cell["success"], row["rate"], 100)
            assert same(cell["contamination"], row["contamination"], 100)
            assert same(cell["AUROC"], row["auroc"])
            assert same(cell["sd"], row["sd"], 100)
            if row["interval"] is not None:
                assert bounds(cell["interval"]) == pytest.approx(
                    [100 * b for b in row["interval"]], abs=0.06
                )
            assert int(cell["n"]) == row["n"]
            assert int(cell["missing"]) == row["n_missing"]
            counts = re.findall(r"\d+", cell["seeds"].partition(" of ")[0])
            assert [int(c) for c in counts] == [c["successes"] for c in row["counts"]]
            if row["rival"] is not None:
                assert cell["rival"].startswith(row["rival"]["row"] + " ")
                assert same(cell["rival"].rpartition(": ")[2], row["rival"]["difference"], 100)


def test_seeds_with_other_numbers_of_rollouts_are_shown_with_these(found: dict[str, Any]) -> None:
    row = {"counts": [{"seed": 1, "successes": 2, "n": 4}, {"seed": 2, "successes": 3, "n": 3}]}
    assert tables.counts(row) == "2/4, 3/3"
    row["counts"][1]["n"] = 4
    assert tables.counts(row) == "2, 3 of 4"


def test_bimodal_rows_are_called_so() -> None:
    assert tables.modes({"modes": {"low": 1, "middle": 0, "high": 2}}) == "1 / 0 / 2 bimodal"
    assert tables.modes({"modes": {"low": 0, "middle": 1, "high": 2}}) == "0 / 1 / 2"


def test_table_1_has_the_audit_beside_the_paper(found: dict[str, Any]) -> None:
    audited = found["pools"]["paired"]["audit"]
    shown = list(cells(tables.table_1(found, "paired")))
    assert len(shown) == len(audited)
    for cell, row in zip(shown, audited, strict=True):
        assert same(cell["AUROC raw"], row["auroc_raw"])
        assert same(cell["AUROC controlled"], row["auroc_controlled"])
        interval = cell["AUROC controlled"].partition(" ")[2]
        assert bounds(interval) == pytest.approx(row["ci"], abs=0.006)
        if row["paper"] is None:
            assert cell["paper T = 324"] == tables.NOTHING
        else:
            assert same(cell["paper T = 324"], row["paper"]["truncated"])
            assert same(cell["paper joined"], row["paper"]["truncated_joined_by_name"])


def test_table_2_has_both_variants_beside_the_paper(found: dict[str, Any]) -> None:
    stage = stage_of(found, "paper")
    shown = {cell["condition"]: cell for cell in cells(tables.table_2(found, stage, "paired"))}
    assert next(iter(shown)) == "oracle"
    assert list(shown)[-1] == "everything"
    assert len(shown) == len({row["row"] for row in stage["rows"]})
    for row in stage["rows"]:
        cell, variant = shown[row["row"]], row["variant"]
        rate, _, deviation = cell[f"{variant}: success"].partition(" ± ")
        assert same(rate, row["rate"], 100)
        assert same(deviation, row["sd_population"], 100)
        assert same(cell[f"{variant}: gap closed"], row["gap_closed"], 100)
        paper = published.TABLE_2[row["scorer"] or row["row"]]
        assert same(cell["paper success"], paper.success, 100)
        assert same(cell["paper joined"], paper.joined)


def test_correlations_are_shown_and_the_papers_own(found: dict[str, Any]) -> None:
    stage = stage_of(found, "paper")
    shown = list(cells(tables.correlations(stage) or pytest.fail("there are some")))
    assert len(shown) == len(stage["correlations"]) + 2
    for cell, one in zip(shown, stage["correlations"], strict=False):
        assert float(cell["rho"]) == pytest.approx(one["rho"], abs=0.006)
        assert float(cell["p"].lstrip("<")) == pytest.approx(one["p"], abs=0.0001)
    assert [cell["rho"] for cell in shown[-2:]] == ["-0.14", "0.07"]


def test_all_planned_contrasts_are_shown(found: dict[str, Any]) -> None:
    stage = stage_of(found, "confirmation")
    shown = list(cells(tables.contrasts(stage)))
    assert len(shown) == len(stage["contrasts"]) == 2
    for cell, one in zip(shown, stage["contrasts"], strict=True):
        assert cell["contrast"] == f"{one['a']} minus {one['b']}"
        assert same(cell["difference"], one["value"], 100)
        assert bounds(cell["interval"]) == pytest.approx(
            [100 * b for b in one["interval"]], abs=0.06
        )
        assert float(cell["p (Holm)"]) == pytest.approx(one["p_holm"], abs=0.0001)
        assert float(cell["floor"]) == pytest.approx(one["p_floor"], abs=0.0001)
        assert (int(cell["seeds"]), int(cell["starts"])) == (one["n_seeds"], one["n_starts"])


def test_a_small_p_is_not_written_as_nought() -> None:
    assert tables.probability(0.00002) == "<0.0001"
    assert tables.probability(0.0001) == "0.0001"


def test_the_purity_ceiling_is_printed(found: dict[str, Any]) -> None:
    [cell] = cells(tables.purity(found) or pytest.fail("there is one"))
    for kept, ceiling in found["pools"]["paired"]["purity_ceiling"].items():
        assert same(cell[f"{kept} kept"], ceiling, 100)


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


def test_text_in_figures_is_text(report: list[Path]) -> None:
    text = (report[0].parent / "figure-main.svg").read_text()
    assert "gripper timing</text>" in text
    assert "@font-face" not in text


def test_without_outcomes_the_report_says_what_is_missing(
    nothing_done: dict[str, Any], tmp_path: Path
) -> None:
    text = html.unescape(write_report(nothing_done, tmp_path)[0].read_text())
    n = nothing_done["stages"][0]["missing"]
    assert f"Missing: {n} outcomes of stage paper." in text
    assert "Missing: no pool has outcomes of three scorers" in text
    assert "Missing: data for 2 of 2 contrasts" in text
    assert "Missing: outcomes of stage screening" in text
    assert "policy <x>: it did not converge" in text
    said = answers(nothing_done)
    assert f"{n} in stage paper" in said[0]
    assert "is open" in said[1]
    assert "2 have no data" in " ".join(said)


def test_a_report_without_stages_or_pools_is_written(
    found: dict[str, Any], tmp_path: Path
) -> None:
    found["stages"], found["pools"] = [], {}
    text = write_report(found, tmp_path)[0].read_text()
    assert "planned no contrasts" in text


def test_answers_are_few_and_follow_the_data(found: dict[str, Any]) -> None:
    before = answers(found)
    assert 3 <= len(before) <= 8
    [contrast, _] = found["stages"][2]["contrasts"]
    contrast |= {"value": -0.5, "p_holm": 0.001}
    found["stages"][2]["contrasts"][1]["p_holm"] = 1.0
    after = " ".join(answers(found))
    assert "Of 2 planned contrasts 1 are resolved (adjusted p at most 0.0010); 1 are not" in after
    assert "in percentage points: oracle minus everything -50.0." in after
    contrast["p_holm"] = 0.05
    assert "Of 2 planned contrasts 0 are resolved" in " ".join(answers(found))


def test_the_best_and_the_worst_policy_of_the_best_detector_are_told_apart(
    found: dict[str, Any],
) -> None:
    rows = [r for r in found["stages"][0]["rows"] if r["scorer"]]
    for row in rows:
        row["rate"], row["auroc"] = 0.5, 0.5
    top = [r for r in rows if r["scorer"] == "entropy"]
    for row in top:
        row["rate"], row["auroc"] = 0.1, 0.9
    assert "best policy of all scorers in 0 of 2 and the worst in 2 of 2" in answers(found)[2]
    for row in top:
        row["rate"] = 0.9
    assert "best policy of all scorers in 2 of 2 and the worst in 0 of 2" in answers(found)[2]


def test_screens_are_marked(found: dict[str, Any], report: list[Path]) -> None:
    said = " ".join(answers(found))
    assert "Stage screening (a look, not a claim)" in said
    text = report[0].read_text()
    assert "nothing is claimed from them" in text
    assert "screening: paired, relative, 12 kept" in text


def test_looks_at_the_official_starts_are_counted(report: list[Path]) -> None:
    text = html.unescape(report[0].read_text())
    assert "Looks at the official starts: 2, namely" in text
    assert "before: a prototype's" in text
    assert "stage confirmation of this study" in text


def test_random_draws_of_one_number_belong_together(found: dict[str, Any]) -> None:
    rows = stage_of(found, "screening")["rows"]
    drawn = findings.draws(rows, "random")
    assert {k: len(some) for k, some in drawn.items()} == {4: 3, 8: 3, 12: 3}
    assert list(findings.draws(rows, "oracle")) == [12, 16]


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda r: r.pop("format"), "no key 'format'"),
        (lambda r: r.update(format=2), "results of format 2, this reads 1"),
        (lambda r: r.pop("stages"), "no key 'stages'"),
        (lambda r: r.update(stages={}), "'stages' is {}"),
        (lambda r: r["stages"][0].pop("kind"), "stage: no key 'kind'"),
        (lambda r: r["stages"][0]["rows"][3].pop("rate"), "stage 'paper', row: no key 'rate'"),
        (lambda r: r["stages"][0]["rows"][3].update(rate="1"), "'rate' is '1'"),
        (lambda r: r["stages"][0]["rows"][3].update(row="best@3"), "training set 'best@3'"),
        (lambda r: r["stages"][0]["rows"][3].update(pool="other"), "no pool 'other'"),
        (lambda r: r["stages"][2]["contrasts"][0].pop("p"), "contrast: no key 'p'"),
        (lambda r: r["pools"]["paired"].pop("audit"), "pool 'paired': no key 'audit'"),
        (lambda r: r["stages"].append(7), "stage: expected a mapping, found 7"),
    ],
)
def test_what_is_no_results_is_refused_in_a_line(
    found: dict[str, Any], tmp_path: Path, spoil: Any, complaint: str
) -> None:
    spoil(found)
    with pytest.raises(ConfigError, match=re.escape(complaint)) as told:
        write_report(found, tmp_path / "out")
    assert "\n" not in str(told.value)
    assert not (tmp_path / "out").exists()


# --- what the curator decides and salvages ------------------------------------------------------


@pytest.fixture(scope="module")
def salvaged(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    return made_results(tmp_path_factory.mktemp("salvage"), salvage_plan())


def test_a_study_without_such_rows_has_no_section_on_salvage(report: list[Path]) -> None:
    assert "Salvage</h2>" not in report[0].read_text()


def test_salvage_is_shown_against_the_truth(salvaged: dict[str, Any]) -> None:
    verdicts, *_ = (b for b in salvage_blocks(salvaged) if isinstance(b, Table))
    [cell] = cells(verdicts)
    assert (cell["keep"], cell["salvage"]) == ("3 good, 0 defective", "0 good, 3 defective")
    assert cell["cut minus release, steps"] == "-15 / -15 / -15"
    [said] = [text for text in answers(salvaged) if "salvages" in text]
    assert "keeps 3 of 3 good demonstrations and 0 of 3 defective ones" in said
    assert "a beginning of 0 and 3." in said


def test_the_margin_sweep_is_drawn_and_listed(salvaged: dict[str, Any]) -> None:
    blocks = salvage_blocks(salvaged)
    [sweep] = [b for b in blocks if isinstance(b, Figure) and b.name == "figure-margins-margins"]
    rows = {row["row"]: row for row in salvaged["stages"][0]["rows"]}
    for margin in (0, 5, 15):
        rate = rows[f"decided+salvaged-{margin}"]["rate"]
        assert f"{margin} steps: {rate:.0%}" in sweep.panels[0].alt
    [table] = [b for b in blocks if isinstance(b, Table) and "how far before" in b.caption]
    listed = {cell["row"]: cell for cell in cells(table)}
    assert list(listed) == list(rows)
    for name, row in rows.items():
        assert same(listed[name]["success"], row["rate"], 100)
    assert listed["decided+salvaged-5"]["margin"] == "5"
    assert listed["decided+salvaged"]["good"] == "3 of 3, and 3 parts"


def test_phases_of_every_set_are_shown_and_rare_ones_named(salvaged: dict[str, Any]) -> None:
    blocks = salvage_blocks(salvaged)
    [table] = [b for b in blocks if isinstance(b, Table) and b.caption.startswith("Phases")]
    listed = {cell["training set"]: cell for cell in cells(table)}
    assert listed["oracle, decided of some"]["release"].startswith("3 (")
    both = "decided+salvaged, decided+salvaged-15 of some"
    assert listed[both]["n"] == "6"
    # Half is enough: one good demonstration less, and RELEASE is rare.
    few = [item for b in blocks if isinstance(b, Points) for item in b.items]
    assert not [item for item in few if item.startswith(both)]
    spoilt = deepcopy(salvaged)
    for stage in spoilt["stages"]:
        for row in stage["rows"]:
            if row["row"].startswith("decided+salvaged"):
                row["phases"]["RELEASE"]["demonstrations"] = 2
    few = [item for b in salvage_blocks(spoilt) if isinstance(b, Points) for item in b.items]
    assert f"{both}: of 6 demonstrations, RELEASE by 2" in few


def test_one_salvaged_episode_is_drawn(salvaged: dict[str, Any], tmp_path: Path) -> None:
    written = {path.name: path for path in write_report(salvaged, tmp_path)}
    assert "kept until" in written["figure-salvaged.svg"].read_text()
    page = html.unescape(written["report.html"].read_text())
    assert "Salvage</h2>" in page
    # It ranks by no scorer, so nothing about scorers is missing.
    assert "Missing" not in page
    assert len(page.encode()) < MOST_BYTES


def test_an_example_that_is_none_is_refused_in_a_line(
    salvaged: dict[str, Any], tmp_path: Path
) -> None:
    spoilt = deepcopy(salvaged)
    spoilt["salvaged_example"]["decision"].pop("span")
    with pytest.raises(ConfigError, match="salvaged_example: EpisodeError: decision: KeyError"):
        write_report(spoilt, tmp_path)


def test_stages_that_were_left_out_are_named(salvaged: dict[str, Any], tmp_path: Path) -> None:
    part = {**salvaged, "stages_left_out": ["sure"]}
    page = write_report(part, tmp_path)[0].read_text()
    assert "Missing: the last run was not asked for stages sure." in page


def test_the_format_is_the_one_that_studies_write() -> None:
    assert findings.FORMAT == FORMAT


def test_labels_are_moved_apart_and_stay_in_order() -> None:
    assert _apart([0.9, 0.1, 0.5], 0.1) == [0.9, 0.1, 0.5]
    placed = _apart([0.02, 0.03, 0.9], 0.1)
    assert placed[1] - placed[0] == pytest.approx(0.1)
    assert min(placed) >= 0


def test_an_inlined_svg_has_ids_of_its_own() -> None:
    svg = (
        '<?xml?><svg a="1"><g id="p1"/><g id="idle"/><use href="#p1"/><g clip="url(#p12)"/></svg>'
    )
    numbered = _numbered(svg)
    assert '<g id="i0"/><g/><use href="#i0"/><g clip="url(#i1)"/>' in numbered
    inlined = _inline(numbered, "x", 'say "it" & <go>')
    assert '<g id="x-i0"/><g/><use href="#x-i0"/><g clip="url(#x-i1)"/>' in inlined
    assert 'aria-label="say &quot;it&quot; &amp; &lt;go>"' in inlined


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
    assert "install the extra [report]" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
