"""Behaviour cloning that judges a selection: train with torch, act with NumPy alone.

Everything but `node` imports no ROS, everything but `train` no torch, and everything but
`rollouts` no simulator.
"""
