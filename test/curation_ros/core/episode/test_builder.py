from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import bag_messages
import numpy as np
import pytest
from bag_messages import to_cdr
from episodes import make_episode
from hypothesis import given
from hypothesis import strategies as st
from streams import ended, same_arrays, samples_of

from curation_ros.bags import CdrDecoder
from curation_ros.core.episode.builder import EpisodeBuilder
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.stream import Messages, Sample, SampleBlock
from curation_ros.core.episode.topic_map import TopicMap, topic_map_from_json
from curation_ros.core.errors import EpisodeError
from curation_ros.core.types import NS_PER_S

START_NS = 1_781_000_000_000_000_000
STEP_NS = 50_000_000
MAX_GAP_S = 0.25
GAP_NS = int(MAX_GAP_S * NS_PER_S)
N_STEPS = 12
PHASES = ("REACH", "GRASP")
_RAW: dict[str, Any] = {
    "max_gap_s": MAX_GAP_S,
    "fields": {
        "tip": {
            "topic": "tip",
            "type": bag_messages.POSE,
            "role": "effector",
            "values": ["pose.position.x", "pose.position.y"],
        },
        "arm": {
            "topic": "joints",
            "type": bag_messages.JOINTS,
            "role": "observation",
            "values": ["position.j1", "position.j2"],
        },
        "twist": {
            "topic": "twist",
            "type": bag_messages.TWIST,
            "role": "action",
            "values": ["twist.linear.x"],
        },
        "phase": {
            "topic": "phase",
            "type": bag_messages.STATUS,
            "role": "phase",
            "values": ["status.0.message"],
            "labels": list(PHASES),
        },
    },
}
MAP = topic_map_from_json(_RAW)
TOPICS = tuple(MAP.topics)


def _interpolating() -> TopicMap:
    arm = {**_RAW["fields"]["arm"], "interpolate": True}
    return topic_map_from_json({**_RAW, "fields": {**_RAW["fields"], "arm": arm}})


def _message(topic: str, stamp_ns: int, value: float, label: str = "REACH") -> Any:
    if topic == "tip":
        return bag_messages.pose(stamp_ns, (value, -value, 0.0))
    if topic == "joints":
        return bag_messages.joint_state(stamp_ns, {"j1": value, "j2": 10 * value})
    if topic == "twist":
        return bag_messages.twist(stamp_ns, (value, 0.0, 0.0))
    return bag_messages.status(stamp_ns, label, {"index": "0", "progress": repr(value)})


def _at(step: float) -> int:
    return START_NS + round(step * STEP_NS)


def _sample(topic: str, step: float, value: float = 0.0, seq: int = 0, **options: Any) -> Sample:
    data = to_cdr(_message(topic, _at(step), value, **options))
    return Sample(topic, _at(step), seq, data)


def _stream(
    steps: Iterable[float] = range(N_STEPS), topics: Sequence[str] = TOPICS
) -> list[Sample]:
    """A message of every topic at each step, its value the step."""
    return [_sample(t, k, float(k), n) for n, k in enumerate(steps, 1) for t in topics]


def _builder(topic_map: TopicMap = MAP) -> EpisodeBuilder:
    return EpisodeBuilder(
        topic_map, CdrDecoder(), episode_id="id", name="pick-1", start_ns=START_NS
    )


def _build(
    samples: Iterable[Sample],
    *,
    end: float = N_STEPS - 1,
    counts: dict[str, int] | None = None,
    topic_map: TopicMap = MAP,
    findings: Sequence[Finding] = (),
) -> Episode:
    builder = _builder(topic_map)
    for sample in samples:
        builder.push(sample)
    return builder.finish(_at(end), counts or {}, findings)


def _ids(episode: Episode) -> list[str]:
    return [f.id for f in episode.findings]


def _only(episode: Episode, finding_id: str) -> Finding:
    [found] = [f for f in episode.findings if f.id == finding_id]
    return found


def _steps(episode: Episode) -> list[float]:
    return [(int(s) - START_NS) / STEP_NS for s in episode.stamps_ns]


# --- a whole stream -----------------------------------------------------------------------------


def test_stream_gives_back_the_episode_that_made_it(rng: np.random.Generator) -> None:
    made = make_episode(rng)
    builder = EpisodeBuilder(
        made.topic_map, CdrDecoder(), episode_id=made.id, name=made.name, start_ns=made.start_ns
    )
    for sample in samples_of(made):
        builder.push(sample)
    built = builder.finish(made.end_ns, ended(made).counts)
    assert same_arrays(built, made)
    assert built.findings == ()
    assert list(built.fields) == list(made.topic_map.fields)


