"""What a live subscription and a bag have in common: stamped, numbered CDR bytes on a topic."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import EpisodeError

Floats = npt.NDArray[np.float64]
Stamps = npt.NDArray[np.int64]

NS_PER_S = 1_000_000_000


class Sample(NamedTuple):
    """One message of a mapped topic.

    `topic` is the name in the topic map, not the resolved one: namespaces and remaps end at the
    node. `seq` is the publication sequence number; 0 where there is none (then arrival decides).
    `log_ns` and `publish_ns` are when it was received and sent: for bags, never to join anything.
    """

    topic: str
    stamp_ns: int
    seq: int
    data: bytes
    log_ns: int = 0
    publish_ns: int = 0


class Decoder(Protocol):
    """Turns CDR bytes of one message type into columns; `curation_ros.bags.cdr` has the real one.

    The core knows no message definitions, so that it needs neither ROS nor a bag to be imported.
    """

    def has_header(self, type_name: str) -> bool:
        """Whether the type begins with a std_msgs/Header."""
        ...

    def decode(
        self, type_name: str, paths: Sequence[str], messages: Sequence[bytes]
    ) -> list[npt.NDArray[np.generic]]:
        """Read the values at `paths` from every message.

        Returns:
            One array of shape (len(messages),) a path: float64 for numbers and booleans, a
            unicode array for strings.

        Raises:
            EpisodeError: if a message is shorter than its type says, or a path or the name of a
                joint is not in it; the message names type and path.
        """
        ...


def header_stamp_ns(data: bytes) -> int:
    """Stamp of a message whose type begins with std_msgs/Header, read from its CDR bytes.

    Raises:
        EpisodeError: if the bytes are too short to hold a header.
    """
    if len(data) < 12:
        raise EpisodeError(f"message of {len(data)} bytes is too short to hold a header stamp")
    # The encapsulation's second byte is odd for little-endian encodings (OMG DDSI-RTPS, 10.5).
    sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return int(sec) * NS_PER_S + int(nanosec)


def playback_order(samples: Sequence[Sample]) -> list[Sample]:
    """Samples in stamp order across topics, in recorded order within a topic.

    Where stamps of a topic go back, its samples stay in their order, so that whoever listens sees
    the same fault as the recorder did.

    Args:
        samples: of one bag, in file order.
    """
    reached: dict[str, int] = {}
    keys = []
    for index, sample in enumerate(samples):
        stamp_ns = max(sample.stamp_ns, reached.get(sample.topic, sample.stamp_ns))
        reached[sample.topic] = stamp_ns
        keys.append((stamp_ns, index))
    return [samples[index] for _, index in sorted(keys)]
