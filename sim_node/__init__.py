"""The simulated robot: LIBERO's task, its scripted expert, and the defects that are injected.

Everything but `node` is plain Python and imports no ROS.
"""
