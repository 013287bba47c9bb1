"""Tables show the values in `results.json`, all of them."""

from __future__ import annotations

import re
from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from reading import bounds, cells, same, stage_of  # noqa: E402 - after the checks

from curation_ros.batch import published  # noqa: E402 - as above
from curation_ros.reporting import tables  # noqa: E402 - as above
from curation_ros.reporting.cells import NOTHING  # noqa: E402 - as above


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


def test_table_1_compares_the_audit_with_the_paper(found: dict[str, Any]) -> None:
    audited = found["pools"]["paired"]["audit"]
    shown = list(cells(tables.table_1(found, "paired")))
    assert len(shown) == len(audited)
    for cell, row in zip(shown, audited, strict=True):
        assert same(cell["AUROC raw"], row["auroc_raw"])
        assert same(cell["AUROC controlled"], row["auroc_controlled"])
        interval = cell["AUROC controlled"].partition(" ")[2]
        assert bounds(interval) == pytest.approx(row["ci"], abs=0.006)
        if row["paper"] is None:
            assert cell["paper T = 324"] == NOTHING
        else:
            assert same(cell["paper T = 324"], row["paper"]["truncated"])
            assert same(cell["paper joined"], row["paper"]["truncated_joined_by_name"])


def test_table_2_compares_both_variants_with_the_paper(found: dict[str, Any]) -> None:
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


def test_correlations_are_shown_with_those_of_the_paper(found: dict[str, Any]) -> None:
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


def test_the_purity_ceiling_is_printed(found: dict[str, Any]) -> None:
    [cell] = cells(tables.purity(found) or pytest.fail("there is one"))
    for kept, ceiling in found["pools"]["paired"]["purity_ceiling"].items():
        assert same(cell[f"{kept} kept"], ceiling, 100)
