"""The simulated robot: environments, tasks with their experts, and injected defects.

Only `node` imports ROS.
"""
