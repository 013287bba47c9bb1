"""A bag that is open: what it holds, its messages, and samples of them for an episode."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from curation_ros.bags.cdr import CdrDecoder, shared_decoder
from curation_ros.bags.mcap_blocks import MessageBlock, read_blocks
from curation_ros.bags.mcap_file import Message, walk
from curation_ros.bags.mcap_info import McapInfo
from curation_ros.bags.topics import BagTopic, foreign_topic, resolve_topics
from curation_ros.core.episode.status import EpisodeEvent, event_from_json
from curation_ros.core.episode.stream import Sample, SampleBlock, Stamps, header_stamps_ns
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.errors import BagError, ConfigError, EpisodeError


class BagMessage(NamedTuple):
    """A message of a bag; times are nanoseconds."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class Bag:
    """A bag that was opened: what it holds. Its messages are read on demand.

    Attributes:
        path: what was opened: a folder or an .mcap file.
        mcap_paths: its files in order.
        topics: resolved name -> type and count, of messages in CDR with a ros2msg definition.
        unreadable: resolved name -> why its messages cannot be read.
        definitions: message type -> ros2msg text, as recorded.
        custom_data: of rosbag2's metadata.
        start_ns, end_ns: first and last log time; 0 without messages.
    """

    path: Path
    mcap_paths: tuple[Path, ...]
    topics: Mapping[str, BagTopic]
    unreadable: Mapping[str, str]
    definitions: Mapping[str, str]
    custom_data: Mapping[str, str]
    start_ns: int
    end_ns: int
    _infos: tuple[McapInfo, ...]

    @property
    def name(self) -> str:
        """Name of the folder or, without its suffix, of the file."""
        return self.path.stem if self.path.is_file() else self.path.resolve().name

    @cached_property
    def sha256(self) -> str:
        """Digest of the first file, as 64 hexadecimal digits.

        Raises:
            BagError: if it cannot be read.
        """
        digest = hashlib.sha256()
        try:
            with self.mcap_paths[0].open("rb") as file:
                while block := file.read(1 << 20):
                    digest.update(block)
        except OSError as err:
            raise BagError(f"{self.mcap_paths[0]}: {err.strerror}") from err
        return digest.hexdigest()

    def decoder(self) -> CdrDecoder:
        """A decoder that knows the definitions of this bag."""
        return shared_decoder(self.definitions)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[BagMessage]:
        """Messages in file order; chunks without a wanted topic are not unpacked.

        Args:
            topics: resolved names; None: all that are readable.

        Raises:
            BagError: if a topic cannot be read, or a file is truncated or damaged. The messages
                before the damage are yielded first.
        """
        for topic in topics or ():
            if topic in self.unreadable:
                raise foreign_topic(self.path, topic, self.unreadable[topic])
        wanted = self.topics if topics is None else set(topics) & set(self.topics)
        for path, info in zip(self.mcap_paths, self._infos, strict=True):
            names = {i: c.topic for i, c in info.channels.items() if c.topic in wanted}
            chunks = info.chunk_channels

            def skip(offset: int, names: dict[int, str] = names, chunks: Any = chunks) -> bool:
                return offset in chunks and chunks[offset].isdisjoint(names)

            for record in walk(path, skip, names.keys()) if names else ():
                if isinstance(record, Message):
                    yield BagMessage(names[record.channel_id], *record[2:4], record[1], record[4])

    def resolve(self, topic_map: TopicMap) -> dict[str, str]:
        """Find the topics of a map in this bag, see `resolve_topics`.

        Returns:
            Topic of the map -> resolved name; topics that the bag lacks are absent.

        Raises:
            BagError: if a topic has another type than the map expects, cannot be read, or may be
                several.
        """
        types = {name: topic.type for name, topic in self.topics.items()}
        recorded = self._json("topics")
        return resolve_topics(self.path, topic_map, types, self.unreadable, recorded)

    def blocks(self, topic_map: TopicMap) -> Iterator[SampleBlock]:
        """All samples of the topics of a map, many at once; those of one topic are in file order.

        Raises:
            BagError: as `resolve` and `messages`, or where a type has no header although the map
                takes its stamp from there.
        """
        for parts in self._parts(topic_map):
            for _, block in parts:
                yield block

    def samples(self, topic_map: TopicMap) -> list[Sample]:
        """All samples of the topics of a map, in file order.

        Raises:
            BagError: as `blocks`.
        """
        out = []
        for parts in self._parts(topic_map):
            numbered = [
                (row, place, Sample(block.topic, stamp_ns, seq, block.messages[k]))
                for place, (rows, block) in enumerate(parts)
                for k, (row, stamp_ns, seq) in enumerate(
                    zip(rows.tolist(), block.stamps_ns.tolist(), block.seqs.tolist(), strict=True)
                )
            ]
            numbered.sort(key=lambda item: item[:2])
            out += [sample for _, _, sample in numbered]
        return out

    def _parts(self, topic_map: TopicMap) -> Iterator[list[tuple[Stamps, SampleBlock]]]:
        """Parts of the file in order, split by topic; with each block, its rows in the part."""
        resolved = self.resolve(topic_map)
        decoder = self.decoder()
        source_stamped = topic_map.source_stamped
        for topic, type_name in topic_map.topics.items():
            if topic in resolved and topic not in source_stamped:
                if decoder.has_header(type_name):
                    continue
                raise BagError(
                    f"{self.path}: topic {topic!r}: {type_name} has no header; "
                    "write 'stamp: source' into the topic map",
                    finding="no-header",
                )
        for path, info in zip(self.mcap_paths, self._infos, strict=True):
            ids: dict[str, list[int]] = {name: [] for name in resolved.values()}
            for channel in info.channels.values():
                if channel.topic in ids:
                    ids[channel.topic].append(channel.id)
            wanted = [channel_id for same in ids.values() for channel_id in same]
            place_of = np.zeros(max(wanted, default=0) + 1, dtype=np.int16)
            for place, same in enumerate(ids.values()):
                place_of[same] = place
            for block in read_blocks(path, info, wanted) if wanted else ():
                # Sorted by topic, and within each in file order: then each topic is a slice.
                places = place_of[block.channels]
                rows = np.argsort(places, kind="stable")
                edges = np.searchsorted(places[rows], np.arange(len(ids) + 1)).tolist()
                slices = dict(
                    zip(ids, itertools.starmap(slice, itertools.pairwise(edges)), strict=True)
                )
                ordered = block.take(rows)
                yield [
                    (
                        rows[slices[name]],
                        self._sample_block(
                            topic, name, ordered.take(slices[name]), topic in source_stamped
                        ),
                    )
                    for topic, name in resolved.items()
                ]

    def _sample_block(
        self, topic: str, name: str, block: MessageBlock, source_stamped: bool
    ) -> SampleBlock:
        if source_stamped:
            stamps_ns = block.publish_times_ns
            if (stamps_ns < 0).any():
                text = f"{self.path}: topic {name}: a publish time is above 2**63 ns"
                raise BagError(text, finding="malformed")
        else:
            try:
                stamps_ns = header_stamps_ns(block.messages)
            except EpisodeError as err:
                text = f"{self.path}: topic {name}: {err}"
                raise BagError(text, finding="undecodable") from err
        return SampleBlock(topic, stamps_ns, block.sequences, block.messages)

    def event(self) -> EpisodeEvent | None:
        """What the owner of the episode announced; None for a bag that is not ours.

        Raises:
            BagError: if it is there and makes no sense.
        """
        if "episode" not in self.custom_data:
            return None
        try:
            return event_from_json(self._json("episode"))
        except EpisodeError as err:
            raise BagError(f"{self.path}: {err}", finding="bad-metadata") from err

    def topic_map(self) -> TopicMap | None:
        """The topic map that our recorder stored; None for a bag that is not ours.

        Raises:
            BagError: if it is there and makes no sense.
        """
        if "topic_map" not in self.custom_data:
            return None
        try:
            return _stored_topic_map(self.custom_data["topic_map"])
        except ConfigError as err:
            raise BagError(f"{self.path}: {err}", finding="bad-metadata") from err

    def _json(self, key: str) -> dict[str, Any]:
        text = self.custom_data.get(key, "{}")
        try:
            raw = json.loads(text)
        except (ValueError, RecursionError):
            raw = None
        if not isinstance(raw, dict):
            raise BagError(
                f"{self.path}: custom_data {key!r} is {text[:40]!r}, expected a JSON object",
                finding="bad-metadata",
            )
        return raw


@functools.lru_cache(maxsize=64)
def _stored_topic_map(text: str) -> TopicMap:
    """The map that the bags of a dataset have in common."""
    try:
        raw = json.loads(text)
    except (ValueError, RecursionError) as err:
        raise ConfigError(f"its topic map is {text[:40]!r}, expected JSON") from err
    return topic_map_from_json(raw, "its topic map")
