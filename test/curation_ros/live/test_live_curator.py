from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import bag_messages
import numpy as np
import pytest
from decided import decide_on
from episodes import make_episode, make_reference, topic_map
from streams import ended, feed, make_recording, record, samples_of, started

from curation_ros.bags import CdrDecoder
from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.dataset.manifests import save_selection
from curation_ros.live.curator import Decided, LiveCuration, log_decision, override

DRAIN_S = 3.0
#: A scorer of each kind; the others take seconds to fit and are tested on their own.
SCORERS = ("gripper_timing", "smoothness", "knn", "length")


@functools.cache
def _fitted() -> Curation:
    return Curation.fit(
        CurationSettings(scorers=SCORERS), make_reference(np.random.default_rng(7))
    )


@functools.cache
def _good() -> Episode:
    return make_episode(np.random.default_rng(1), name="good")


@functools.cache
def _early() -> Episode:
    """The object is let go in mid-air."""
    return make_episode(np.random.default_rng(2), open_at=140, name="early")


@functools.cache
def _stream_of(name: str) -> tuple[Sample, ...]:
    return tuple(samples_of({"good": _good, "early": _early}[name]()))


def _curator(dataset: Dataset, curation: Curation | None = None) -> LiveCuration:
    return LiveCuration(
        dataset, topic_map(), CdrDecoder(), curation or _fitted(), drain_timeout_s=DRAIN_S
    )


def _watch(
    live: LiveCuration,
    episode: Episode,
    samples: Iterable[Sample],
    end: EpisodeEvent | None = None,
    source: str = "live",
) -> list[Decided]:
    """Play an episode to a curator, and let its patience run out."""
    decided = live.event(started(episode, source=source), 0.0)
    for sample in samples:
        decided += live.sample(sample, 0.0)
    decided += live.event(end or ended(episode, source=source), 0.0)
    return decided + live.tick(DRAIN_S)


def _interleaved(samples: Sequence[Sample], seed: int) -> list[Sample]:
    """The same stream as another subscriber may receive it: in order within a topic only."""
    queues: dict[str, list[Sample]] = {}
    for sample in samples:
        queues.setdefault(sample.topic, []).append(sample)
    waiting = {topic: iter(queue) for topic, queue in queues.items()}
    turns = np.random.default_rng(seed).permutation([s.topic for s in samples])
    return [next(waiting[topic]) for topic in turns]


def _told(decided: list[Decided]) -> Decision:
    """The one decision on a bag."""
    [one] = decided
    assert one.latency_s is None
    return one.decision


def _offline(dataset: Dataset, episode: Episode) -> Decision:
    return decide_on(_fitted(), read_episode(dataset.bag_path(episode.id)))


def _stripped(decision: Decision) -> Decision:
    """A decision without what only its log knows."""
    evidence = {k: v for k, v in decision.evidence.items() if k != "bag"}
    return replace(decision, revision=1, evidence=evidence)


# --- live and on disk ---------------------------------------------------------------------------


def _whole(samples: list[Sample]) -> list[Sample]:
    return samples


def _lossy(samples: list[Sample]) -> list[Sample]:
    return [s for s in samples if not (s.topic == "joint_states" and 50 < s.seq < 60)]


def _silent(samples: list[Sample]) -> list[Sample]:
    return [s for s in samples if s.topic != "objects/plate_1/pose"]


def _repeated(samples: list[Sample]) -> list[Sample]:
    again = [s._replace(seq=s.seq + 1000) for s in samples if s.seq == 240]
    return [*samples, *again]


def _contradicting(samples: list[Sample]) -> list[Sample]:
    last = next(s for s in samples if s.topic == "command/twist" and s.seq == 240)
    other = bag_messages.twist(last.stamp_ns, (0.5, 0.5, 0.5))
    return [*samples, last._replace(seq=999, data=bag_messages.to_cdr(other))]


def _undecodable(samples: list[Sample]) -> list[Sample]:
    return [
        s._replace(data=s.data[:40]) if (s.topic, s.seq) == ("eef_pose", 77) else s
        for s in samples
    ]


