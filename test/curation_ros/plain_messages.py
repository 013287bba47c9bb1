"""One plain message of every kind that the simulator sends."""

from __future__ import annotations

from curation_ros.core.episode import messages
from curation_ros.core.episode.status import phase_to_status

STAMP_NS = 1_700_000_000_123_456_789

MESSAGES = {
    messages.CLOCK: messages.clock(STAMP_NS),
    messages.JOINT_STATE: messages.joint_state(
        ["a", "b"], [0.1, -0.2], [0.3, 1e-9], [0.0, 5.5], STAMP_NS
    ),
    messages.POSE: messages.pose([0.1, 0.2, 0.3], [0.5, -0.5, 0.5, 0.5], STAMP_NS),
    messages.TWIST: messages.twist([1.0, -0.25, 1 / 3], STAMP_NS),
    messages.STATUS_ARRAY: messages.status_array(
        [phase_to_status("id", "LIFT", 3, 0.1)], STAMP_NS
    ),
}
