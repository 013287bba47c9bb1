"""MCAP bags: definitions, CDR decoding, writing, reading and recovery; no ROS needed."""

from curation_ros.bags.bag import Bag
from curation_ros.bags.cdr import CdrDecoder
from curation_ros.bags.episodes import episode_event, episode_of
from curation_ros.bags.errors import TornFileError
from curation_ros.bags.folders import is_bag
from curation_ros.bags.qos import QosProfile
from curation_ros.bags.reader import open_bag
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
    "TornFileError",
    "episode_event",
    "episode_of",
    "is_bag",
    "message_schema",
    "open_bag",
    "recover_bag",
]
