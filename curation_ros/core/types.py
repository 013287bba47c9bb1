"""Types and units that every package shares."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]
#: First and last nanosecond, inclusive; of an episode, counted from its start stamp.
Span = tuple[int, int]
#: A JSON object as Python holds it.
JsonObject: TypeAlias = dict[str, Any]

NS_PER_S = 1_000_000_000
