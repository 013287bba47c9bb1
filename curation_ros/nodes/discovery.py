"""Discovery of other nodes: whether a node is there with all its subscriptions."""

from __future__ import annotations

import time
from collections.abc import Iterable

from rclpy.node import Node

_SETTLED_S = 0.5


class Discovery:
    """Remembers which subscriptions of other nodes the graph has shown, and since when."""

    def __init__(self, node: Node) -> None:
        """Start with nothing known.

        Args:
            node: the node whose view of the graph is used.
        """
        self._node = node
        self._found: dict[str, tuple[float, frozenset[str]]] = {}

    def is_complete(self, node_name: str, topics: Iterable[str] = ()) -> bool:
        """Whether a node is there with all its subscriptions.

        Endpoints are discovered one by one, on either side. They count as complete when the graph
        has shown the same ones for half a second.

        Args:
            node_name: name of the node, in any namespace.
            topics: resolved names of topics that must be among its subscriptions.
        """
        found = self._node.get_node_names_and_namespaces()
        spaces = [space for name, space in found if name == node_name]
        if not spaces:
            return False
        try:
            known = self._node.get_subscriber_names_and_types_by_node(node_name, spaces[0])
        except RuntimeError:  # the node is gone again (rclpy raises a class derived from it)
            return False
        names = frozenset(name for name, _ in known)
        now_s = time.monotonic()
        since_s, before = self._found.get(node_name, (now_s, frozenset()))
        if names != before:
            self._found[node_name] = (now_s, names)
            return False
        return names.issuperset(topics) and now_s - since_s > _SETTLED_S
