"""The pure core: streams, episodes, scorers, decisions; no ROS, simulator, torch or files."""
