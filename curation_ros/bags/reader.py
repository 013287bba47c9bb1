"""Reads bags: ours, those of rosbag2 and of other writers, with or without metadata.yaml."""

from __future__ import annotations

import functools
import hashlib
import itertools
import json
import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from curation_ros.bags.cdr import CdrDecoder, shared_decoder
from curation_ros.bags.definitions import full_type_name, parse_definition
from curation_ros.bags.mcap_blocks import MessageBlock, read_blocks
from curation_ros.bags.mcap_file import (
    McapInfo,
    Message,
    TornFileError,
    open_now,
    read_info,
    walk,
)
from curation_ros.bags.recovery import custom_data_of
from curation_ros.bags.writer import own_metadata
from curation_ros.bags.yaml_text import MOST_BYTES, load_yaml
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.identity import foreign_episode_id
from curation_ros.core.episode.status import (
    EpisodeEvent,
    EventKind,
    event_from_json,
    owner_findings,
)
from curation_ros.core.episode.stream import Sample, SampleBlock, Stamps, header_stamps_ns
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.errors import BagError, ConfigError, EpisodeError

_FEW = 3
_UUID = re.compile(r"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")


@dataclass(frozen=True)
class BagTopic:
    """Type and number of messages of a topic."""

    type: str
    count: int


