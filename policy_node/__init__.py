"""Policies: what they are, training by behaviour cloning, and driving a robot or a simulator.

`policy` is the protocol that every policy follows, and `testing` its conformance check. Only
`node` imports ROS, only the training modules import torch, and only `rollouts` imports the
simulator.
"""
