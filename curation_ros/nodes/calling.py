"""Calls a service of a recorder once, as `ros2 service call` does."""

from __future__ import annotations

import rclpy
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import SetBool, Trigger

from curation_ros.core.errors import CurationError


def call_recorder(recorder: str, action: str, timeout_s: float) -> tuple[bool, str]:
    """Call `~/start`, `~/stop`, `~/recover`, or `~/finalize` (keep and discard).

    Returns:
        Whether it succeeded, and what it said.

    Raises:
        CurationError: if no recorder answers in time.
    """
    # With its handlers rclpy would leave the caller deaf to SIGTERM for good, also after shutdown.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = rclpy.create_node("curation_record")
        if action in ("keep", "discard"):
            client = node.create_client(SetBool, f"{recorder}/finalize")
            request = SetBool.Request(data=action == "keep")
        else:
            client = node.create_client(Trigger, f"{recorder}/{action}")
            request = Trigger.Request()
        if not client.wait_for_service(timeout_s):
            raise CurationError(f"no {client.srv_name} within {timeout_s:g} s: is it running?")
        future = client.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=timeout_s)
        if not future.done():
            raise CurationError(f"{client.srv_name} did not answer within {timeout_s:g} s")
        response = future.result()
        return bool(response.success), str(response.message)
    finally:
        rclpy.try_shutdown()  # type: ignore[attr-defined]