class BagMessage(NamedTuple):
    """A message of a bag; times are nanoseconds."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True)
class Bag:
    """A bag that was opened: what it holds; its messages are read when asked for.

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
            BagError: if a topic cannot be read, or a file is truncated or damaged, after all
                before the damage were yielded.
        """
        for topic in topics or ():
            if topic in self.unreadable:
                raise _foreign(self.path, topic, self.unreadable[topic])
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
        """Find the topics of a map in this bag.

        A topic is the one that our recorder noted for it, else `/<topic>`, else the one that ends
        in `/<topic>` (among several: the one of the right type).

        Returns:
            Topic of the map -> resolved name; those that the bag lacks are absent.

        Raises:
            BagError: if a topic has another type than the map says, or several would do.
        """
        noted = self._json("topics")
        names = {**{t: x.type for t, x in self.topics.items()}, **dict.fromkeys(self.unreadable)}
        found: dict[str, str] = {}
        for topic in topic_map.topics:
            for name in (noted.get(topic), "/" + topic.lstrip("/")):
                if isinstance(name, str) and name in names:
                    found[topic] = name
                    break
        for topic, type_name in topic_map.topics.items():
            if topic not in found:
                taken = set(found.values())
                ends = [n for n in names if n.endswith("/" + topic.lstrip("/")) and n not in taken]
                fitting = [n for n in ends if names[n] == type_name] or ends
                if len(fitting) > 1:
                    raise BagError(
                        f"{self.path}: topic {topic!r} may be {' or '.join(sorted(fitting))}; "
                        "write the whole name into the topic map",
                        finding="ambiguous",
                    )
                if not fitting:
                    continue
                found[topic] = fitting[0]
            name = found[topic]
            if name in self.unreadable:
                raise _foreign(self.path, name, self.unreadable[name])
            if names[name] != type_name:
                raise BagError(
                    f"{self.path}: topic {name} has type {names[name]}, the topic map expects "
                    f"{type_name}",
                    finding="wrong-type",
                )
        return found

    def blocks(self, topic_map: TopicMap) -> Iterator[SampleBlock]:
        """All samples of the topics of a map, many at once; each topic's in file order.

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
        """Blocks of file order, split by topic; beside each the rows that it had in its block."""
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
                # Side by side by topic, in file order within: then each topic is a slice.
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
        """What the owner of the episode said; None for a bag that is not ours.

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


def open_bag(path: Path) -> Bag:
    """Open a bag.

    Args:
        path: folder of a bag, with or without metadata.yaml, or one .mcap file.

    Raises:
        BagError: if it is missing, truncated, of another storage or encoding, or compressed as a
            whole, saying which and what to do.
    """
    known = _open_own(path)
    if known is not None:
        mcap_paths, infos, custom_data = known
    else:
        mcap_paths, infos, custom_data = _open_any(path)
    topics: dict[str, BagTopic] = {}
    unreadable: dict[str, str] = {}
    definitions: dict[str, str] = {}
    for file, info in zip(mcap_paths, infos, strict=True):
        _collect_topics(file, info, topics, unreadable, definitions)
    if not topics and unreadable:
        name, reason = next(iter(unreadable.items()))
        raise BagError(
            f"{path}: no topic can be read: {name}: {reason}", finding="foreign-encoding"
        )
    filled = [info for info in infos if info.counts]
    return Bag(
        path=path,
        mcap_paths=mcap_paths,
        topics=topics,
        unreadable=unreadable,
        definitions=definitions,
        custom_data=custom_data,
        start_ns=min((info.start_ns for info in filled), default=0),
        end_ns=max((info.end_ns for info in filled), default=0),
        _infos=infos,
    )


_Opened: TypeAlias = tuple[tuple[Path, ...], tuple[McapInfo, ...], dict[str, str]]


def _open_own(folder: Path) -> _Opened | None:
    """Open a folder as our writer left it, without parsing YAML; None for any other."""
    try:
        content = _metadata_bytes(folder)
        [file] = [entry.path for entry in os.scandir(folder) if entry.name.endswith(".mcap")]
        info = _checked_info(Path(file))
    except (OSError, ValueError, BagError):
        return None  # whatever is wrong, reading it as a foreign bag says so
    custom_data = _own_custom_data(info)
    if custom_data is None or info.own is None:
        return None
    if info.own != own_metadata(custom_data, os.path.basename(file), content):
        return None
    return (Path(file),), (info,), custom_data


def _own_custom_data(info: McapInfo) -> dict[str, str] | None:
    """custom_data as our writer noted it in the file; None where it did not."""
    try:
        raw = json.loads((info.own or {}).get("custom_data", ""))
    except (ValueError, RecursionError):
        return None
    return {str(k): str(v) for k, v in raw.items()} if isinstance(raw, dict) else None


def _open_any(path: Path) -> _Opened:
    custom_data: dict[str, str] | None = None
    if path.is_dir():
        metadata = _read_metadata_file(path)
        mcap_paths = _listed_files(path, metadata) if metadata else _found_files(path)
        if metadata is not None:
            raw = metadata.get("custom_data") or {}
            custom_data = {str(k): str(v) for k, v in raw.items()}
    else:
        mcap_paths = (path,)
    infos = tuple(_checked_info(p) for p in mcap_paths)
    if custom_data is None:
        custom_data = _own_custom_data(infos[-1])
    if custom_data is None:
        records = [info.rosbag2 for info in infos if info.rosbag2 is not None]
        custom_data = custom_data_of(records[-1]) if records else {}
    return mcap_paths, infos, custom_data


def _metadata_bytes(folder: Path) -> bytes:
    """The text of metadata.yaml, or its beginning where it is too large to be metadata."""
    with open_now(folder / "metadata.yaml") as file:
        return file.read(MOST_BYTES + 1)


def _read_metadata_file(folder: Path) -> dict[str, Any] | None:
    """Contents of metadata.yaml; None where it is missing or spoilt: the files say the same."""
    path = folder / "metadata.yaml"
    try:
        raw = load_yaml(_metadata_bytes(folder))
    except FileNotFoundError:
        return None
    except OSError as err:
        raise BagError(f"{path}: {err.strerror}") from err
    except ValueError:
        return None
    info = raw.get("rosbag2_bagfile_information") if isinstance(raw, dict) else None
    if not isinstance(info, dict) or not isinstance(info.get("custom_data") or {}, dict):
        return None
    return info


def _listed_files(folder: Path, metadata: Mapping[str, Any]) -> tuple[Path, ...]:
    storage = metadata.get("storage_identifier", "mcap")
    if storage not in ("mcap", ""):
        raise BagError(
            f"{folder}: storage {storage!r:.80} cannot be read, expected mcap; convert it with "
            "rosbags-convert or `ros2 bag convert`",
            finding="foreign-format",
        )
    if metadata.get("compression_mode"):
        raise BagError(
            f"{folder}: compression mode {metadata['compression_mode']!r:.80} cannot be read, "
            "expected MCAP's own compression of chunks; convert it with rosbags-convert",
            finding="unsupported-compression",
        )
    listed = metadata.get("relative_file_paths")
    if not isinstance(listed, list) or not listed:
        return _found_files(folder)
    # Bags of old versions name their own folder, too; and none may point out of it.
    files = tuple(folder / Path(str(name)).name for name in listed)
    for file in files:
        if not file.is_file():
            raise BagError(
                f"{folder}: metadata.yaml names {file.name}, which is not there",
                finding="missing-file",
            )
    return files


def _found_files(folder: Path) -> tuple[Path, ...]:
    files = sorted(folder.glob("*.mcap"), key=_natural)
    if len(files) == 1 or (files and _is_split(folder, files)):
        return tuple(files)
    if files:
        raise BagError(
            f"{folder} has {len(files)} .mcap files and no metadata.yaml: name one of them",
            finding="ambiguous",
        )
    for pattern, what, finding in (
        ("*.db3", "SQLite files (.db3)", "foreign-format"),
        ("*.zstd", "compressed files (.zstd)", "unsupported-compression"),
    ):
        if any(folder.glob(pattern)):
            raise BagError(
                f"{folder} has {what}, expected .mcap; convert it with rosbags-convert",
                finding=finding,
            )
    raise BagError(
        f"{folder} is no bag: it has neither metadata.yaml nor an .mcap file",
        finding="missing-file",
    )


def _is_split(folder: Path, files: Sequence[Path]) -> bool:
    """Whether files are the parts of one recording, as rosbag2 names them: <folder>_<number>."""
    stem = re.escape(folder.resolve().name)
    return all(re.fullmatch(rf"{stem}_\d+", file.stem) for file in files)


def _natural(path: Path) -> tuple[tuple[int, str], ...]:
    """Sort key under which part 10 follows part 9, and episodes follow the time of their ids."""
    if _UUID.fullmatch(path.stem):
        return ((-1, path.stem),)
    pieces = re.findall(r"\d+|\D+", path.name)
    return tuple((int(p), "") if p.isdigit() and p.isascii() else (-1, p) for p in pieces)


def _foreign(path: Path, topic: str, reason: str) -> BagError:
    return BagError(f"{path}: topic {topic}: {reason}", finding="foreign-encoding")


def _checked_info(path: Path) -> McapInfo:
    info = read_info(path)
    if info.profile not in ("ros2", ""):
        raise BagError(
            f"{path}: MCAP profile {info.profile!r}, expected 'ros2'", finding="foreign-encoding"
        )
    return info


def _collect_topics(
    path: Path,
    info: McapInfo,
    topics: dict[str, BagTopic],
    unreadable: dict[str, str],
    definitions: dict[str, str],
) -> None:
    for channel in info.channels.values():
        schema = info.schemas.get(channel.schema_id)
        encoding = schema.encoding if schema is not None else ""
        if schema is None or channel.message_encoding != "cdr" or encoding != "ros2msg":
            unreadable[channel.topic] = (
                f"messages in {channel.message_encoding!r} with a schema in {encoding!r}; "
                "expected 'cdr' with 'ros2msg'"
            )
            continue
        type_name = full_type_name(schema.name)
        known = topics.get(channel.topic)
        if known is not None and known.type != type_name:
            raise BagError(
                f"{path}: topic {channel.topic} has two types, {known.type} and {type_name}",
                finding="ambiguous",
            )
        count = info.counts.get(channel.id, 0) + (known.count if known is not None else 0)
        topics[channel.topic] = BagTopic(type_name, count)
        text = schema.data.decode(errors="replace")
        other = definitions.setdefault(type_name, text)
        if other != text and parse_definition(type_name, other) != parse_definition(
            type_name, text
        ):
            raise BagError(
                f"{path}: there are two different definitions of {type_name}", finding="ambiguous"
            )
    strange = set(info.counts) - set(info.channels)
    if strange:
        raise TornFileError(
            path, f"messages of the unknown channel {min(strange)}", "unknown-channel"
        )


def read_episode(path: Path, topic_map: TopicMap | None = None) -> Episode:
    """Build the episode of a bag, equal to the live one.

    Args:
        path: folder of a bag, or an .mcap file.
        topic_map: which fields to build; None: the map that is stored in the bag.

    Raises:
        BagError: if the bag cannot be read, fits the map not, or has no map and none is given.
        ConfigError: if a path of the map does not exist in its type.
        EpisodeError: if the episode cannot be built.
    """
    return episode_of(open_bag(path), topic_map)


def episode_of(bag: Bag, topic_map: TopicMap | None = None) -> Episode:
    """Build the episode of a bag that is open; see `read_episode`."""
    topic_map = topic_map or bag.topic_map()
    if topic_map is None:
        raise BagError(
            f"{bag.path} was not recorded by this package: give a topic map",
            finding="no-topic-map",
        )
    try:
        return _built(bag, topic_map)
    except ConfigError as err:  # a path of the map that its type has not
        raise ConfigError(f"{bag.path}: {err}") from err


def _built(bag: Bag, topic_map: TopicMap) -> Episode:
    blocks = list(bag.blocks(topic_map))
    clock = [b.stamps_ns for b in blocks if b.topic == topic_map.clock_topic]
    event = _event_of(bag, topic_map, np.concatenate([*clock, np.empty(0, dtype=np.int64)]))
    builder = EpisodeBuilder(
        topic_map, bag.decoder(), episode_id=event.id, name=event.name, start_ns=event.start_ns
    )
    for block in blocks:
        builder.push_block(block)
    end_ns = event.end_ns if event.end_ns is not None else event.start_ns
    return builder.finish(end_ns, event.counts, owner_findings(event))


def episode_event(bag: Bag, topic_map: TopicMap, samples: Sequence[Sample]) -> EpisodeEvent:
    """The end of the bag's episode as its owner said it, or as its clock topic shows it.

    Args:
        bag: the bag.
        topic_map: which topic is the clock.
        samples: of that bag and map.

    Returns:
        An event that always has an end. Its reason notes that a bag was recovered, so that the
        finding travels with a replay.

    Raises:
        BagError: if a bag that is not ours has nothing on its clock topic.
    """
    clock = [s.stamp_ns for s in samples if s.topic == topic_map.clock_topic]
    return _event_of(bag, topic_map, np.array(clock, dtype=np.int64))


def _event_of(bag: Bag, topic_map: TopicMap, clock: Stamps) -> EpisodeEvent:
    event = bag.event()
    if event is None:
        if not len(clock):
            raise BagError(
                f"{bag.path}: no message of the clock topic {topic_map.clock_topic!r}; "
                f"the bag has {', '.join(sorted(bag.topics)) or 'no topics'}",
                finding="no-clock",
            )
        start_ns = int(clock.min())
        episode_id = foreign_episode_id(bag.sha256, start_ns)
        event = EpisodeEvent(episode_id, bag.name, "ended", start_ns, int(clock.max()))
    if event.end_ns is None:  # the recorder died before it was said
        kind: EventKind = "aborted" if event.event == "aborted" else "ended"
        event = replace(event, event=kind, end_ns=max([event.start_ns, *clock.tolist()]))
    # In a dataset the folder is the episode's name; elsewhere people name folders as they like.
    is_named = _UUID.fullmatch(bag.name) or bag.path.resolve().parent.name == "episodes"
    if is_named and bag.name != event.id and bag.event() is not None:
        line = f"wrong-id: the folder {bag.name} has the bag of episode {event.id}"
        event = replace(event, reason="\n".join(filter(None, [event.reason, line])))
    if bag.custom_data.get("recovered") == "true":
        tail = bag.custom_data.get("recovered_tail", "unknown")
        line = f"recovered: recovered after its recorder died; reading stopped: {tail}"
        event = replace(event, reason="\n".join(filter(None, [event.reason, line])))
    return event


def find_bags(paths: Iterable[Path]) -> list[Path]:
    """Find the bags that a person means.

    Args:
        paths: .mcap files, bags, folders of bags or files, and datasets (their `episodes`);
            what begins with a dot, such as `.partial`, is no bag.

    Returns:
        Paths for `open_bag`, in the order given; within a dataset in that of the recording,
        within another folder by name; none twice.

    Raises:
        BagError: for a path that does not exist or has no bag in it.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        bags = _bags_in(path)
        if not bags:
            problem = f"{path} has no bag in it" if path.exists() else f"{path}: no such path"
            raise BagError(problem + hint_of_datasets(path), finding="missing-file")
        for bag in bags:
            found.setdefault(bag.resolve(), bag)
    return list(found.values())


