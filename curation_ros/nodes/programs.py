"""The table of nodes. Programs, processes, packaging and the checks of the docs read it.

setup.py runs this file before anything is installed, so it imports nothing.
"""

#: Name of a node's program -> module whose `main` runs the node.
NODE_MODULES = {
    "sim_node": "sim_node.node",
    "recorder": "curation_ros.nodes.recorder",
    "curator": "curation_ros.nodes.curator",
    "policy_node": "policy_node.node",
    "replay": "curation_ros.nodes.replay",
}