def test_equal_stamps_join_exactly() -> None:
    episode = _build(_stream())
    assert _steps(episode) == list(range(N_STEPS))
    for name in ("tip", "arm", "twist"):
        assert episode.field(name)[:, 0].tolist() == list(range(N_STEPS))
    assert episode.findings == ()


def test_empty_stream_is_an_episode_without_steps() -> None:
    episode = _build([])
    assert len(episode) == 0
    assert {k: v.shape for k, v in episode.fields.items()} == {
        "tip": (0, 2),
        "arm": (0, 2),
        "twist": (0, 1),
        "phase": (0, 1),
    }
    assert _ids(episode) == ["missing-topic"] * len(TOPICS)


def test_samples_outside_the_window_are_left_out() -> None:
    episode = _build(_stream(range(-3, N_STEPS + 3)))
    assert _steps(episode) == list(range(N_STEPS))
    assert episode.findings == ()
    assert (episode.start_ns, episode.end_ns) == (_at(0), _at(N_STEPS - 1))


def test_topic_that_is_not_in_the_map_is_refused() -> None:
    builder = _builder()
    for topic in ("episode/outcome", "phase2", ""):
        with pytest.raises(EpisodeError, match=f"id: topic '{topic}' is not in the topic map"):
            builder.push(Sample(topic, START_NS, 1, b""))


def test_findings_of_the_caller_are_kept_in_a_stable_order() -> None:
    given_findings = [Finding("recovered", "b", (0, 1)), Finding("aborted", "a", (0, 1))]
    episode = _build(_stream(), counts={"tip": 99}, findings=given_findings)
    assert _ids(episode) == ["aborted", "incomplete", "recovered"]


# --- batch and incremental ----------------------------------------------------------------------


def _awkward_stream() -> list[Sample]:
    """Every kind of trouble at once, in arrival order a topic."""
    stream = _stream([k + 0.5 for k in range(-1, 80)], ("tip",))
    stream += _stream([k * 0.8 for k in range(90)], ("joints",))
    stream += [_sample("joints", 7.2, 99.0, seq=500), _sample("joints", 8.0, 1.0, seq=0)]
    stream += [_sample("twist", 0.7 * k, float(k), k) for k in range(100) if not 30 < k < 45]
    stream.insert(100, Sample("twist", _at(20), 7, b"\x00\x01\x00\x00short"))
    stream += [_sample("phase", k, label="REACH" if k < 40 else "SULK") for k in range(75)]
    stream += [_sample("tip", 30.75, float("nan"), 99), _sample("tip", 12.25, 3.0, 100)]
    return stream


def _interleaved(stream: Sequence[Sample], turns: Sequence[str]) -> list[Sample]:
    queues = {t: iter([s for s in stream if s.topic == t]) for t in TOPICS}
    return [next(queues[t]) for t in turns]


_AWKWARD = _awkward_stream()
_COUNTS = {"tip": 81, "joints": 95, "twist": 86, "phase": 75}


@given(data=st.data())
def test_any_interleaving_and_batching_gives_the_same_episode(data: st.DataObject) -> None:
    turns = [s.topic for s in _AWKWARD]
    seed = data.draw(st.integers(0, 2**32 - 1))
    shuffled = np.random.default_rng(seed).permutation(turns).tolist()
    asked_at = data.draw(st.sets(st.integers(0, len(turns) - 1), max_size=4))
    builder = _builder()
    for k, sample in enumerate(_interleaved(_AWKWARD, shuffled)):
        builder.push(sample)
        if k in asked_at:
            builder.partial()
    built = builder.finish(_at(74), _COUNTS)
    expected = _build(_AWKWARD, end=74, counts=_COUNTS)
    assert same_arrays(built, expected)
    assert built.findings == expected.findings
    assert set(_ids(built)) == {
        "clock-back", "duplicate-stamp", "gap", "incomplete", "not-finite", "undecodable",
        "unknown-phase",
    }  # fmt: skip


