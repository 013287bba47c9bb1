"""The QoS profiles of the graph: one place, both sides."""

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
#: `episode` and `recorder/status`: who comes late still sees the last ones.
LATCHED = _profile(10, DurabilityPolicy.TRANSIENT_LOCAL)
#: `curator/decision`: the last 200.
DECISIONS = _profile(200, DurabilityPolicy.TRANSIENT_LOCAL)
#: Alerts, overrides, diagnostics.
EVENTS = _profile(50, DurabilityPolicy.VOLATILE)
#: Patience for samples that are late. What the transport has dropped comes again when Fast DDS
#: next asks for acknowledgements, every 3 s.
DRAIN_S = 5.0
