"""Writes one bag in the layout of rosbag2 (MCAP, metadata version 9), safe against a crash."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, cast

from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from curation_ros.bags.mcap_info import OWN_METADATA
from curation_ros.bags.qos import QosProfile, qos_to_yaml
from curation_ros.bags.schemas import MessageSchema, message_schema
from curation_ros.bags.yaml_text import dump_yaml
from curation_ros.core.errors import BagError
from curation_ros.files import write_atomically
from curation_ros.version import __version__

#: Bytes of messages after which a chunk is written without being asked to flush.
CHUNK_BYTES = 256 * 1024

#: Of the chunks.
COMPRESSION = CompressionType.ZSTD
_ROS_DISTRO = "jazzy"


@dataclass
class _Topic:
    channel_id: int
    schema: MessageSchema
    qos: tuple[QosProfile, ...]
    count: int = 0


class _PlainFile:
    """A new file without a buffer of its own: after a failed write there is nothing to lose."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)
        self._size = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            written = os.write(self._fd, rest)
            self._size += written
            rest = rest[written:]
        return len(data)

    def tell(self) -> int:
        return self._size

    def flush(self) -> None:
        pass

    def sync(self) -> None:
        os.fsync(self._fd)

    def close(self) -> None:
        if self._fd >= 0:
            fd, self._fd = self._fd, -1
            os.close(fd)