@pytest.mark.parametrize("name", ["good", "early"])
@pytest.mark.parametrize(
    "spoil", [_whole, _lossy, _silent, _repeated, _contradicting, _undecodable]
)
def test_live_decision_equals_that_on_the_bag_to_the_last_bit(
    dataset: Dataset, name: str, spoil: Any
) -> None:
    episode = {"good": _good, "early": _early}[name]()
    samples = spoil(list(_stream_of(name)))
    live = _curator(dataset)
    [decided] = _watch(live, episode, _interleaved(samples, 1))
    record(dataset, episode, samples=_interleaved(samples, 2))
    assert live.bag_closed(episode.id) == []
    [first, amended] = dataset.decisions(episode.id)
    assert first == decided.decision
    assert amended == replace(first, evidence={**first.evidence, "bag": "equal"})
    offline = _offline(dataset, episode)
    assert _stripped(amended) == offline
    for scorer, score in offline.scores.items():
        found = decided.decision.scores[scorer]
        assert (found is None) == (score is None)
        assert found is None or score is None or found.hex() == score.hex()


def test_decision_is_what_the_episode_deserves(dataset: Dataset) -> None:
    live = _curator(dataset)
    [good] = _watch(live, _good(), _stream_of("good"))
    [early] = _watch(live, _early(), _stream_of("early"))
    assert (good.decision.verdict, good.decision.findings) == ("keep", ())
    assert early.decision.verdict == "discard"
    assert [f.id for f in early.decision.findings] == ["object-lost", "opened-early"]
    assert good.latency_s is not None
    assert good.latency_s > 0
    assert good.decision.scores["length"] == -240.0


def test_decision_is_on_disk_when_it_is_given(dataset: Dataset) -> None:
    [decided] = _watch(_curator(dataset), _good(), _stream_of("good"))
    [line] = dataset.decision_log(_good().id).read_text().splitlines()
    assert Decision.from_json(json.loads(line)) == decided.decision
    assert (decided.decision.revision, decided.decision.by) == (1, CURATOR)
    assert decided.decision.state_hash == _fitted().rule.state_hash


def test_decision_comes_with_the_last_message_and_not_before(dataset: Dataset) -> None:
    live = _curator(dataset)
    *most, last = _stream_of("good")
    live.event(started(_good()), 0.0)
    for sample in most:
        assert live.sample(sample, 0.0) == []
    assert live.event(ended(_good()), 0.0) == []
    assert live.tick(DRAIN_S - 0.01) == []
    [decided] = live.sample(last, DRAIN_S - 0.01)
    assert decided.decision.verdict == "keep"
    assert live.tick(1e9) == []


def test_samples_before_started_are_part_of_the_episode(dataset: Dataset) -> None:
    live = _curator(dataset)
    samples = _stream_of("good")
    for sample in samples[:21]:
        live.sample(sample, 0.0)
    [decided] = _watch(live, _good(), samples[21:])
    assert decided.decision.findings == ()


def test_without_a_reference_everything_is_for_review(dataset: Dataset) -> None:
    live = _curator(dataset, Curation.fit(CurationSettings(scorers=SCORERS)))
    [decided] = _watch(live, _good(), _stream_of("good"))
    assert (decided.decision.verdict, decided.decision.reason) == ("review", "no reference")
    assert decided.decision.scores["knn"] is None
    assert decided.decision.scores["gripper_timing"] == 237 / 240


def test_aborted_episode_is_for_review_and_ends_with_its_clock(dataset: Dataset) -> None:
    end = ended(_good(), event="aborted", end_ns=None, counts={}, reason="no command for 5 s")
    samples = _stream_of("good")[:700]
    live = _curator(dataset)
    [decided] = _watch(live, _good(), samples, end)
    assert decided.decision.verdict == "review"
    assert decided.decision.reason == "aborted: no command for 5 s"
    feed(make_recording(dataset), _good(), samples, end)
    assert live.bag_closed(_good().id) == []
    assert _stripped(dataset.decisions(_good().id)[-1]) == _offline(dataset, _good())


def test_episodes_that_overlap_in_time_of_arrival_are_kept_apart(dataset: Dataset) -> None:
    first = _good()
    second = make_episode(np.random.default_rng(3), start_ns=first.end_ns + 1, name="next")
    live = _curator(dataset)
    samples = list(_stream_of("good"))
    live.event(started(first), 0.0)
    late = [s for s in samples if s.topic == "phase"][-3:]
    for sample in samples:
        if sample not in late:
            live.sample(sample, 0.0)
    decided = live.event(ended(first), 0.0) + live.event(started(second), 0.0)
    for sample in sorted([*late, *samples_of(second)], key=lambda s: s.topic):
        decided += live.sample(sample, 0.0)
    decided += live.event(ended(second), 0.0)
    assert {d.decision.name: d.decision.verdict for d in decided} == {
        "good": "keep",
        "next": "keep",
    }
    assert all(d.decision.findings == () for d in decided)


