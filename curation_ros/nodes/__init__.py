"""ROS nodes: thin shells around the core; the only folder of this package that imports rclpy."""
