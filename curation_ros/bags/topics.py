"""Topics of a bag: which of them can be read, and which topic of a map each one is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from curation_ros.bags.definitions import full_type_name, parse_definition
from curation_ros.bags.errors import TornFileError
from curation_ros.bags.mcap_info import McapInfo
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import BagError


@dataclass(frozen=True)
class BagTopic:
    """Type and number of messages of a topic."""

    type: str
    count: int


def collect_topics(
    path: Path,
    info: McapInfo,
    topics: dict[str, BagTopic],
    unreadable: dict[str, str],
    definitions: dict[str, str],
) -> None:
    """Add the topics of one file to those of a bag.

    Args:
        path: the file, for errors.
        info: what it holds.
        topics: resolved name -> topic; added to.
        unreadable: resolved name -> why its messages cannot be read; added to.
        definitions: message type -> ros2msg text; added to.

    Raises:
        BagError: if a topic has two types, or a type two definitions.
        TornFileError: if there are messages of a channel that the file does not have.
    """
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


def foreign_topic(path: Path, topic: str, reason: str) -> BagError:
    """The error for a topic whose messages cannot be read."""
    return BagError(f"{path}: topic {topic}: {reason}", finding="foreign-encoding")


def resolve_topics(
    path: Path,
    topic_map: TopicMap,
    types: Mapping[str, str],
    unreadable: Mapping[str, str],
    recorded: Mapping[str, object],
) -> dict[str, str]:
    """Find the topics of a map in a bag.

    A topic is the one that the recorder noted for it, else `/<topic>`, else the one that ends in
    `/<topic>`. If several end so, it is the one of the right type.

    Args:
        path: the bag, for errors.
        topic_map: the map.
        types: resolved name -> type of the messages, of all readable topics.
        unreadable: resolved name -> why its messages cannot be read.
        recorded: topic of a map -> resolved name, as the recorder noted them.

    Returns:
        Topic of the map -> resolved name; topics that the bag lacks are absent.

    Raises:
        BagError: if a topic has another type than the map expects, cannot be read, or may be
            several.
    """
    names = {**types, **dict.fromkeys(unreadable, "")}
    found: dict[str, str] = {}
    for topic in topic_map.topics:
        for name in (recorded.get(topic), "/" + topic.lstrip("/")):
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
                    f"{path}: topic {topic!r} may be {' or '.join(sorted(fitting))}; "
                    "write the whole name into the topic map",
                    finding="ambiguous",
                )
            if not fitting:
                continue
            found[topic] = fitting[0]
        name = found[topic]
        if name in unreadable:
            raise foreign_topic(path, name, unreadable[name])
        if names[name] != type_name:
            raise BagError(
                f"{path}: topic {name} has type {names[name]}, the topic map expects {type_name}",
                finding="wrong-type",
            )
    return found
