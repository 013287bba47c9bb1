"""Recorder and curator while the robot moves, without ROS."""
