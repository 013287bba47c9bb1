"""Sentences follow the data."""

from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from curation_ros.reporting.answers import answers  # noqa: E402 - after the checks


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


def test_best_detector_can_give_the_best_or_the_worst_policy(
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
