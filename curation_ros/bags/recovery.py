"""Saves what an interrupted recording has left, and never changes the original."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel, Metadata, Schema

from curation_ros.bags.definitions import full_type_name
from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_file import Message, walk
from curation_ros.bags.qos import qos_from_yaml
from curation_ros.bags.schemas import MessageSchema
from curation_ros.bags.writer import BagWriter
from curation_ros.bags.yaml_text import load_yaml
from curation_ros.core.errors import BagError
from curation_ros.files import sync_folder

#: The tail of a file that has nothing wrong with it.
COMPLETE = "complete"


@dataclass(frozen=True)
class RecoveryReport:
    """What a recovery has found.

    Attributes:
        path: folder of the new bag.
        messages: resolved topic -> messages saved.
        tail: why reading stopped, or COMPLETE.
        custom_data: of the new bag.
    """

    path: Path
    messages: Mapping[str, int]
    tail: str
    custom_data: Mapping[str, str]


def recover_bag(
    source: Path,
    target_dir: Path,
    *,
    scratch: Path | None = None,
) -> RecoveryReport:
    """Copy every complete message of an interrupted bag into a new one.

    The new bag appears at `target_dir` in one step, when it is whole. Its custom data are those of
    the interrupted bag with `recovered` (`true`), `recovered_messages` (a number) and
    `recovered_tail` (why reading stopped).

    Args:
        source: folder of the interrupted bag, or its .mcap file.
        target_dir: folder of the new bag; must not exist.
        scratch: where the new bag grows, on the file system of `target_dir`; None: a hidden folder
            beside it. What an interrupted recovery has left there is removed.

    Raises:
        BagError: if there is nothing to recover, the target exists, or the disk fails.
    """
    path = _only_mcap(source)
    if target_dir.exists():
        raise BagError(f"{target_dir} exists already; a bag is never overwritten")
    scratch = scratch or target_dir.with_name(f".{target_dir.name}.recovering")
    # An interrupted recovery leaves a copy, of which the original is still there.
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        next(walk(path), None)
    except TornFileError as err:
        raise BagError(f"{path} holds nothing to recover: {err.reason}") from err
    writer = BagWriter(scratch, path.stem.removesuffix("_0"))
    try:
        report = _copy(path, writer, target_dir)
        scratch.rename(target_dir)
        sync_folder(target_dir.parent)
    except OSError as err:
        raise BagError(f"{target_dir}: {err.strerror or err}") from err
    finally:
        writer.abandon()
        shutil.rmtree(scratch, ignore_errors=True)
    return report


def _only_mcap(source: Path) -> Path:
    if source.is_file():
        return source
    found = sorted(source.glob("*.mcap"))
    if len(found) != 1:
        raise BagError(f"{source}: expected one .mcap file to recover, found {len(found)}")
    return found[0]


def _copy(path: Path, writer: BagWriter, target_dir: Path) -> RecoveryReport:
    schemas: dict[int, Schema] = {}
    topics: dict[int, str] = {}
    found: dict[str, str] = {}
    tail = COMPLETE
    try:
        for record in walk(path):
            if isinstance(record, Message):
                topic = topics.get(record.channel_id)
                if topic is None:
                    tail = f"a message of the unknown channel {record.channel_id}"
                    break
                writer.write(
                    topic,
                    record.log_time_ns,
                    record.publish_time_ns,
                    record.sequence,
                    record.data,
                )
            elif isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                topics[record.id] = _add_channel(path, writer, record, schemas)
            elif isinstance(record, Metadata) and record.name == "rosbag2":
                found = custom_data_of(record.metadata)
    except TornFileError as err:
        tail = err.reason
    total = sum(writer.counts.values())
    recovered = {
        "recovered": "true",
        "recovered_messages": str(total),
        "recovered_tail": tail,
    }
    all_data = {**found, **recovered}
    writer.close(all_data)
    return RecoveryReport(target_dir, writer.counts, tail, all_data)


def _add_channel(
    path: Path, writer: BagWriter, channel: Channel, schemas: Mapping[int, Schema]
) -> str:
    schema = schemas.get(channel.schema_id)
    if schema is None or schema.encoding != "ros2msg" or channel.message_encoding != "cdr":
        encoding = schema.encoding if schema is not None else "no schema"
        raise BagError(
            f"{path}: topic {channel.topic} has messages in {channel.message_encoding!r} with "
            f"{encoding!r}; only 'cdr' with 'ros2msg' can be recovered"
        )
    text = schema.data.decode(errors="replace")
    type_hash = channel.metadata.get("topic_type_hash", "")
    writer.add_topic(
        channel.topic,
        full_type_name(schema.name),
        qos_from_yaml(channel.metadata.get("offered_qos_profiles", "")),
        MessageSchema(full_type_name(schema.name), text, type_hash),
    )
    return channel.topic


def custom_data_of(record: Mapping[str, str]) -> dict[str, str]:
    """custom_data in a `rosbag2` metadata record; empty where there is none."""
    try:
        raw = load_yaml(record.get("serialized_metadata", ""))
    except ValueError:
        return {}
    data = raw.get("custom_data") if isinstance(raw, Mapping) else None
    return {str(k): str(v) for k, v in data.items()} if isinstance(data, Mapping) else {}
