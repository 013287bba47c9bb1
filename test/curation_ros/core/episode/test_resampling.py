from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import bag_messages
import numpy as np
import pytest
from bag_messages import to_cdr
from episodes import make_episode
from hypothesis import given
from hypothesis import strategies as st
from naive_resampling import Row, resample
from streams import ended, samples_of

from curation_ros.bags import CdrDecoder, open_bag
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.types import NS_PER_S
from curation_ros.dataset.episodes import read_episode

START_NS = 1_781_000_000_000_000_000
SAMPLE_BAG = Path(__file__).resolve().parents[4] / "bags" / "sample"
#: Of an interpolated value; all others are copied.
INTERPOLATION_RTOL = 1e-9
RATES_HZ = {"tool": 100.0, "joints": 250.0, "twist": 30.0, "hand": 30.0, "weight": 30.0}
_RAW: dict[str, Any] = {
    "max_gap_s": 0.1,
    "fields": {
        "tool": {
            "topic": "tool",
            "type": bag_messages.POSE,
            "role": "effector",
            "values": ["pose.position.x", "pose.position.y"],
        },
        "arm": {
            "topic": "joints",
            "type": bag_messages.JOINTS,
            "role": "observation",
            "values": ["position.j1", "position.j2"],
            "interpolate": True,
        },
        "twist": {
            "topic": "twist",
            "type": bag_messages.TWIST,
            "role": "action",
            "values": ["twist.linear.x"],
        },
        "hand": {
            "topic": "hand",
            "type": bag_messages.JOINTS,
            "role": "gripper",
            "values": ["position.jaw"],
        },
        "weight": {
            "topic": "weight",
            "type": "std_msgs/msg/Float64",
            "role": "observation",
            "values": ["data"],
            "stamp": "source",
        },
    },
}
MAP = topic_map_from_json(_RAW)


def _message(topic: str, stamp_ns: int, values: Sequence[float]) -> Any:
    if topic == "tool":
        return bag_messages.pose(stamp_ns, (*values, 0.0))
    if topic == "joints":
        return bag_messages.joint_state(stamp_ns, {"j1": values[0], "j2": values[1]})
    if topic == "hand":
        return bag_messages.joint_state(stamp_ns, {"jaw": values[0]})
    if topic == "weight":  # no header: its stamp is on the sample alone
        return bag_messages.make("std_msgs/msg/Float64", data=values[0])
    return bag_messages.twist(stamp_ns, (values[0], 0.0, 0.0))


def _stream(
    rng: np.random.Generator,
    seconds: float,
    *,
    jitter: float,
    lost: float,
    rates_hz: Mapping[str, float] = RATES_HZ,
) -> dict[str, list[Row]]:
    """Rows of every topic: stamps off their grid by a share of the period, some never sent."""
    rows: dict[str, list[Row]] = {}
    for spec in MAP.fields.values():
        period_ns = NS_PER_S / rates_hz[spec.topic]
        n = int(seconds * rates_hz[spec.topic])
        offsets = (np.arange(n) + rng.random() + jitter * rng.uniform(-0.5, 0.5, n)) * period_ns
        kept = np.flatnonzero(rng.random(n) >= lost)
        rows[spec.name] = [
            (START_NS + int(offsets[k]), rng.standard_normal(len(spec.values)).tolist())
            for k in kept
        ]
    return rows


def _samples(rows: Mapping[str, Sequence[Row]]) -> list[Sample]:
    out = []
    for name, some in rows.items():
        topic = MAP.fields[name].topic
        for seq, (ns, values) in enumerate(some, 1):
            out.append(Sample(topic, ns, seq, to_cdr(_message(topic, ns, values))))
    return out


def _build(
    samples: Sequence[Sample], start_ns: int, end_ns: int, topic_map: TopicMap = MAP
) -> Episode:
    builder = EpisodeBuilder(
        topic_map, CdrDecoder(), episode_id="id", name="any", start_ns=start_ns
    )
    for sample in samples:
        builder.push(sample)
    return builder.finish(end_ns, {})


def _same(episode: Episode, stamps: list[int], fields: Mapping[str, Any]) -> None:
    assert episode.stamps_ns.tolist() == stamps
    for name, spec in episode.topic_map.fields.items():
        expected = np.array(fields[name]).reshape(len(stamps), len(spec.values))
        found = episode.field(name)
        if spec.interpolate:
            np.testing.assert_allclose(found, expected, rtol=INTERPOLATION_RTOL, atol=1e-12)
        else:
            np.testing.assert_array_equal(found, expected)


# --- any rates ----------------------------------------------------------------------------------


