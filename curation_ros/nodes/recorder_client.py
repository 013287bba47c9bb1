"""Calls a service of a recorder once, as `ros2 service call` does."""

from __future__ import annotations

import rclpy
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import try_shutdown
from std_srvs.srv import SetBool, Trigger

from curation_ros.core.errors import CurationError


def call_recorder(recorder: str, action: str, timeout_s: float) -> tuple[bool, str]:
    """Call a service of a recorder.

    Args:
        recorder: name of the node.
        action: `start`, `stop` or `recover` calls the service of that name; `keep` or `discard`
            calls `finalize`.
        timeout_s: for each of two waits, for the service and for its answer, in s.

    Returns:
        Whether the call succeeded, and the message of the answer.

    Raises:
        CurationError: if no recorder answers in time.
    """
    # rclpy's signal handlers would leave the caller without SIGTERM for good, even after shutdown.
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
        try_shutdown()
