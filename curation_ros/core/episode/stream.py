"""What a live subscription and a bag have in common: stamped, numbered CDR bytes on a topic."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S, Floats

Stamps = npt.NDArray[np.int64]


#: How a message begins whose type begins with std_msgs/Header; integers little-endian.
_STAMPED = np.dtype(
    {
        "names": ["encoding", "sec", "nanosec"],
        "formats": ["u1", "<i4", "<u4"],
        "offsets": [1, 4, 8],
        "itemsize": 12,
    }
)


class Sample(NamedTuple):
    """One message of a mapped topic.

    `topic` is the name in the topic map, not the resolved one: namespaces and remaps end at the
    node. `seq` is the publication sequence number, or 0 if there is none (then arrival decides).
    `log_ns` and `publish_ns` are when it was received and sent. Bags store them; nothing joins by
    them.
    """

    topic: str
    stamp_ns: int
    seq: int
    data: bytes
    log_ns: int = 0
    publish_ns: int = 0


@dataclass(frozen=True, eq=False)
class Messages:
    """CDR bytes of messages of one topic in one buffer: as a chunk of a bag holds them.

    Attributes:
        buffer: (N,) contiguous uint8.
        starts, sizes: (n,) int64; message k is buffer[starts[k] : starts[k] + sizes[k]].
    """

    buffer: npt.NDArray[np.uint8]
    starts: Stamps
    sizes: Stamps

    def __len__(self) -> int:
        """Number of messages n."""
        return len(self.starts)

    def __getitem__(self, row: int) -> bytes:
        """The bytes of one message."""
        start = int(self.starts[row])
        return self.buffer[start : start + int(self.sizes[row])].tobytes()

    def take(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_] | slice) -> Messages:
        """Some of the messages, in the same buffer."""
        return Messages(self.buffer, self.starts[rows], self.sizes[rows])

    def compact(self) -> Messages:
        """The same messages in a buffer of their own."""
        return Messages.joined([self[row] for row in range(len(self))])

    @classmethod
    def joined(cls, messages: Sequence[bytes]) -> Messages:
        """Single messages side by side."""
        sizes = np.array([len(data) for data in messages], dtype=np.int64)
        buffer = np.frombuffer(b"".join(messages), dtype=np.uint8)
        return cls(buffer, np.cumsum(sizes) - sizes, sizes)


def rows_at(buffer: npt.NDArray[np.uint8], starts: Stamps, size: int) -> npt.NDArray[np.uint8]:
    """(n, size) bytes of a buffer from each start on.

    Args:
        buffer: (N,) contiguous.
        starts: (n,) each between 0 and N - size.
        size: number of bytes, at least 1.
    """
    # A view with a row at every byte: picking from it copies only the rows that are wanted.
    places: npt.NDArray[np.void] = np.ndarray(
        (len(buffer) - size + 1,), f"V{size}", buffer, 0, (1,)
    )
    return places[starts].view(np.uint8).reshape(len(starts), size)


class SampleBlock(NamedTuple):
    """Samples of one topic in their order; its arrays have one value per message."""

    topic: str
    stamps_ns: Stamps
    seqs: Stamps
    messages: Messages


class Columns(NamedTuple):
    """Values that a decoder has read from n messages at k paths.

    Attributes:
        values: (n, k) numbers; columns of texts and bad rows have no meaning.
        texts: column -> (n,) unicode array, where a path leads to a text.
        bad: row -> why its message could not be read.
    """

    values: Floats
    texts: dict[int, npt.NDArray[np.str_]]
    bad: dict[int, EpisodeError]


class Decoder(Protocol):
    """Turns CDR bytes of one message type into columns; `curation_ros.bags.cdr` has the real one.

    The core knows no message definitions, so it can be imported without ROS and bags.
    """

    def has_header(self, type_name: str) -> bool:
        """Whether the type begins with a std_msgs/Header."""
        ...

    def decode_block(self, type_name: str, paths: Sequence[str], messages: Messages) -> Columns:
        """Read the values at `paths` from every message; a message that does not fit is bad.

        Numbers and booleans become float64. A message is bad if it is too short for its type, or
        lacks the element or the joint of a path.
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


def header_stamps_ns(messages: Messages) -> Stamps:
    """(n,) stamps as `header_stamp_ns` reads them, of all messages in one pass.

    Raises:
        EpisodeError: if a message is too short to hold a header.
    """
    short = np.flatnonzero(messages.sizes < _STAMPED.itemsize)
    if len(short):
        header_stamp_ns(messages[int(short[0])])
    if not len(messages):
        return np.empty(0, dtype=np.int64)
    heads = rows_at(messages.buffer, messages.starts, _STAMPED.itemsize).view(_STAMPED)[:, 0]
    sec, nanosec = heads["sec"], heads["nanosec"]
    big = heads["encoding"] & 1 == 0
    if big.any():
        sec = np.where(big, sec.byteswap(), sec)
        nanosec = np.where(big, nanosec.byteswap(), nanosec)
    stamps: Stamps = sec.astype(np.int64) * NS_PER_S + nanosec.astype(np.int64)
    return stamps


def playback_order(samples: Sequence[Sample]) -> list[Sample]:
    """Samples in stamp order across topics, in recorded order within a topic.

    If stamps of a topic go back, its samples stay in their order, so that a subscriber gets the
    same fault as the recorder did.

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
