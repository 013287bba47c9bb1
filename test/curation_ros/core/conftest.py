"""Fixtures of the core's tests."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings

# No deadline: a shared machine may stall. The same examples every time: same input, same output.
settings.register_profile("core", deadline=None, derandomize=True)
settings.load_profile("core")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260608)