@given(
    seed=st.integers(0, 2**32 - 1),
    jitter=st.sampled_from([0.0, 0.2, 0.9]),
    lost=st.sampled_from([0.0, 0.1, 0.6]),
    first=st.floats(0.0, 0.3),
    last=st.floats(0.3, 1.2),
    data=st.data(),
)
def test_topics_of_any_rate_join_by_the_rule(
    seed: int, jitter: float, lost: float, first: float, last: float, data: st.DataObject
) -> None:
    rng = np.random.default_rng(seed)
    topics = sorted(RATES_HZ)
    rates = data.draw(st.permutations(list(RATES_HZ.values())))
    rows = _stream(
        rng, 1.0, jitter=jitter, lost=lost, rates_hz=dict(zip(topics, rates, strict=True))
    )
    start_ns, end_ns = START_NS + int(first * 1e9), START_NS + int(last * 1e9)
    # Late: whatever was sent arrives in another order than it was stamped.
    samples = _samples(rows)
    arrived = [samples[k] for k in rng.permutation(len(samples))]
    missing = {
        spec.topic
        for name, spec in MAP.fields.items()
        if not any(start_ns <= ns <= end_ns for ns, _ in rows[name])
    }
    episode = _build(arrived, start_ns, end_ns)
    found = {f.id for f in episode.findings}
    assert ("missing-topic" in found) == bool(missing)
    if not missing:
        _same(episode, *resample(rows, MAP, start_ns, end_ns))


def test_robot_at_30_100_and_250_hz_runs_at_the_rate_of_its_clock(
    rng: np.random.Generator,
) -> None:
    rows = _stream(rng, 3.0, jitter=0.3, lost=0.02)
    episode = _build(_samples(rows), START_NS, START_NS + 3 * NS_PER_S)
    assert episode.rate_hz == pytest.approx(100.0, rel=0.05)
    assert episode.findings == ()
    assert all(np.isfinite(values).all() for values in episode.fields.values())
    # What is slower than the clock is held, and what answers is the next command.
    held = np.diff(episode.field("weight")[:, 0]) == 0
    assert 0.6 < held.mean() < 0.75
    commands = dict(rows["twist"])
    for k in (0, 50, 200):
        at = int(episode.stamps_ns[k])
        answer = min(ns for ns in commands if ns >= at)
        assert episode.field("twist")[k, 0] == commands[answer][0]


def test_message_that_never_came_leaves_a_number_out_and_the_one_before_stands(
    rng: np.random.Generator,
) -> None:
    rows = _stream(rng, 2.0, jitter=0.2, lost=0.0)
    samples = _samples(rows)
    weights = [s for s in samples if s.topic == "weight"]
    lost = weights[20]
    assert {s.seq for s in weights} - {s.seq for s in weights if s is not lost} == {21}
    episode = _build([s for s in samples if s is not lost], START_NS, START_NS + 2 * NS_PER_S)
    meanwhile = (episode.stamps_ns >= lost.stamp_ns) & (episode.stamps_ns < weights[21].stamp_ns)
    assert meanwhile.sum() >= 2
    assert set(episode.field("weight")[meanwhile, 0]) == {rows["weight"][19][1][0]}
    assert episode.findings == ()  # 67 ms are less than max_gap_s