class BagWriter:
    """One bag being written; what was flushed survives a crash, see `curation_ros.bags.recovery`.

    After a BagError nothing more can be written: call `abandon`. Not for use by several threads.
    """

    def __init__(
        self,
        directory: Path,
        name: str,
        *,
        custom_data: Mapping[str, str] | None = None,
    ) -> None:
        """Create the folder and the file; this also claims the bag, because the folder is new.

        Args:
            directory: folder of the bag; must not exist.
            name: the file is `<name>_0.mcap`.
            custom_data: what is known now; it survives if the bag must be recovered after a crash.

        Raises:
            BagError: if the folder exists, or cannot be written.
        """
        self.directory = directory
        self.path = directory / f"{name}_0.mcap"
        self._custom_data = dict(custom_data or {})
        self._topics: dict[str, _Topic] = {}
        self._schema_ids: dict[tuple[str, str], int] = {}
        self._start_ns = self._end_ns = self._total = 0
        self._open = False
        try:
            directory.mkdir(parents=True)
            self._file = _PlainFile(self.path)
        except FileExistsError as err:
            raise BagError(f"{directory} exists already; a bag is never overwritten") from err
        except OSError as err:
            raise self._failed(err) from err
        self._mcap = McapWriter(
            cast("IO[Any]", self._file),
            chunk_size=CHUNK_BYTES,
            compression=COMPRESSION,
        )
        self._open = True
        try:
            self._mcap.start(profile="ros2", library=f"curation_ros {__version__}")
            self._write_metadata_record()
        except OSError as err:
            self._file.close()
            raise self._failed(err) from err

    @property
    def counts(self) -> dict[str, int]:
        """Topic -> messages written."""
        return {name: topic.count for name, topic in self._topics.items()}

    def add_topic(
        self,
        name: str,
        type_name: str,
        qos: Sequence[QosProfile] = (),
        schema: MessageSchema | None = None,
    ) -> None:
        """Add a topic; adding it again changes nothing.

        Args:
            name: resolved name, such as `/joint_states`.
            type_name: such as `sensor_msgs/msg/JointState`.
            qos: what its publishers offer.
            schema: its definition; None: the one that is found on this machine.

        Raises:
            BagError: if the topic has another type already, no definition is found, or the disk
                fails.
        """
        self._require_open()
        known = self._topics.get(name)
        if known is not None:
            if known.schema.name != type_name:
                raise BagError(
                    f"{self.path}: topic {name} has type {known.schema.name}, not {type_name}"
                )
            return
        schema = message_schema(type_name) if schema is None else schema
        profiles = tuple(qos)
        try:
            key = (schema.name, schema.text)
            if key not in self._schema_ids:
                text = schema.text.encode()
                self._schema_ids[key] = self._mcap.register_schema(schema.name, "ros2msg", text)
            channel_id = self._mcap.register_channel(
                topic=name,
                message_encoding="cdr",
                schema_id=self._schema_ids[key],
                metadata={
                    "offered_qos_profiles": qos_to_yaml(profiles),
                    "topic_type_hash": schema.type_hash,
                },
            )
        except OSError as err:
            raise self._failed(err) from err
        self._topics[name] = _Topic(channel_id, schema, profiles)

    def write(
        self, topic: str, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes
    ) -> None:
        """Write a message.

        Args:
            topic: resolved name, added before.
            log_time_ns: when it was received.
            publish_time_ns: when it was published.
            sequence: publication sequence number; MCAP keeps its lowest 32 bits.
            data: CDR bytes.

        Raises:
            BagError: if the topic was not added, a time is out of range, or the disk fails.
        """
        self._require_open()
        found = self._topics.get(topic)
        if found is None:
            raise BagError(f"{self.path}: topic {topic} was not added to the bag")
        if not (0 <= log_time_ns < 1 << 63 and 0 <= publish_time_ns < 1 << 63):
            raise BagError(
                f"{self.path}: topic {topic}: times {log_time_ns} and {publish_time_ns} ns must "
                "be between 0 and 2**63"
            )
        try:
            self._mcap.add_message(
                channel_id=found.channel_id,
                log_time=log_time_ns,
                data=data,
                publish_time=publish_time_ns,
                sequence=sequence & 0xFFFF_FFFF,
            )
        except OSError as err:
            raise self._failed(err) from err
        if not self._total:
            self._start_ns = self._end_ns = log_time_ns
        self._start_ns = min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)
        self._total += 1
        found.count += 1

    def flush(self) -> None:
        """Hand everything so far to the system, where it survives a crash of this process.

        Raises:
            BagError: if the disk fails.
        """
        self._require_open()
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
        except OSError as err:
            raise self._failed(err) from err

    def close(self, custom_data: Mapping[str, str] | None = None) -> None:
        """Finish the bag: on return it is on the disk, metadata.yaml last.

        Args:
            custom_data: added to what the constructor was given.

        Raises:
            BagError: if the disk fails.
        """
        self._require_open()
        self._custom_data |= custom_data or {}
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]
            self._write_metadata_record()
            metadata = dump_yaml({"rosbag2_bagfile_information": self._bag_metadata()}).encode()
            own = own_metadata(self._custom_data, self.path.name, metadata)
            self._mcap.add_metadata(OWN_METADATA, own)
            self._mcap.finish()  # type: ignore[no-untyped-call]
            self._file.sync()
            self._file.close()
            self._open = False
            self._write_metadata_file(metadata)
        except OSError as err:
            raise self._failed(err) from err

    def abandon(self) -> None:
        """Leave the file as it is, after a failure or if the episode is not wanted."""
        self._open = False
        with suppress(OSError):
            self._file.close()

    def _require_open(self) -> None:
        if not self._open:
            raise BagError(f"{self.path} is closed: nothing more can be written to it")

    def _failed(self, err: OSError) -> BagError:
        # The chunk in progress is lost. Writing on would leave an unnoticed hole.
        self._open = False
        return BagError(f"{err.filename or self.path}: {err.strerror or err}")

    def _bag_metadata(self) -> dict[str, Any]:
        """rosbag2_storage::BagMetadata, version 9."""
        start = {"nanoseconds_since_epoch": self._start_ns}
        duration = {"nanoseconds": self._end_ns - self._start_ns}
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": duration,
            "starting_time": start,
            "message_count": self._total,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": name,
                        "type": topic.schema.name,
                        "serialization_format": "cdr",
                        "offered_qos_profiles": [p.to_rosbag2() for p in topic.qos],
                        "type_description_hash": topic.schema.type_hash,
                    },
                    "message_count": topic.count,
                }
                for name, topic in self._topics.items()
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [self.path.name],
            "files": [
                {
                    "path": self.path.name,
                    "starting_time": dict(start),
                    "duration": dict(duration),
                    "message_count": self._total,
                }
            ],
            "custom_data": dict(self._custom_data),
            "ros_distro": _ROS_DISTRO,
        }

    def _write_metadata_record(self) -> None:
        self._mcap.add_metadata(
            "rosbag2", {"serialized_metadata": dump_yaml(self._bag_metadata())}
        )

    def _write_metadata_file(self, content: bytes) -> None:
        # A folder that vanished while the bag was written took the messages with it.
        write_atomically(self.directory / "metadata.yaml", content, make_folder=False)


def own_metadata(
    custom_data: Mapping[str, str], file_name: str, metadata_file: bytes
) -> dict[str, str]:
    """What the record OWN_METADATA of a finished bag holds.

    Parsing the YAML of rosbag2 takes longer than reading an episode. So the record repeats what is
    needed of it. It is valid only together with the metadata.yaml whose digest it has.

    Args:
        custom_data: of rosbag2's metadata.
        file_name: of the bag's only .mcap file.
        metadata_file: content of metadata.yaml.
    """
    return {
        "custom_data": json.dumps(dict(custom_data)),
        "file": file_name,
        "metadata_sha256": hashlib.sha256(metadata_file).hexdigest(),
    }