# --- where they differ --------------------------------------------------------------------------


def test_bag_wins_where_the_curator_missed_something(dataset: Dataset) -> None:
    samples = list(_stream_of("good"))
    live = _curator(dataset)
    [decided] = _watch(live, _good(), _lossy(samples))
    assert decided.decision.verdict == "review"
    assert {f.id for f in decided.decision.findings} == {"gap", "incomplete"}
    record(dataset, _good(), samples=samples)
    second = _told(live.bag_closed(_good().id))
    assert (second.revision, second.verdict, second.evidence["bag"]) == (2, "keep", "differs")
    assert _stripped(second) == _offline(dataset, _good())
    assert dataset.latest_decisions()[_good().id] == second


def test_bag_wins_where_the_recorder_missed_something(dataset: Dataset) -> None:
    samples = list(_stream_of("good"))
    live = _curator(dataset)
    [decided] = _watch(live, _good(), samples)
    assert decided.decision.verdict == "keep"
    record(dataset, _good(), samples=_lossy(samples))
    second = _told(live.bag_closed(_good().id))
    assert (second.revision, second.verdict) == (2, "review")
    assert dataset.latest_decisions()[_good().id] == second


def test_what_came_too_late_for_the_curator_is_in_revision_2(dataset: Dataset) -> None:
    *most, last = _stream_of("good")
    live = _curator(dataset)
    [decided] = _watch(live, _good(), most)
    assert [f.id for f in decided.decision.findings] == ["incomplete"]
    assert live.sample(last, DRAIN_S + 1) == []
    record(dataset, _good(), samples=[*most, last])
    second = _told(live.bag_closed(_good().id))
    assert (second.revision, second.findings) == (2, ())


def test_difference_that_changes_no_verdict_is_on_record(dataset: Dataset) -> None:
    samples = list(_stream_of("good"))
    elsewhere = bag_messages.pose(samples[3].stamp_ns, (9.0, 9.0, 9.0))
    assert samples[3].topic == "objects/plate_1/pose"  # no column of the state
    moved = samples.copy()
    moved[3] = samples[3]._replace(data=bag_messages.to_cdr(elsewhere))
    live = _curator(dataset)
    [decided] = _watch(live, _good(), moved)
    record(dataset, _good(), samples=samples)
    assert len(live.bag_closed(_good().id)) == 1
    found = dataset.latest_decisions()[_good().id]
    # What was seen differs, and so does its digest.
    assert found.evidence["content"] != decided.decision.evidence["content"]
    same = {**found.evidence, "content": decided.decision.evidence["content"]}
    assert _stripped(replace(found, evidence=same)) == decided.decision
    assert found.evidence["bag"] == "differs"


def test_loss_that_only_the_recorder_knows_of_is_in_revision_2(dataset: Dataset) -> None:
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    feed(make_recording(dataset, publishers=lambda _topic: 2), _good(), _stream_of("good"))
    second = _told(live.bag_closed(_good().id))
    assert second.revision == 2
    assert {f.id for f in second.findings} == {"unknown-loss"}
    assert second.verdict == "keep"