def hint_of_datasets(folder: Path) -> str:
    """`: did you mean DATASET?` where datasets are in a folder that is none; else nothing."""
    with suppress(OSError):
        inside = sorted(entry for entry in folder.iterdir() if (entry / "episodes").is_dir())
        if inside:
            return f": did you mean {' or '.join(str(entry) for entry in inside[:_FEW])}?"
    return ""


def _bags_in(path: Path) -> list[Path]:
    if path.is_file():
        return [path]
    if _is_bag(path):
        return [path]
    try:
        is_dataset = (path / "episodes").is_dir()
        folder = path / "episodes" if is_dataset else path
        inside = sorted(folder.iterdir()) if folder.is_dir() else []
        if not is_dataset:  # there names are ids, whose plain order is that of the recording
            inside.sort(key=_natural)
    except OSError as err:
        raise BagError(f"{path}: {err.strerror}") from err
    return [
        entry
        for entry in inside
        if not entry.name.startswith(".")
        and (entry.suffix == ".mcap" if entry.is_file() else _is_bag(entry))
    ]


def _is_bag(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    if (folder / "metadata.yaml").is_file() or any(folder.glob("*.db3")):
        return True
    files = list(folder.glob("*.mcap"))
    return len(files) == 1 or (bool(files) and _is_split(folder, files))
