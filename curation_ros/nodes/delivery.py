"""Last words: a node that goes takes with it what the transport would have sent again."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from rclpy.duration import Duration

from curation_ros.core.types import NS_PER_S

# Fast DDS asks for acknowledgements every 3 s; who was killed never answers.
_PATIENCE_S = 4.0


def deliver(publishers: Iterable[Any]) -> None:
    """Wait until all subscribers have all that was published, for a few seconds in all."""
    deadline_s = time.monotonic() + _PATIENCE_S
    for publisher in publishers:
        left_ns = int((deadline_s - time.monotonic()) * NS_PER_S)
        publisher.wait_for_all_acked(Duration(nanoseconds=max(0, left_ns)))
