"""How every node of ours starts, spins and stops."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Protocol

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from curation_ros.core.errors import CurationError

_IDLE_S = 0.02


class Worker(Protocol):
    """What a node adds to rclpy's Node."""

    def work(self) -> bool:
        """Do a little work between callbacks; True asks to be called again at once."""
        ...

    def close(self) -> None:
        """Finish files and say goodbye; the ROS context is still valid."""
        ...


class Finished(Exception):  # noqa: N818  it is no error
    """Raised by `work` when a node has done all it was started for."""


def run(make: Callable[[], Node], args: Sequence[str] | None = None) -> int:
    """Run one node until SIGINT, SIGTERM or SIGHUP, or until it is finished.

    rclpy's own signal handlers are not installed: they shut the context down before the node
    could close its bag and publish that it did, and they leave SIGHUP to kill the process.

    Returns:
        Exit code: 0 done, 2 wrong parameters or input.
    """
    stopping: list[int] = []

    def stop(number: int, _frame: FrameType | None) -> None:
        stopping.append(number)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stop)
    given = None if args is None else list(args)
    try:
        rclpy.init(args=given, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as err:  # rclpy raises its own classes of it
        return _complain(f"ROS arguments: {str(err).partition(', at /')[0]}")
    node = None
    try:
        node = make()
        node.get_logger().info(
            f"domain {os.environ.get('ROS_DOMAIN_ID', '0')}, discovery range "
            f"{os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET (default)')}"
        )
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while not stopping:
            busy = node.work()  # type: ignore[attr-defined]
            executor.spin_once(timeout_sec=0.0 if busy else _IDLE_S)
            take_waiting(node)
        executor.remove_node(node)
    except Finished:
        pass
    except CurationError as err:
        return _complain(err)
    finally:
        if node is not None:
            node.close()  # type: ignore[attr-defined]
            node.destroy_node()
        rclpy.try_shutdown()  # type: ignore[attr-defined]
    return 0


def take_waiting(node: Node) -> None:
    """Serve what has come meanwhile, at most one message a subscription.

    The executor builds a new wait set for every message or two, which takes some 0.3 ms; to take
    a message, or to find that there is none, takes microseconds. The order is the executor's own:
    that in which subscriptions were created. Raw ones are those whose callbacks take message info.
    """
    for subscription in list(node.subscriptions):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is not None:
            message, info = taken
            subscription.callback(*((message, info) if subscription.raw else (message,)))


def _complain(problem: object) -> int:
    print(f"error: {problem}", file=sys.stderr)  # noqa: T201  there may be no node to log with
    return 2
