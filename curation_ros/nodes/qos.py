"""The QoS profiles of the graph, for publishers and subscribers alike."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from curation_ros.bags import qos


def _profile(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


#: Mapped and command topics, see `curation_ros.bags.qos.MAPPED`.
MAPPED = _profile(qos.MAPPED.depth, DurabilityPolicy.VOLATILE)
#: `episode` and `recorder/status`: late subscribers still receive the last messages.
LATCHED = _profile(10, DurabilityPolicy.TRANSIENT_LOCAL)
#: `curator/decision`: the last 200.
DECISIONS = _profile(200, DurabilityPolicy.TRANSIENT_LOCAL)
#: Alerts, overrides, diagnostics.
EVENTS = _profile(50, DurabilityPolicy.VOLATILE)
