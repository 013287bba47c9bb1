from __future__ import annotations

from typing import Any

from curation_ros.reporting.cells import modes, probability, seed_successes


def test_counts_name_the_number_of_rollouts_per_seed_if_it_differs() -> None:
    row: dict[str, Any] = {
        "counts": [{"seed": 1, "successes": 2, "n": 4}, {"seed": 2, "successes": 3, "n": 3}]
    }
    assert seed_successes(row) == "2/4, 3/3"
    row["counts"][1]["n"] = 4
    assert seed_successes(row) == "2, 3 of 4"


def test_bimodal_rows_are_marked() -> None:
    assert modes({"modes": {"low": 1, "middle": 0, "high": 2}}) == "1 / 0 / 2 bimodal"
    assert modes({"modes": {"low": 0, "middle": 1, "high": 2}}) == "0 / 1 / 2"


def test_a_small_p_is_not_written_as_0() -> None:
    assert probability(0.00002) == "<0.0001"
    assert probability(0.0001) == "0.0001"
