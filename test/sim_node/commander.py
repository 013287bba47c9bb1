"""A node that sends commands to the sim node."""

from __future__ import annotations

from graph import MAPPED, JointState, TwistStamped
from rclpy.node import Node

COMMANDS = ("command/twist", "command/gripper")


class Commander:
    """Answers observations with the commands that a test chooses."""

    def __init__(self, graph, name="commander"):
        self.node = Node(name, context=graph.context, enable_rosout=False)
        twist, gripper = COMMANDS
        self.twist = self.node.create_publisher(TwistStamped, twist, MAPPED)
        self.gripper = self.node.create_publisher(JointState, gripper, MAPPED)

    def close(self):
        self.node.destroy_node()

    def send(self, message, z=0.0, *, twist=True, gripper="gripper"):
        """Answer one observation."""
        if twist:
            command = TwistStamped(header=message.header)
            command.twist.linear.z = z
            self.twist.publish(command)
        if gripper:
            joints = JointState(header=message.header, name=[gripper], position=[-1.0])
            joints.velocity, joints.effort = [0.0], [0.0]
            self.gripper.publish(joints)
