"""Fixtures of the tests that need no ROS."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from curation_ros.dataset.dataset import Dataset


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260608)


@pytest.fixture
def dataset(tmp_path: Path) -> Dataset:
    return Dataset(tmp_path / "data", create=True)
