"""Runs a node as a process: parameters, callbacks, work between them, signals and the end."""

from __future__ import annotations

import os
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import FrameType

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args, try_shutdown

from curation_ros.core.errors import ConfigError, CurationError
from curation_ros.nodes.parameters import Parameter, described, warn_of_unknown

_IDLE_S = 0.02
#: A node that stops has received everything after this long a silence. A publisher may never be
#: silent, so the wait as a whole is limited, too.
_QUIET_S, _DRAIN_S = 0.05, 1.0
#: Before answering a service call, take pending messages for at most this long. A publisher may
#: be faster than the node.
_CATCH_UP_S = 0.2


class WorkingNode(Node, ABC):
    """A node that also works between callbacks."""

    @abstractmethod
    def work(self) -> bool:
        """Do a little work; True asks to be called again at once."""

    @abstractmethod
    def close(self) -> None:
        """Finish files and publish the last messages. The ROS context is still valid."""


class Finished(Exception):  # noqa: N818  it is no error
    """Raised by `work` when a node has done everything it was started for."""


class _Signals:
    """Counts the signals that ask the process to stop.

    rclpy's own handlers are not installed. They shut the context down before the node could close
    its bag and publish that it did, and they leave SIGHUP to kill the process.
    """

    def __init__(self) -> None:
        self.n_received = 0
        self.is_starting = True
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._receive)

    def _receive(self, _number: int, _frame: FrameType | None) -> None:
        self.n_received += 1
        # Loading LIBERO takes longer than a sender of signals waits.
        if self.is_starting and self.n_received == 1:
            raise Finished


def run(
    make: Callable[[], WorkingNode], table: Sequence[Parameter], args: Sequence[str] = ()
) -> int:
    """Run one node until SIGINT, SIGTERM or SIGHUP, or until it is finished.

    Args:
        make: makes the node.
        table: its parameters, for --help.
        args: command line with the program's name; empty: the command line of this process.

    Returns:
        Exit code: 0 done, 2 wrong parameters or input.
    """
    node: WorkingNode | None = None
    try:
        signals = _Signals()
        rest = _initialise(list(args or sys.argv))
        if {"-h", "--help"}.intersection(rest):
            return _help(table)
        if rest:
            return _complain(
                f"unknown argument {rest[0]!r}: parameters follow --ros-args -p; --help lists them"
            )
        node = make()
        signals.is_starting = False
        warn_of_unknown(node, table)
        _spin(node, signals)
    except Finished:
        pass
    except CurationError as err:
        return _complain(err)
    finally:
        if node is not None:
            node.close()
            node.destroy_node()
        try_shutdown()
        # launch passes on a Ctrl-C that this process has received already. It must not end
        # Python in its last moments.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return 0


def _initialise(words: list[str]) -> list[str]:
    """Start rclpy and return the arguments that are not ROS's.

    Raises:
        ConfigError: if ROS cannot read its arguments.
    """
    try:
        rest: list[str] = remove_ros_args(words)[1:]
        rclpy.init(args=words, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as err:  # rclpy raises classes of its own that derive from it
        raise ConfigError(f"ROS arguments: {str(err).partition(', at /')[0]}") from err
    return rest


def _help(table: Sequence[Parameter]) -> int:
    try:
        print(described(table), flush=True)  # noqa: T201
    except BrokenPipeError:  # the reader of the output is gone, as with `head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


def _spin(node: WorkingNode, signals: _Signals) -> None:
    node.get_logger().info(
        f"domain {os.environ.get('ROS_DOMAIN_ID', '0')}, discovery range "
        f"{os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SUBNET (default)')}"
    )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not signals.n_received:
        is_busy = node.work()
        executor.spin_once(timeout_sec=0.0 if is_busy else _IDLE_S)
        take_waiting(node)
    executor.remove_node(node)


def take_waiting(node: Node) -> bool:
    """Take at most one waiting message per subscription; True if there was any.

    The executor builds a new wait set for every message or two, which takes 0.3 ms. Taking a
    message, or finding none, takes microseconds. The order is the executor's own: the order in
    which the subscriptions were created. Raw subscriptions get the message info as well.
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
    """Take all messages that have arrived. A service call may overtake earlier messages."""
    deadline_s = time.monotonic() + _CATCH_UP_S
    while take_waiting(node) and time.monotonic() < deadline_s:
        pass


def take_all(node: Node) -> None:
    """Take all messages that were sent to a node that stops, for a second at most."""
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