def _blocks(samples: Sequence[Sample], cuts: Sequence[int]) -> list[SampleBlock]:
    """Samples of one topic in blocks that end at `cuts`."""
    edges = sorted({0, *(min(cut, len(samples)) for cut in cuts), len(samples)})
    return [
        SampleBlock(
            samples[0].topic,
            np.array([s.stamp_ns for s in part], dtype=np.int64),
            np.array([s.seq for s in part], dtype=np.int64),
            Messages.joined([s.data for s in part]),
        )
        for first, stop in itertools.pairwise(edges)
        for part in [samples[first:stop]]
    ]


@given(data=st.data())
def test_blocks_give_the_same_episode_as_their_samples(data: st.DataObject) -> None:
    queues: dict[str, list[SampleBlock | list[Sample]]] = {}
    for topic in TOPICS:
        samples = [s for s in _AWKWARD if s.topic == topic]
        cuts = data.draw(st.lists(st.integers(0, len(samples)), max_size=6))
        queues[topic] = [
            block if data.draw(st.integers(0, 3)) else _samples_of(block)
            for block in _blocks(samples, cuts)
        ]
    turns = data.draw(st.permutations([t for t, blocks in queues.items() for _ in blocks]))
    builder = _builder()
    for topic in turns:
        part = queues[topic].pop(0)
        if isinstance(part, SampleBlock):
            builder.push_block(part)
        else:
            for sample in part:
                builder.push(sample)
        if data.draw(st.integers(0, 5)) == 0:
            builder.partial()
    built = builder.finish(_at(74), _COUNTS)
    expected = _build(_AWKWARD, end=74, counts=_COUNTS)
    assert same_arrays(built, expected)
    assert built.digest == expected.digest
    assert built.findings == expected.findings


def _samples_of(block: SampleBlock) -> list[Sample]:
    numbers = zip(block.stamps_ns.tolist(), block.seqs.tolist(), strict=True)
    return [
        Sample(block.topic, stamp_ns, seq, block.messages[k])
        for k, (stamp_ns, seq) in enumerate(numbers)
    ]


def test_block_of_a_topic_that_is_not_in_the_map_is_refused() -> None:
    none = np.empty(0, dtype=np.int64)
    with pytest.raises(EpisodeError, match="topic 'episode/outcome' is not in the topic map"):
        _builder().push_block(SampleBlock("episode/outcome", none, none, Messages.joined([])))


def test_finish_may_be_asked_twice() -> None:
    builder = _builder()
    stream = _stream()
    for sample in stream[:20]:
        builder.push(sample)
    builder.finish(_at(4), {})
    for sample in stream[20:]:
        builder.push(sample)
    assert same_arrays(builder.finish(_at(N_STEPS - 1), {}), _build(stream))


def test_partial_is_the_episode_up_to_the_newest_clock_stamp() -> None:
    builder = _builder()
    stream = _stream()
    assert len(builder.partial()) == 0
    for k, sample in enumerate(stream):
        builder.push(sample)
        if k % len(TOPICS) == len(TOPICS) - 1:
            partial = builder.partial()
            step = k // len(TOPICS)
            assert partial.end_ns == _at(step)
            assert same_arrays(partial, _build(stream, end=step))


def test_partial_waits_for_actions_that_have_not_come() -> None:
    builder = _builder()
    for sample in _stream(range(5)):
        if sample.topic != "twist" or sample.stamp_ns < _at(3):
            builder.push(sample)
    assert _steps(builder.partial()) == [0, 1, 2]


# --- the join -----------------------------------------------------------------------------------


def test_observation_is_the_last_one_before_and_action_the_first_one_after() -> None:
    stream = _stream(range(N_STEPS), ("tip", "phase"))
    stream += [_sample("joints", k - 0.5, float(k)) for k in range(1, 14)]
    stream += [_sample("twist", k + 0.5, float(k)) for k in range(N_STEPS)]
    episode = _build(stream, end=N_STEPS)
    assert _steps(episode) == list(range(1, N_STEPS))
    assert episode.field("arm")[:, 0].tolist() == list(range(1, N_STEPS))
    assert episode.field("twist")[:, 0].tolist() == list(range(1, N_STEPS))


def test_action_of_the_same_stamp_is_the_answer_and_not_the_one_before() -> None:
    stream = _stream(range(N_STEPS), ("tip", "phase", "joints"))
    stream += [_sample("twist", k, 100.0 + k) for k in range(N_STEPS)]
    assert _build(stream).field("twist")[:, 0].tolist() == [100.0 + k for k in range(N_STEPS)]


