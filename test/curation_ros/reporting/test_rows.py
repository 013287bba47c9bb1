from __future__ import annotations

from typing import Any

import pytest

pytestmark = pytest.mark.sim
pytest.importorskip("libero", reason="LIBERO is not installed")
pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from reading import stage_of  # noqa: E402 - after the checks

from curation_ros.reporting.rows import draws_of  # noqa: E402 - as above


def test_random_draws_of_one_number_belong_together(found: dict[str, Any]) -> None:
    rows = stage_of(found, "screening")["rows"]
    drawn = draws_of(rows, "random")
    assert {k: len(some) for k, some in drawn.items()} == {4: 3, 8: 3, 12: 3}
    assert list(draws_of(rows, "oracle")) == [12, 16]
