"""Episodes out of bags: what the owner of an episode announced, and its samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from curation_ros.bags.bag import Bag
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.identity import foreign_episode_id, is_uuid
from curation_ros.core.episode.status import EpisodeEvent, EventKind, owner_findings
from curation_ros.core.episode.stream import Sample, Stamps
from curation_ros.core.episode.topic_map import TopicMap
from curation_ros.core.errors import BagError, ConfigError


def episode_of(bag: Bag, topic_map: TopicMap | None = None, *, claimed_id: str = "") -> Episode:
    """Build the episode of a bag, equal to the live one.

    Args:
        bag: the bag.
        topic_map: which fields to build; None: the map that is stored in the bag.
        claimed_id: id that the place of the bag claims for it, see `episode_event`.

    Raises:
        BagError: if the bag cannot be read, does not fit the map, or has no map and none is given.
        ConfigError: if a path of the map does not exist in its type.
        EpisodeError: if the episode cannot be built.
    """
    topic_map = topic_map or bag.topic_map()
    if topic_map is None:
        raise BagError(
            f"{bag.path} was not recorded by this package: give a topic map",
            finding="no-topic-map",
        )
    try:
        return _built(bag, topic_map, claimed_id)
    except ConfigError as err:  # a path of the map that its type does not have
        raise ConfigError(f"{bag.path}: {err}") from err


def _built(bag: Bag, topic_map: TopicMap, claimed_id: str) -> Episode:
    blocks = list(bag.blocks(topic_map))
    clock = [b.stamps_ns for b in blocks if b.topic == topic_map.clock_topic]
    stamps = np.concatenate([*clock, np.empty(0, dtype=np.int64)])
    event = _event_of(bag, topic_map, stamps, claimed_id)
    builder = EpisodeBuilder(
        topic_map, bag.decoder(), episode_id=event.id, name=event.name, start_ns=event.start_ns
    )
    for block in blocks:
        builder.push_block(block)
    end_ns = event.end_ns if event.end_ns is not None else event.start_ns
    return builder.finish(end_ns, event.counts, owner_findings(event))


def episode_event(
    bag: Bag, topic_map: TopicMap, samples: Sequence[Sample], *, claimed_id: str = ""
) -> EpisodeEvent:
    """The end of the bag's episode as its owner announced it, or as its clock topic shows it.

    Args:
        bag: the bag.
        topic_map: which topic is the clock.
        samples: of that bag and map.
        claimed_id: id that the place of the bag claims for it. Empty: the name of the bag if that
            is a UUID; people name their folders as they like.

    Returns:
        An event that always has an end. Its reason has a line for a bag that was recovered, and
        for one with another id than claimed, so that these findings travel with a replay.

    Raises:
        BagError: if a bag that is not ours has nothing on its clock topic.
    """
    clock = [s.stamp_ns for s in samples if s.topic == topic_map.clock_topic]
    return _event_of(bag, topic_map, np.array(clock, dtype=np.int64), claimed_id)


def _event_of(bag: Bag, topic_map: TopicMap, clock: Stamps, claimed_id: str) -> EpisodeEvent:
    announced = bag.event()
    event = announced
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
    if event.end_ns is None:  # the recorder died before the end was announced
        kind: EventKind = "aborted" if event.event == "aborted" else "ended"
        event = replace(event, event=kind, end_ns=max([event.start_ns, *clock.tolist()]))
    claimed_id = claimed_id or (bag.name if is_uuid(bag.name) else event.id)
    if announced is not None and claimed_id != event.id:
        line = f"wrong-id: the folder {claimed_id} has the bag of episode {event.id}"
        event = replace(event, reason="\n".join(filter(None, [event.reason, line])))
    if bag.custom_data.get("recovered") == "true":
        tail = bag.custom_data.get("recovered_tail", "unknown")
        line = f"recovered: recovered after its recorder died; reading stopped: {tail}"
        event = replace(event, reason="\n".join(filter(None, [event.reason, line])))
    return event