@pytest.mark.parametrize(("late_ns", "valid"), [(GAP_NS - 1, True), (GAP_NS, False)])
def test_action_counts_until_just_before_max_gap(late_ns: int, valid: bool) -> None:
    stream = _stream(range(20), ("tip", "phase", "joints"))
    stream += [_sample("twist", k, 1.0) for k in range(20) if not 8 <= k < 14]
    answer_ns = _at(8) + late_ns
    stream.append(Sample("twist", answer_ns, 0, to_cdr(_message("twist", answer_ns, 2.0))))
    twist = _build(stream, end=19).field("twist")[:, 0]
    assert (twist[8] == 2.0) if valid else np.isnan(twist[8])
    assert twist[9] == 2.0


def test_steps_inside_without_an_action_are_nan_and_stay() -> None:
    stream = [
        s for s in _stream(range(30)) if s.topic != "twist" or not _at(10) <= s.stamp_ns < _at(20)
    ]
    episode = _build(stream, end=29)
    assert len(episode) == 30
    missing = np.flatnonzero(np.isnan(episode.field("twist")[:, 0])).tolist()
    assert missing == list(range(10, 16))  # closer than max_gap to 20, its command is the answer
    assert _only(episode, "gap").span == (9 * STEP_NS, 20 * STEP_NS)


def test_ends_without_a_value_are_trimmed() -> None:
    stream = _stream(range(N_STEPS), ("tip", "phase"))
    stream += _stream(range(2, N_STEPS), ("joints",))
    stream += _stream(range(N_STEPS - 3), ("twist",))
    episode = _build(stream)
    assert _steps(episode) == list(range(2, N_STEPS - 3))
    assert not np.isnan(episode.field("arm")).any()
    assert (episode.start_ns, episode.end_ns) == (_at(0), _at(N_STEPS - 1))


def test_topic_without_any_sample_trims_nothing() -> None:
    episode = _build(_stream(topics=("tip", "twist", "phase")))
    assert len(episode) == N_STEPS
    assert np.isnan(episode.field("arm")).all()
    finding = _only(episode, "missing-topic")
    assert finding == Finding(
        "missing-topic", "topic 'joints' has no sample in the episode", (0, 11 * STEP_NS)
    )


def test_topics_that_never_meet_leave_no_step() -> None:
    stream = _stream(range(4), ("tip", "phase"))
    stream += _stream(range(8, 12), ("joints",)) + _stream(range(4), ("twist",))
    assert len(_build(stream)) == 0


def test_interpolated_field_lies_between_its_samples() -> None:
    stream = _stream(range(N_STEPS), ("tip", "phase", "twist"))
    stream += [_sample("joints", 2 * k, float(2 * k)) for k in range(N_STEPS)]
    held = _build(stream).field("arm")[:, 0]
    between = _build(stream, topic_map=_interpolating()).field("arm")
    assert held.tolist() == [k - k % 2 for k in range(N_STEPS)]
    assert between[:-1, 0].tolist() == list(range(N_STEPS - 1))
    assert between[:-1, 1].tolist() == [10.0 * k for k in range(N_STEPS - 1)]
    assert between[-1, 0] == N_STEPS - 2  # after the last sample it is held


