"""How every node of ours starts, spins and stops."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from types import FrameType
from typing import Protocol

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from curation_ros.core.errors import CurationError
from curation_ros.nodes.parameters import Parameter, described, warn_of_unknown

_IDLE_S = 0.02
#: A node that stops has taken everything after so long a silence; a publisher may never be silent.
_QUIET_S, _DRAIN_S = 0.05, 1.0
#: Who is asked for something catches up for so long; a publisher may be faster than we are.
_CATCH_UP_S = 0.2


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


def run(make: Callable[[], Node], table: Sequence[Parameter], args: Sequence[str] = ()) -> int:
    """Run one node until SIGINT, SIGTERM or SIGHUP, or until it is finished.

    rclpy's own signal handlers are not installed: they shut the context down before the node
    could close its bag and publish that it did, and they leave SIGHUP to kill the process.

    Args:
        make: makes the node.
        table: its parameters, for --help.
        args: of the command line, the program's name first; none: those of this process.

    Returns:
        Exit code: 0 done, 2 wrong parameters or input.
    """
    stopping: list[int] = []
    node: Node | None = None

    def stop(number: int, _frame: FrameType | None) -> None:
        stopping.append(number)
        if node is None and len(stopping) == 1:  # to load LIBERO takes longer than patience lasts
            raise Finished

    try:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, stop)
        words = list(args or sys.argv)
        try:
            own = remove_ros_args(words)[1:]
            rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
        except RuntimeError as err:  # rclpy raises its own classes of it
            return _complain(f"ROS arguments: {str(err).partition(', at /')[0]}")
        if {"-h", "--help"}.intersection(own):
            try:
                print(described(table), flush=True)  # noqa: T201
            except BrokenPipeError:  # the reader of our output has gone, as `head` does
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0
        if own:
            return _complain(
                f"unknown argument {own[0]!r}: parameters follow --ros-args -p; --help lists them"
            )
        node = make()
        warn_of_unknown(node, table)
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
        # launch passes on a Ctrl-C that we have had; while Python ends, it would kill.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return 0


def take_waiting(node: Node) -> bool:
    """Serve what has come meanwhile, at most one message a subscription; whether there was any.

    The executor builds a new wait set for every message or two, which takes some 0.3 ms; to take
    a message, or to find that there is none, takes microseconds. The order is the executor's own:
    that in which subscriptions were created. Raw ones are those whose callbacks take message info.
    """
    any_taken = False
    for subscription in list(node.subscriptions):
        with subscription.handle:
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
        if taken is not None:
            any_taken = True
            message, info = taken
            subscription.callback(*((message, info) if subscription.raw else (message,)))
    return any_taken


def take_arrived(node: Node) -> None:
    """Serve all that has arrived: a request may overtake what was sent before it."""
    deadline_s = time.monotonic() + _CATCH_UP_S
    while take_waiting(node) and time.monotonic() < deadline_s:
        pass


def take_all(node: Node) -> None:
    """Serve all that was sent to a node that stops, for a second at most: it may be behind."""
    now_s = time.monotonic()
    deadline_s, quiet_from_s = now_s + _DRAIN_S, now_s
    while now_s < min(deadline_s, quiet_from_s + _QUIET_S):
        if take_waiting(node):
            quiet_from_s = time.monotonic()
        else:
            time.sleep(_QUIET_S / 10)
        now_s = time.monotonic()


def _complain(problem: object) -> int:
    print(f"error: {problem}", file=sys.stderr)  # noqa: T201  there may be no node to log with
    return 2
