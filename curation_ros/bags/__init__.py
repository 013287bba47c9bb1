"""MCAP bags: definitions, CDR decoding, writing, reading and recovery; no ROS needed."""

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.qos import QosProfile
from curation_ros.bags.reader import Bag, episode_of, find_bags, open_bag, read_episode
from curation_ros.bags.recovery import RecoveryReport, recover_bag
from curation_ros.bags.schemas import MessageSchema, message_schema
from curation_ros.bags.writer import BagWriter

__all__ = [
    "Bag",
    "BagWriter",
    "CdrDecoder",
    "MessageSchema",
    "QosProfile",
    "RecoveryReport",
    "episode_of",
    "find_bags",
    "message_schema",
    "open_bag",
    "read_episode",
    "recover_bag",
]
