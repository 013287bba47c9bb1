from __future__ import annotations

import pytest

pytest.importorskip("matplotlib", reason="matplotlib is not installed")

from curation_ros.reporting.plotting import spread_apart


def test_labels_are_moved_apart_and_stay_in_order() -> None:
    assert spread_apart([0.9, 0.1, 0.5], 0.1) == [0.9, 0.1, 0.5]
    placed = spread_apart([0.02, 0.03, 0.9], 0.1)
    assert placed[1] - placed[0] == pytest.approx(0.1)
    assert min(placed) >= 0