@pytest.mark.parametrize("spoil", ["missing", "empty", "torn", "no map"])
def test_live_decision_stands_where_the_bag_cannot_be_read(dataset: Dataset, spoil: str) -> None:
    live = _curator(dataset)
    [decided] = _watch(live, _good(), _stream_of("good"))
    path = dataset.bag_path(_good().id)
    if spoil != "missing":
        record(dataset, _good(), samples=_stream_of("good"))
        [mcap] = path.glob("*.mcap")
        raw = mcap.read_bytes()
        mcap.write_bytes({"empty": b"", "torn": raw[: len(raw) // 2]}.get(spoil, b"no mcap"))
    assert live.bag_closed(_good().id) == []
    found = dataset.latest_decisions()[_good().id]
    assert (found.revision, found.verdict) == (1, "keep")
    assert found.evidence["bag"].startswith("not seen: ")
    assert str(path) in found.evidence["bag"]
    assert _stripped(found) == decided.decision


def test_bag_without_anything_seen_live_is_scored_alone(dataset: Dataset) -> None:
    record(dataset, _good(), samples=_stream_of("good"))
    decision = _told(_curator(dataset).bag_closed(_good().id))
    assert (decision.revision, decision.evidence["bag"]) == (1, "alone")
    assert _stripped(decision) == _offline(dataset, _good())


def test_bag_that_closes_before_our_gate_is_read_when_that_closes(dataset: Dataset) -> None:
    *most, last = _stream_of("good")
    record(dataset, _good(), samples=_stream_of("good"))
    live = _curator(dataset)
    live.event(started(_good()), 0.0)
    for sample in most:
        live.sample(sample, 0.0)
    live.event(ended(_good()), 0.0)
    assert live.bag_closed(_good().id) == []
    assert live.tick(DRAIN_S - 1) == []
    [decided] = live.sample(last, DRAIN_S - 1)
    assert dataset.latest_decisions()[_good().id].evidence["bag"] == "equal"
    assert decided.decision.verdict == "keep"


def test_bag_that_closes_before_our_gate_wins_over_what_we_missed(dataset: Dataset) -> None:
    *most, _ = _stream_of("good")
    record(dataset, _good(), samples=_stream_of("good"))
    live = _curator(dataset)
    live.event(started(_good()), 0.0)
    for sample in most:
        live.sample(sample, 0.0)
    live.event(ended(_good()), 0.0)
    assert live.bag_closed(_good().id) == []
    first, second = live.tick(DRAIN_S)
    assert (first.decision.verdict, second.decision.verdict) == ("review", "keep")
    assert second.decision.evidence["bag"] == "differs"
    assert dataset.latest_decisions()[_good().id] == second.decision


def test_bag_of_a_recorder_that_was_stopped_has_the_say(dataset: Dataset) -> None:
    live = _curator(dataset)
    live.event(started(_good()), 0.0)
    recording = make_recording(dataset)
    recording.event(started(_good()), 0.0)
    for sample in _stream_of("good")[:700]:
        live.sample(sample, 0.0)
        recording.sample(sample, 0.0)
    recording.abort("the recorder was stopped")
    decision = _told(live.bag_closed(_good().id))
    assert (decision.verdict, decision.revision) == ("review", 1)
    assert live.event(ended(_good()), 0.0) + live.tick(DRAIN_S) == []
    assert dataset.latest_decisions()[_good().id] == decision


# --- who comes late, and who plays again --------------------------------------------------------


def test_curator_that_starts_again_does_not_decide_on_what_it_has_not_seen(
    dataset: Dataset,
) -> None:
    first = _curator(dataset)
    _watch(first, _good(), _stream_of("good"))
    record(dataset, _good(), samples=_stream_of("good"))
    first.bag_closed(_good().id)
    before = dataset.decision_log(_good().id).read_bytes()
    again = _curator(dataset)
    assert again.event(started(_good()), 0.0) == []  # latched, as is what follows
    assert again.event(ended(_good()), 0.0) == []
    assert again.bag_closed(_good().id) == []
    told = _told(again.tick(DRAIN_S))  # who listens to us hears the decision again
    assert (told.revision, told.verdict) == (1, "keep")
    assert dataset.latest_decisions()[_good().id] == told
    assert told.evidence["bag"] == "equal"
    assert dataset.decision_log(_good().id).read_bytes() == before


def test_curator_that_comes_in_mid_episode_says_what_is_missing(dataset: Dataset) -> None:
    [decided] = _watch(_curator(dataset), _good(), _stream_of("good")[700:])
    assert decided.decision.verdict == "review"
    assert {f.id for f in decided.decision.findings} == {"clipped-start", "gap", "incomplete"}


def test_replay_gives_the_same_decision_and_no_second_line(dataset: Dataset) -> None:
    live = _curator(dataset)
    [first] = _watch(live, _good(), _stream_of("good"))
    for curator in (live, _curator(dataset), live):
        samples = _interleaved(_stream_of("good"), 5)
        [second] = _watch(curator, _good(), samples, source="replay")
        assert second.decision == first.decision
    assert len(dataset.decisions(_good().id)) == 1


def test_replayed_episodes_may_lie_at_the_same_time(dataset: Dataset) -> None:
    live = _curator(dataset)
    assert (_good().start_ns, len(_good())) == (_early().start_ns, len(_early()))
    failed = ["object-lost", "opened-early"]
    for name, verdict, found in (("good", "keep", []), ("early", "discard", failed)) * 2:
        episode = {"good": _good, "early": _early}[name]()
        [decided] = _watch(live, episode, _stream_of(name), source="replay")
        assert decided.decision.verdict == verdict
        assert [f.id for f in decided.decision.findings] == found


def test_replay_under_another_state_is_a_new_revision(dataset: Dataset) -> None:
    _watch(_curator(dataset), _good(), _stream_of("good"))
    other = Curation.fit(
        CurationSettings(scorers=SCORERS, length="none"), make_reference(np.random.default_rng(7))
    )
    [second] = _watch(_curator(dataset, other), _good(), _stream_of("good"), source="replay")
    assert second.decision.revision == 2
    assert second.decision.state_hash == other.rule.state_hash != _fitted().rule.state_hash


def test_empty_replay_is_answered(dataset: Dataset) -> None:
    end = ended(_good(), event="aborted", source="replay", reason="at once")
    [decided] = _watch(_curator(dataset), _good(), [], end, source="replay")
    assert decided.decision.verdict == "review"


# --- people -------------------------------------------------------------------------------------


def test_person_outranks_whatever_the_curator_decides_later(dataset: Dataset) -> None:
    samples = list(_stream_of("good"))
    live = _curator(dataset)
    _watch(live, _good(), _lossy(samples))
    person = live.override("good", "discard", "the cup was chipped", "Ada")
    assert (person.revision, person.verdict, person.by) == (2, "discard", "Ada")
    assert person.reason == "Ada: the cup was chipped"
    record(dataset, _good(), samples=samples)
    assert _told(live.bag_closed(_good().id)) == person
    assert dataset.latest_decisions()[_good().id] == person
    assert [(d.revision, d.by) for d in dataset.decisions(_good().id)] == [
        (1, CURATOR),
        (2, "Ada"),
        (3, CURATOR),
    ]
    assert dataset.decisions(_good().id)[-1].scores == _offline(dataset, _good()).scores


def test_last_of_several_persons_counts(dataset: Dataset) -> None:
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    live.override(_good().id[:8], "discard", "", "Ada")
    last = live.override(_good().id, "keep", "", "Bob")
    assert (last.reason, last.revision) == ("Bob decided", 3)
    assert dataset.latest_decisions()[_good().id] == last


def test_person_may_decide_on_a_bag_that_nobody_has_scored(dataset: Dataset) -> None:
    record(dataset, _good(), samples=_stream_of("good"))
    decision = override(dataset, "good", "keep", "I saw it", "Ada", state_hash="")
    assert (decision.revision, decision.scores) == (1, {})
    assert decision.span == (0, _good().end_ns - _good().start_ns)
    told = _told(_curator(dataset).bag_closed(_good().id))
    assert (told.verdict, told.by) == ("keep", "Ada")


@pytest.mark.parametrize(
    ("prefix", "verdict", "by", "said"),
    [
        ("nobody", "keep", "Ada", "no episode has the id or name 'nobody'"),
        ("", "keep", "Ada", "no episode has the id or name ''"),
        ("good", "salvage", "Ada", "until when is not said"),
        ("good", "", "Ada", "expected keep, salvage, discard, review"),
        ("good", "keep", "curator", "is no person"),
        ("good", "keep", "", "is no person"),
    ],
)
def test_override_that_makes_no_sense_is_refused_and_not_logged(
    dataset: Dataset, prefix: str, verdict: str, by: str, said: str
) -> None:
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    with pytest.raises(EpisodeError, match=said):
        live.override(prefix, verdict, "", by)
    assert len(dataset.decisions(_good().id)) == 1


def test_person_salvages_the_beginning_of_what_the_curator_kept(dataset: Dataset) -> None:
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    whole = (0, _good().end_ns - _good().start_ns)
    cut = override(dataset, "good", "salvage", "it shook", "Ada", "", until_s=4.15)
    assert (cut.verdict, cut.by, cut.span) == ("salvage", "Ada", (0, 4_150_000_000))
    assert cut.reason == f"Ada: it shook; kept until 4.15 s of {whole[1] / 1e9:.2f} s"
    # A later cut may reach further than an earlier one, and to keep is to keep all of it.
    later = override(dataset, "good", "salvage", "", "Ada", "", until_s=6.0)
    assert later.span == (0, 6_000_000_000)
    assert live.override("good", "keep", "", "Ada").span == whole
    with pytest.raises(EpisodeError, match="only what is salvaged is kept until then"):
        override(dataset, "good", "keep", "", "Ada", "", until_s=2.0)
    assert len(dataset.decisions(_good().id)) == 4


def test_override_of_what_two_episodes_are_called_is_refused(dataset: Dataset) -> None:
    twin = replace(_early(), name="good")
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    _watch(live, twin, _stream_of("early"))
    with pytest.raises(EpisodeError, match="means 2 episodes"):
        live.override("good", "keep", "", "Ada")
    assert live.override(twin.id, "keep", "", "Ada").episode == twin.id


def test_repeated_decision_is_logged_once_and_its_evidence_is_added(dataset: Dataset) -> None:
    decision = decide_on(_fitted(), _good())
    log_decision(dataset, decision)
    log_decision(dataset, decision)
    assert len(dataset.decisions(_good().id)) == 1
    changed = log_decision(dataset, replace(decision, verdict="review", reason="another"))
    assert changed.revision == 2
    same = replace(decision, verdict="review", reason="another", evidence={"bag": "alone"})
    assert log_decision(dataset, same).evidence["bag"] == "alone"
    assert [d.revision for d in dataset.decisions(_good().id)] == [1, 2, 2]


def test_decision_that_several_make_at_once_is_logged_once(dataset: Dataset) -> None:
    decision = decide_on(_fitted(), _good())
    with ThreadPoolExecutor(8) as pool:
        told = list(pool.map(lambda _: log_decision(dataset, decision), range(16)))
    assert dataset.decisions(_good().id) == [decision]
    assert told == [decision] * 16


def test_evidence_added_after_a_person_decided_takes_nobodys_number(dataset: Dataset) -> None:
    decision = decide_on(_fitted(), _good())
    log_decision(dataset, decision)
    person = override(dataset, "good", "discard", "", "Ada", state_hash="")
    told = log_decision(dataset, replace(decision, evidence={"bag": "alone"}))
    assert told == person
    assert dataset.latest_decisions()[_good().id] == person
    logged = dataset.decisions(person.episode)
    assert {d.revision: d.by for d in logged} == {1: CURATOR, 2: "Ada"}


def test_log_that_cannot_be_written_is_an_error_and_the_next_episode_is_decided(
    dataset: Dataset,
) -> None:
    live = _curator(dataset)
    (dataset.path / "decisions").write_text("in the way")
    with pytest.raises(CurationError, match="decisions"):
        _watch(live, _good(), _stream_of("good"))
    (dataset.path / "decisions").unlink()
    [decided] = _watch(live, _early(), _stream_of("early"))
    assert decided.decision.verdict == "discard"


# --- labels -------------------------------------------------------------------------------------


def _pipeline(folder: Path, *, flipped: bool) -> tuple[list[Decision], dict[str, Any]]:
    """Record, decide and select, beside labels that say one thing or its opposite."""
    dataset = Dataset(folder, create=True)
    live = _curator(dataset)
    for k, (episode, name) in enumerate(((_good(), "good"), (_early(), "early"))):
        is_bad = (name == "early") != flipped
        dataset.append_truth(
            {
                "episode": episode.id,
                "start": f"official-{k:02d}",
                "repetition": 0,
                "outcome": "failed" if is_bad else "succeeded",
                "defect": "early_release" if is_bad else "none",
                "contaminated": is_bad,
            }
        )
        _watch(live, episode, _stream_of(name))
        record(dataset, episode, samples=_stream_of(name))
        live.bag_closed(episode.id)
        dataset.append_truth({"episode": episode.id, "button": "discard" if is_bad else "keep"})
    dataset.rebuild()
    manifests = {}
    for rule, value, scorer in (
        ("decisions", None, ""),
        ("top-k", 1.0, "gripper_timing"),
        ("top-fraction", 0.5, "length"),
        ("all", None, ""),
    ):
        manifest, _ = save_selection(dataset, rule=rule, value=value, scorer=scorer)
        manifests[rule] = (manifest.entries, manifest.abstained, manifest.state_hash)
    found = [d for e in (_good(), _early()) for d in dataset.decisions(e.id)]
    return found, manifests


def test_flipping_every_label_changes_no_score_no_decision_and_no_selection(
    tmp_path: Path,
) -> None:
    assert _pipeline(tmp_path / "a", flipped=False) == _pipeline(tmp_path / "b", flipped=True)
    truths = [Dataset(tmp_path / k).truth() for k in "ab"]
    assert truths[0][_good().id]["outcome"] != truths[1][_good().id]["outcome"]


def test_removing_the_labels_changes_no_decision(dataset: Dataset) -> None:
    dataset.append_truth({"episode": _good().id, "outcome": "failed"})
    record(dataset, _good(), samples=_stream_of("good"))
    before = _curator(dataset).bag_closed(_good().id)
    (dataset.path / "truth.jsonl").unlink()
    shutil.rmtree(dataset.path / "decisions")
    assert _curator(dataset).bag_closed(_good().id) == before


# --- rules over the dataset ---------------------------------------------------------------------


def _share(share: float = 0.5) -> Curation:
    options: dict[str, Any] = {"rule_scorer": "length", "rule_params": {"value": share}}
    reference = make_reference(np.random.default_rng(7))
    return Curation.fit(
        CurationSettings(scorers=SCORERS, rule="top-fraction", **options), reference
    )


def _episodes(n: int, first: int = 100) -> list[Episode]:
    """Each is a little shorter than the one before."""
    options = [{"n_steps": 260 - 5 * k, "name": f"pick-{k}"} for k in range(n)]
    return [
        make_episode(
            np.random.default_rng(first + k),
            episode_id=f"00000000-0000-7000-8000-{k:012d}",
            **o,  # type: ignore[arg-type]
        )
        for k, o in enumerate(options)
    ]


def test_rule_over_the_dataset_is_provisional_live_and_says_what_it_has_seen(
    dataset: Dataset,
) -> None:
    live = _curator(dataset, _share())
    told = [_watch(live, e, samples_of(e))[0].decision for e in _episodes(6)]
    assert [d.verdict for d in told[:3]] == ["review"] * 3
    assert told[2].reason == "the rule needs 4 scored episodes; there are 3"
    # Each is better than all before it, so each is among the best half when it comes.
    assert [d.verdict for d in told[3:]] == ["keep"] * 3
    assert [d.evidence["basis"] for d in told] == ["provisional"] * 6
    assert [d.evidence["fitted_on"]["episodes"] for d in told] == [1, 2, 3, 4, 5, 6]
    assert len({d.state_hash for d in told}) == 6
    assert len({d.evidence["scoring"] for d in told}) == 1


def test_curator_that_starts_again_goes_on_with_what_was_scored(dataset: Dataset) -> None:
    episodes = _episodes(5)
    for episode in episodes[:4]:
        _watch(_curator(dataset, _share()), episode, samples_of(episode))
    [decided] = _watch(_curator(dataset, _share()), episodes[4], samples_of(episodes[4]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 5
    other = Curation.fit(
        CurationSettings(scorers=SCORERS, rule="top-fraction")
    )  # has another hash
    [decided] = _watch(_curator(dataset, other), episodes[0], samples_of(episodes[0]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1


def test_final_decisions_are_over_the_whole_dataset_whatever_came_first(dataset: Dataset) -> None:
    live = _curator(dataset, _share())
    episodes = _episodes(6)
    for episode in episodes:
        _watch(live, episode, samples_of(episode))
        record(dataset, episode)
        live.bag_closed(episode.id)
    new = live.finish()
    decided = dataset.latest_decisions()
    assert [decided[e.id].verdict for e in episodes] == ["discard"] * 3 + ["keep"] * 3
    assert {d.evidence["basis"] for d in decided.values()} == {"final"}
    assert {d.evidence["fitted_on"]["episodes"] for d in decided.values()} == {6}
    assert len({d.state_hash for d in decided.values()}) == 1
    assert {d.episode for d in new} == {e.id for e in episodes}
    assert live.finish() == []  # nothing new
    manifest, _ = save_selection(dataset, rule="decisions")
    assert {e.episode for e in manifest.entries} == {e.id for e in episodes[3:]}


def test_episode_whose_bag_has_a_fault_counts_no_more(dataset: Dataset) -> None:
    live = _curator(dataset, _share())
    first, *rest = _episodes(6)
    samples = samples_of(first)
    [decided] = _watch(live, first, samples)
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1
    record(dataset, first, samples=[s for s in samples if not 50 < s.seq < 90])
    assert _told(live.bag_closed(first.id)).evidence["fitted_on"]["episodes"] == 0
    [decided] = _watch(live, rest[0], samples_of(rest[0]))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 1


def test_after_a_final_decision_the_next_episode_is_one_more(dataset: Dataset) -> None:
    options: dict[str, Any] = {"rule": "top-fraction", "rule_scorer": "knn_label_free"}
    live = _curator(
        dataset, Curation.fit(CurationSettings(scorers=("knn_label_free", "length"), **options))
    )
    *episodes, last = _episodes(7)
    for episode in episodes:
        [decided] = _watch(live, episode, samples_of(episode))
        assert "compares with the whole dataset" in decided.decision.reason
        record(dataset, episode)
        live.bag_closed(episode.id)
    live.finish()
    [decided] = _watch(live, last, samples_of(last))
    assert decided.decision.evidence["fitted_on"]["episodes"] == 7
    assert decided.decision.evidence["basis"] == "provisional"


def test_curator_that_starts_again_leaves_a_final_decision_as_it_is(dataset: Dataset) -> None:
    live = _curator(dataset, _share())
    episodes = _episodes(6)
    for episode in episodes:
        _watch(live, episode, samples_of(episode))
        record(dataset, episode)
        live.bag_closed(episode.id)
    live.finish()
    final = dataset.latest_decisions()
    [told] = _curator(dataset, _share()).bag_closed(episodes[0].id)
    assert told.decision == final[episodes[0].id]
    assert dataset.latest_decisions() == final


def test_finishing_waits_for_the_running_episode(dataset: Dataset) -> None:
    live = _curator(dataset, _share())
    live.event(started(_good()), 0.0)
    with pytest.raises(EpisodeError, match="an episode is running"):
        live.finish()


def test_final_rule_leaves_a_person_s_decision_in_force(dataset: Dataset) -> None:
    live = _curator(dataset, _share())
    for episode in _episodes(6):
        _watch(live, episode, samples_of(episode))
        record(dataset, episode)
    worst = _episodes(1)[0]
    live.override(worst.id, "keep", "the only one from this side", "Ada")
    live.finish()
    assert dataset.latest_decisions()[worst.id].by == "Ada"


def test_rule_on_the_reference_is_final_at_once(dataset: Dataset) -> None:
    live = _curator(dataset)
    [decided] = _watch(live, _good(), samples_of(_good()))
    assert decided.decision.evidence["basis"] == "final"
    assert decided.decision.evidence["fitted_on"]["what"] == "reference"
    assert live.finish() == []


def test_copy_that_is_played_live_is_found(dataset: Dataset) -> None:
    live = _curator(dataset)
    first = _episodes(1)[0]
    _watch(live, first, samples_of(first))
    copy = replace(first, id="00000000-0000-7000-8000-00000000ffff", name="copy")
    [decided] = _watch(live, copy, samples_of(copy))
    assert decided.decision.verdict == "review"
    assert decided.decision.reason.startswith(f"duplicate: same content as episode {first.id}")
    record(dataset, copy)
    assert live.bag_closed(copy.id) == []  # equal to the bag, copy or not


# --- alerts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_a_loss_is_told_while_the_episode_runs(dataset: Dataset, seed: int) -> None:
    """Whatever the order in which topics come; once; with the span that the decision has."""
    live, episode = _curator(dataset), _early()
    live.event(started(episode), 0.0)
    alerts = []
    for sample in _interleaved(_stream_of("early"), seed):
        live.sample(sample, 0.0)
        alerts += live.take_alerts()
    [alert] = alerts
    assert (alert.episode, alert.name) == (episode.id, episode.name)
    [decided] = live.event(ended(episode), 0.0) + live.tick(DRAIN_S)
    assert alert.finding == decided.decision.findings[0]
    assert alert.finding.id == "object-lost"
    assert "in LIFT" in alert.finding.message
    left_ns = episode.start_ns + alert.finding.span[0]
    assert 0 < alert.seen_ns - left_ns <= 0.3e9 + 1e9 * (seed > 0)
    assert live.take_alerts() == []


def test_a_good_episode_alarms_nobody(dataset: Dataset) -> None:
    live = _curator(dataset)
    _watch(live, _good(), _stream_of("good"))
    assert live.take_alerts() == []


def test_a_silent_pose_alarms_nobody(dataset: Dataset) -> None:
    live, episode = _curator(dataset), _good()
    stop_ns = episode.start_ns + 120 * 50_000_000
    silent = [s for s in _stream_of("good") if s.topic != "eef_pose" or s.stamp_ns < stop_ns]
    _watch(live, episode, silent)
    assert live.take_alerts() == []