def test_order_of_joints_in_the_message_does_not_matter() -> None:
    def turned(sample: Sample, k: int) -> Sample:
        if sample.topic != "joints":
            return sample
        joints = {"j2": 10.0 * k, "other": 5.0, "j1": float(k)}
        message = bag_messages.joint_state(sample.stamp_ns, joints)
        return sample._replace(data=to_cdr(message))

    stream = _stream()
    other = [turned(s, i // len(TOPICS)) for i, s in enumerate(stream)]
    mixed = [a if i % 8 < 4 else b for i, (a, b) in enumerate(zip(stream, other, strict=True))]
    for variant in (other, mixed):
        episode = _build(variant)
        assert same_arrays(episode, _build(stream))
        assert episode.findings == ()


# --- duplicates and order -----------------------------------------------------------------------


@pytest.mark.parametrize("order", list(itertools.permutations([3, 5, 9])))
def test_of_one_stamp_the_lowest_sequence_number_is_kept(order: tuple[int, ...]) -> None:
    stream = _stream(topics=("tip", "phase", "twist"))
    for k in range(N_STEPS):
        if k != 4:
            stream.append(_sample("joints", k, float(k), k + 1))
    stream += [_sample("joints", 4, 1000.0 + seq, seq) for seq in order]
    episode = _build(stream)
    assert episode.field("arm")[4, 0] == 1003.0
    finding = _only(episode, "duplicate-stamp")
    assert finding.message == "topic 'joints': 2 stamps with differing values"
    assert finding.span == (4 * STEP_NS, 4 * STEP_NS)


def test_without_sequence_numbers_the_first_arrival_is_kept() -> None:
    stream = _stream()
    for topic in TOPICS[:3]:
        stream.append(_sample(topic, N_STEPS - 1, -1.0, seq=0))
    unnumbered = [s._replace(seq=0) for s in stream]
    episode = _build(unnumbered)
    assert episode.field("tip")[-1, 0] == N_STEPS - 1
    assert _ids(episode) == ["duplicate-stamp"] * 3


def test_same_sample_twice_is_no_finding() -> None:
    stream = _stream()
    again = [s._replace(seq=s.seq + 100) for s in stream]
    episode = _build(s for pair in zip(stream, again, strict=True) for s in pair)
    assert same_arrays(episode, _build(stream))
    assert episode.findings == ()


def test_two_nan_of_one_stamp_do_not_differ() -> None:
    stream = [*_stream(), *(_sample("tip", 11, float("nan"), k) for k in (0, 50))]
    stream = [s for s in stream if s.topic != "tip" or s.stamp_ns != _at(11) or s.seq in (0, 50)]
    assert _ids(_build(stream)) == ["not-finite"]


def test_duplicates_are_no_clock_that_went_back() -> None:
    stream = [*_stream(range(3)), _sample("tip", 2, 2.0, 50), *_stream(range(3, N_STEPS))]
    assert _build(stream).findings == ()


def test_stamps_that_went_back_are_sorted_and_found() -> None:
    stream = _stream()
    tips = [s for s in stream if s.topic == "tip"]
    swapped = [s for s in stream if s.topic != "tip"]
    swapped += [*tips[:4], tips[5], tips[4], *tips[6:8], tips[9], tips[8], *tips[10:]]
    episode = _build(swapped)
    assert same_arrays(episode, _build(stream))
    finding = _only(episode, "clock-back")
    assert finding.message == "topic 'tip': stamps went back 2 times"
    assert finding.span == (5 * STEP_NS, 5 * STEP_NS)


# --- gaps and counts ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("removed", "span"),
    [((0, 8), (0, 8)), ((10, 18), (9, 18)), ((22, 30), (21, 29))],
    ids=["begin", "middle", "end"],
)
def test_silence_is_found_wherever_it_is(removed: tuple[int, int], span: tuple[int, int]) -> None:
    stream = [s for s in _stream(range(30)) if not _at(removed[0]) <= s.stamp_ns < _at(removed[1])]
    episode = _build(stream, end=29)
    gaps = [f for f in episode.findings if f.id == "gap"]
    assert len(gaps) == len(TOPICS)
    for gap in gaps:
        assert gap.span == (span[0] * STEP_NS, span[1] * STEP_NS)


def test_worst_gap_stands_for_all_of_a_topic() -> None:
    kept = [k for k in range(60) if not (10 <= k < 16 or 30 <= k < 40)]
    stream = _stream(range(60), ("tip", "phase", "twist")) + _stream(kept, ("joints",))
    gap = _only(_build(stream, end=59), "gap")
    assert gap.span == (29 * STEP_NS, 40 * STEP_NS)
    assert gap.message == "topic 'joints': silent for 0.550 s from 1.450 s (2 gaps above 0.25 s)"


def test_silence_of_exactly_max_gap_is_none() -> None:
    steps = range(0, 31, 5)
    assert _build(_stream(steps), end=30).findings == ()
    beyond = [s._replace(stamp_ns=s.stamp_ns + (s.stamp_ns > _at(12))) for s in _stream(steps)]
    assert _ids(_build(beyond, end=31)) == ["gap"] * len(TOPICS)


def test_fewer_samples_than_counted_are_incomplete() -> None:
    stream = [s for s in _stream() if s.topic != "twist" or s.stamp_ns not in (_at(3), _at(4))]
    episode = _build(stream, counts=dict.fromkeys(TOPICS, N_STEPS))
    finding = _only(episode, "incomplete")
    assert finding.message == "topic 'twist': 10 of 12 samples"
    assert finding.span == (0, 11 * STEP_NS)
    assert "incomplete" not in _ids(_build(stream, counts={"twist": 10}))


def test_duplicates_do_not_make_up_for_what_is_lost() -> None:
    stream = [s for s in _stream() if s.topic != "twist" or s.stamp_ns != _at(3)]
    stream.append(_sample("twist", N_STEPS - 1, N_STEPS - 1.0, 77))
    assert _ids(_build(stream, counts={"twist": N_STEPS})) == ["incomplete"]


def test_more_samples_than_counted_are_fine() -> None:
    assert _build(_stream(), counts=dict.fromkeys(TOPICS, 3)).findings == ()


# --- values -------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_value_that_is_not_finite_is_kept_and_found(value: float) -> None:
    stream = [
        _sample("tip", 5, value, s.seq) if (s.topic, s.stamp_ns) == ("tip", _at(5)) else s
        for s in _stream()
    ]
    episode = _build(stream)
    np.testing.assert_array_equal(episode.field("tip")[5], [value, -value])
    finding = _only(episode, "not-finite")
    assert finding.message == "topic 'tip': 1 samples with NaN or infinite values"
    assert finding.span == (5 * STEP_NS, 5 * STEP_NS)


def test_phase_is_the_index_of_its_name() -> None:
    stream = _stream(topics=("tip", "joints", "twist"))
    stream += [_sample("phase", k, label=PHASES[k >= 6]) for k in range(N_STEPS)]
    assert _build(stream).field("phase")[:, 0].tolist() == [0.0] * 6 + [1.0] * 6


def test_unknown_phase_is_minus_one_and_found_by_name() -> None:
    stream = _stream(topics=("tip", "joints", "twist"))
    labels = ["REACH"] * 5 + ["SULK", "reach"] + ["GRASP"] * 5
    stream += [_sample("phase", k, label=label) for k, label in enumerate(labels)]
    episode = _build(stream)
    assert episode.field("phase")[4:8, 0].tolist() == [0.0, -1.0, -1.0, 1.0]
    found = {f.message: f.span for f in episode.findings}
    assert found == {
        "topic 'phase': phase 'SULK' is not in the topic map": (5 * STEP_NS, 5 * STEP_NS),
        "topic 'phase': phase 'reach' is not in the topic map": (6 * STEP_NS, 6 * STEP_NS),
    }


def test_unknown_phase_is_found_although_it_came_first_outside_the_window() -> None:
    stream = _stream(topics=("tip", "joints", "twist"))
    phases = [_sample("phase", k, label="SULK" if k == 4 else "REACH") for k in range(N_STEPS)]
    outside = _sample("phase", N_STEPS + 5, label="SULK")
    assert _only(_build([*stream, outside, *phases]), "unknown-phase").span[0] == 4 * STEP_NS
    only_outside = [s for s in phases if s.stamp_ns != _at(4)]
    assert "unknown-phase" not in _ids(_build([*stream, outside, *only_outside]))


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _foreign(data: bytes) -> bytes:
    return b"\xff\xff" + data[2:]


def _without_joint(data: bytes) -> bytes:
    return data.replace(b"j1\x00", b"jx\x00")


@pytest.mark.parametrize("spoil", [_cut, _foreign, _without_joint])
@pytest.mark.parametrize("n_steps", [12, 200])  # one batch and several
def test_undecodable_message_costs_none_of_its_neighbours(
    spoil: Callable[[bytes], bytes], n_steps: int
) -> None:
    stream = [
        s._replace(data=spoil(s.data)) if (s.topic, s.stamp_ns) == ("joints", _at(7)) else s
        for s in _stream(range(n_steps))
    ]
    episode = _build(stream, end=n_steps - 1, counts=dict.fromkeys(TOPICS, n_steps))
    assert len(episode) == n_steps
    assert episode.field("arm")[:, 0].tolist() == [
        6.0 if k == 7 else float(k) for k in range(n_steps)
    ]
    assert _ids(episode) == ["incomplete", "undecodable"]
    finding = _only(episode, "undecodable")
    assert finding.message.startswith("topic 'joints': 1 undecodable messages, first: ")
    assert finding.span == (7 * STEP_NS, 7 * STEP_NS)


def test_topic_with_nothing_but_undecodable_messages_is_missing() -> None:
    stream = [s._replace(data=b"") if s.topic == "joints" else s for s in _stream()]
    assert _ids(_build(stream)) == ["missing-topic", "undecodable"]


def test_undecodable_message_outside_the_window_is_no_finding() -> None:
    stream = [*_stream(), Sample("tip", _at(N_STEPS + 1), 99, b"")]
    assert _build(stream).findings == ()
