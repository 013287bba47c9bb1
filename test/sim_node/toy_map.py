"""The topic map of the toy robot: its objects and joints have names of their own."""

from __future__ import annotations

from curation_ros.core.episode.topic_map import topic_map_from_json

POSE = "geometry_msgs/msg/PoseStamped"
JOINTS = "sensor_msgs/msg/JointState"
XYZ = ["pose.position.x", "pose.position.y", "pose.position.z"]

RAW = {
    "max_gap_s": 0.5,
    "fields": {
        "hand": {"topic": "eef_pose", "type": POSE, "role": "effector", "values": XYZ},
        "fingers": {
            "topic": "joint_states",
            "type": JOINTS,
            "role": "observation",
            "values": ["position.left", "position.right"],
        },
        "cup": {"topic": "objects/cup/pose", "type": POSE, "role": "object", "values": XYZ},
        "coaster": {
            "topic": "objects/coaster/pose", "type": POSE, "role": "object", "values": XYZ
        },
        "phase": {
            "topic": "phase",
            "type": "diagnostic_msgs/msg/DiagnosticArray",
            "role": "phase",
            "values": ["status.0.message"],
            "labels": ["TAKE", "CARRY", "LEAVE"],
        },
        "motion": {
            "topic": "command/twist",
            "type": "geometry_msgs/msg/TwistStamped",
            "role": "action",
            "values": ["twist.linear.x", "twist.linear.y", "twist.linear.z"],
        },
        "grip": {
            "topic": "command/gripper",
            "type": JOINTS,
            "role": "gripper",
            "values": ["position.gripper"],
        },
    },
    "gripper": {
        "field": "grip",
        "opens": -1,
        "kind": "binary",
        "open_value": -1.0,
        "closed_value": 1.0,
        "fingers": "fingers",
    },
    "state": ["hand", "fingers", "phase"],
    "action": ["motion", "grip"],
}  # fmt: skip

TOY_MAP = topic_map_from_json(RAW)