@pytest.mark.parametrize("field", ["arm", "twist", "weight"])
def test_silence_beyond_max_gap_marks_the_episode(field: str, rng: np.random.Generator) -> None:
    rows = _stream(rng, 2.0, jitter=0.2, lost=0.0)
    silent = (START_NS + NS_PER_S // 2, START_NS + NS_PER_S)
    rows[field] = [row for row in rows[field] if not silent[0] <= row[0] <= silent[1]]
    episode = _build(_samples(rows), START_NS, START_NS + 2 * NS_PER_S)
    topic = MAP.fields[field].topic
    [gap] = [f for f in episode.findings if f.id == "gap"]
    assert repr(topic) in gap.message
    before = max(ns for ns, _ in rows[field] if ns < silent[0])
    after = min(ns for ns, _ in rows[field] if ns > silent[1])
    assert gap.span == (before - START_NS, after - START_NS)
    _same(episode, *resample(rows, MAP, START_NS, START_NS + 2 * NS_PER_S))
    # A command that answers nothing is none; what was seen last stays.
    assert np.isnan(episode.field(field)).any() == (field == "twist")


# --- lockstep -----------------------------------------------------------------------------------


def _joined(samples: Sequence[Sample], made: Episode) -> Episode:
    builder = EpisodeBuilder(
        made.topic_map, CdrDecoder(), episode_id=made.id, name=made.name, start_ns=made.start_ns
    )
    for sample in samples:
        builder.push(sample)
    return builder.finish(made.end_ns, {})


def _shifted(
    samples: Sequence[Sample], topic_map: TopicMap, offsets_ns: Mapping[str, int]
) -> list[Sample]:
    """Observations a little before the clock's stamp, commands a little after it."""
    return [
        s._replace(
            stamp_ns=s.stamp_ns
            + offsets_ns[s.topic] * (1 if s.topic in topic_map.command_topics else -1)
        )
        for s in samples
    ]


def _resampled(
    samples: Sequence[Sample], joined: Episode, offsets_ns: Mapping[str, int]
) -> Episode:
    """The same stream with no two stamps alike, in a window that has room for them."""
    margin_ns = max(offsets_ns.values())
    wider = replace(joined, start_ns=joined.start_ns - margin_ns, end_ns=joined.end_ns + margin_ns)
    shifted = _shifted(samples, joined.topic_map, offsets_ns)
    assert len({s.stamp_ns for s in shifted}) == len({(s.topic, s.stamp_ns) for s in samples})
    return _joined(shifted, wider)


def _same_arrays(a: Episode, b: Episode) -> None:
    np.testing.assert_array_equal(a.stamps_ns, b.stamps_ns)
    assert list(a.fields) == list(b.fields)
    for name in a.fields:
        np.testing.assert_array_equal(a.fields[name], b.fields[name], err_msg=name)


def _offsets(topic_map: TopicMap, most_ns: int) -> dict[str, int]:
    """An offset a topic, all different, the clock's 0."""
    others = [t for t in topic_map.topics if t != topic_map.clock_topic]
    step = most_ns // (2 * len(others))
    return {topic_map.clock_topic: 0} | {t: (k + 1) * step + k for k, t in enumerate(others)}


@pytest.mark.parametrize("most_ms", [1, 20, 49])
def test_lockstep_stream_through_the_resampler_is_the_joined_one(
    most_ms: int, rng: np.random.Generator
) -> None:
    made = make_episode(rng)
    joined = _joined(samples_of(made), made)
    offsets = _offsets(made.topic_map, most_ms * 1_000_000)
    assert max(offsets.values()) < 50_000_000  # less than a step
    _same_arrays(_resampled(samples_of(made), joined, offsets), joined)
    _same_arrays(joined, made)


def test_lockstep_bag_through_the_resampler_is_the_joined_one() -> None:
    joined = read_episode(SAMPLE_BAG)
    samples = open_bag(SAMPLE_BAG).samples(joined.topic_map)
    assert len({s.stamp_ns for s in samples}) == len(joined)
    resampled = _resampled(samples, joined, _offsets(joined.topic_map, 40_000_000))
    _same_arrays(resampled, joined)
    assert resampled.content_digest == joined.content_digest
    assert resampled.findings == joined.findings == ()


def test_lockstep_stream_joins_by_the_written_rule(rng: np.random.Generator) -> None:
    """Equal stamps: the rule for any rates says the same as the exact join."""
    made = make_episode(rng, 60, close_at=20)
    rows = {
        name: list(zip(made.stamps_ns.tolist(), values.tolist(), strict=True))
        for name, values in made.fields.items()
    }
    stamps, fields = resample(rows, made.topic_map, made.start_ns, made.end_ns)
    assert stamps == made.stamps_ns.tolist()
    for name, values in fields.items():
        np.testing.assert_array_equal(values, made.fields[name])
    _same(_joined(samples_of(made), made), stamps, fields)


def test_interpolation_at_equal_stamps_changes_nothing(rng: np.random.Generator) -> None:
    made = make_episode(rng)
    raw = made.topic_map.to_json()
    for name in ("joint_position", "bowl_position"):
        raw["fields"][name]["interpolate"] = True
    between = topic_map_from_json(raw)
    interpolated = _joined(samples_of(made), replace(made, topic_map=between))
    _same_arrays(interpolated, made)


def test_counts_of_a_lockstep_owner_hold_after_the_resampler(rng: np.random.Generator) -> None:
    made = make_episode(rng, 60, close_at=20)
    offsets = _offsets(made.topic_map, 9_000_000)
    builder = EpisodeBuilder(
        made.topic_map, CdrDecoder(), episode_id="id", name="any", start_ns=made.start_ns
    )
    for sample in _shifted(samples_of(made), made.topic_map, offsets):
        builder.push(sample)
    counts = ended(made).counts
    assert builder.finish(made.end_ns + 10_000_000, counts).findings == ()
