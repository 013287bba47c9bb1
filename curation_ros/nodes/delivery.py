"""Waits for the delivery of last messages, which the transport cannot send again afterwards."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any

from rclpy.duration import Duration

from curation_ros.core.types import NS_PER_S

# Fast DDS asks for acknowledgements every 3 s. A subscriber that was killed never answers.
_PATIENCE_S = 4.0


def deliver(publishers: Iterable[Any]) -> None:
    """Wait until all subscribers have all messages, for at most 4 s in total."""
    deadline_s = time.monotonic() + _PATIENCE_S
    for publisher in publishers:
        left_ns = int((deadline_s - time.monotonic()) * NS_PER_S)
        publisher.wait_for_all_acked(Duration(nanoseconds=max(0, left_ns)))
