"""The live curator: the same decision as on the bag, whatever was lost, late or repeated."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import bag_messages
import numpy as np
import pytest
from episodes import make_episode, make_reference
from live_takes import (
    DRAIN_S,
    SCORERS,
    decision_on_bag,
    early_take,
    fitted,
    good_take,
    interleaved,
    live_curator,
    only_decision,
    stream_of,
    stripped,
    watch,
)
from streams import ended, feed, make_recording, record, samples_of, started

from curation_ros.core.decision.curation import Curation
from curation_ros.core.decision.decision import CURATOR, Decision
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.stream import Sample
from curation_ros.core.errors import CurationError, EpisodeError
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.manifests import save_selection

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
    episode = {"good": good_take, "early": early_take}[name]()
    samples = spoil(list(stream_of(name)))
    live = live_curator(dataset)
    [decided] = watch(live, episode, interleaved(samples, 1))
    record(dataset, episode, samples=interleaved(samples, 2))
    assert live.bag_closed(episode.id) == []
    [first, amended] = dataset.decisions(episode.id)
    assert first == decided.decision
    assert amended == replace(first, evidence={**first.evidence, "bag": "equal"})
    offline = decision_on_bag(dataset, episode)
    assert stripped(amended) == offline
    for scorer, score in offline.scores.items():
        found = decided.decision.scores[scorer]
        assert (found is None) == (score is None)
        assert found is None or score is None or found.hex() == score.hex()


def test_decision_is_what_the_episode_deserves(dataset: Dataset) -> None:
    live = live_curator(dataset)
    [good] = watch(live, good_take(), stream_of("good"))
    [early] = watch(live, early_take(), stream_of("early"))
    assert (good.decision.verdict, good.decision.findings) == ("keep", ())
    assert early.decision.verdict == "discard"
    assert [f.id for f in early.decision.findings] == ["object-lost", "opened-early"]
    assert good.latency_s is not None
    assert good.latency_s > 0
    assert good.decision.scores["length"] == -240.0


def test_decision_is_on_disk_when_it_is_given(dataset: Dataset) -> None:
    [decided] = watch(live_curator(dataset), good_take(), stream_of("good"))
    [line] = dataset.decision_log(good_take().id).read_text().splitlines()
    assert Decision.from_json(json.loads(line)) == decided.decision
    assert (decided.decision.revision, decided.decision.by) == (1, CURATOR)
    assert decided.decision.state_hash == fitted().rule.state_hash


def test_decision_comes_with_the_last_message_and_not_before(dataset: Dataset) -> None:
    live = live_curator(dataset)
    *most, last = stream_of("good")
    live.event(started(good_take()), 0.0)
    for sample in most:
        assert live.sample(sample, 0.0) == []
    assert live.event(ended(good_take()), 0.0) == []
    assert live.tick(DRAIN_S - 0.01) == []
    [decided] = live.sample(last, DRAIN_S - 0.01)
    assert decided.decision.verdict == "keep"
    assert live.tick(1e9) == []


def test_samples_before_started_are_part_of_the_episode(dataset: Dataset) -> None:
    live = live_curator(dataset)
    samples = stream_of("good")
    for sample in samples[:21]:
        live.sample(sample, 0.0)
    [decided] = watch(live, good_take(), samples[21:])
    assert decided.decision.findings == ()


def test_without_a_reference_everything_is_for_review(dataset: Dataset) -> None:
    live = live_curator(dataset, Curation.fit(CurationSettings(scorers=SCORERS)))
    [decided] = watch(live, good_take(), stream_of("good"))
    assert (decided.decision.verdict, decided.decision.reason) == ("review", "no reference")
    assert decided.decision.scores["knn"] is None
    assert decided.decision.scores["gripper_timing"] == 237 / 240


def test_aborted_episode_is_for_review_and_ends_with_its_clock(dataset: Dataset) -> None:
    end = ended(good_take(), event="aborted", end_ns=None, counts={}, reason="no command for 5 s")
    samples = stream_of("good")[:700]
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), samples, end)
    assert decided.decision.verdict == "review"
    assert decided.decision.reason == "aborted: no command for 5 s"
    feed(make_recording(dataset), good_take(), samples, end)
    assert live.bag_closed(good_take().id) == []
    assert stripped(dataset.decisions(good_take().id)[-1]) == decision_on_bag(dataset, good_take())


def test_episodes_that_overlap_in_time_of_arrival_are_kept_apart(dataset: Dataset) -> None:
    first = good_take()
    second = make_episode(np.random.default_rng(3), start_ns=first.end_ns + 1, name="next")
    live = live_curator(dataset)
    samples = list(stream_of("good"))
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
    samples = list(stream_of("good"))
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), _lossy(samples))
    assert decided.decision.verdict == "review"
    assert {f.id for f in decided.decision.findings} == {"gap", "incomplete"}
    record(dataset, good_take(), samples=samples)
    second = only_decision(live.bag_closed(good_take().id))
    assert (second.revision, second.verdict, second.evidence["bag"]) == (2, "keep", "differs")
    assert stripped(second) == decision_on_bag(dataset, good_take())
    assert dataset.latest_decisions()[good_take().id] == second


def test_bag_wins_where_the_recorder_missed_something(dataset: Dataset) -> None:
    samples = list(stream_of("good"))
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), samples)
    assert decided.decision.verdict == "keep"
    record(dataset, good_take(), samples=_lossy(samples))
    second = only_decision(live.bag_closed(good_take().id))
    assert (second.revision, second.verdict) == (2, "review")
    assert dataset.latest_decisions()[good_take().id] == second


def test_what_came_too_late_for_the_curator_is_in_revision_2(dataset: Dataset) -> None:
    *most, last = stream_of("good")
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), most)
    assert [f.id for f in decided.decision.findings] == ["incomplete"]
    assert live.sample(last, DRAIN_S + 1) == []
    record(dataset, good_take(), samples=[*most, last])
    second = only_decision(live.bag_closed(good_take().id))
    assert (second.revision, second.findings) == (2, ())


def test_difference_that_changes_no_verdict_is_on_record(dataset: Dataset) -> None:
    samples = list(stream_of("good"))
    elsewhere = bag_messages.pose(samples[3].stamp_ns, (9.0, 9.0, 9.0))
    assert samples[3].topic == "objects/plate_1/pose"  # no column of the state
    moved = samples.copy()
    moved[3] = samples[3]._replace(data=bag_messages.to_cdr(elsewhere))
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), moved)
    record(dataset, good_take(), samples=samples)
    assert len(live.bag_closed(good_take().id)) == 1
    found = dataset.latest_decisions()[good_take().id]
    # What was seen differs, and so does its digest.
    assert found.evidence["content"] != decided.decision.evidence["content"]
    same = {**found.evidence, "content": decided.decision.evidence["content"]}
    assert stripped(replace(found, evidence=same)) == decided.decision
    assert found.evidence["bag"] == "differs"


def test_loss_that_only_the_recorder_knows_of_is_in_revision_2(dataset: Dataset) -> None:
    live = live_curator(dataset)
    watch(live, good_take(), stream_of("good"))
    feed(make_recording(dataset, publishers=lambda _topic: 2), good_take(), stream_of("good"))
    second = only_decision(live.bag_closed(good_take().id))
    assert second.revision == 2
    assert {f.id for f in second.findings} == {"unknown-loss"}
    assert second.verdict == "keep"


@pytest.mark.parametrize("spoil", ["missing", "empty", "torn", "no map"])
def test_live_decision_stands_where_the_bag_cannot_be_read(dataset: Dataset, spoil: str) -> None:
    live = live_curator(dataset)
    [decided] = watch(live, good_take(), stream_of("good"))
    path = dataset.bag_path(good_take().id)
    if spoil != "missing":
        record(dataset, good_take(), samples=stream_of("good"))
        [mcap] = path.glob("*.mcap")
        raw = mcap.read_bytes()
        mcap.write_bytes({"empty": b"", "torn": raw[: len(raw) // 2]}.get(spoil, b"no mcap"))
    assert live.bag_closed(good_take().id) == []
    found = dataset.latest_decisions()[good_take().id]
    assert (found.revision, found.verdict) == (1, "keep")
    assert found.evidence["bag"].startswith("not seen: ")
    assert str(path) in found.evidence["bag"]
    assert stripped(found) == decided.decision


def test_bag_without_anything_seen_live_is_scored_alone(dataset: Dataset) -> None:
    record(dataset, good_take(), samples=stream_of("good"))
    decision = only_decision(live_curator(dataset).bag_closed(good_take().id))
    assert (decision.revision, decision.evidence["bag"]) == (1, "alone")
    assert stripped(decision) == decision_on_bag(dataset, good_take())


def test_bag_that_closes_before_our_gate_is_read_when_that_closes(dataset: Dataset) -> None:
    *most, last = stream_of("good")
    record(dataset, good_take(), samples=stream_of("good"))
    live = live_curator(dataset)
    live.event(started(good_take()), 0.0)
    for sample in most:
        live.sample(sample, 0.0)
    live.event(ended(good_take()), 0.0)
    assert live.bag_closed(good_take().id) == []
    assert live.tick(DRAIN_S - 1) == []
    [decided] = live.sample(last, DRAIN_S - 1)
    assert dataset.latest_decisions()[good_take().id].evidence["bag"] == "equal"
    assert decided.decision.verdict == "keep"


def test_bag_that_closes_before_our_gate_wins_over_what_we_missed(dataset: Dataset) -> None:
    *most, _ = stream_of("good")
    record(dataset, good_take(), samples=stream_of("good"))
    live = live_curator(dataset)
    live.event(started(good_take()), 0.0)
    for sample in most:
        live.sample(sample, 0.0)
    live.event(ended(good_take()), 0.0)
    assert live.bag_closed(good_take().id) == []
    first, second = live.tick(DRAIN_S)
    assert (first.decision.verdict, second.decision.verdict) == ("review", "keep")
    assert second.decision.evidence["bag"] == "differs"
    assert dataset.latest_decisions()[good_take().id] == second.decision


def test_bag_of_a_recorder_that_was_stopped_has_the_say(dataset: Dataset) -> None:
    live = live_curator(dataset)
    live.event(started(good_take()), 0.0)
    recording = make_recording(dataset)
    recording.event(started(good_take()), 0.0)
    for sample in stream_of("good")[:700]:
        live.sample(sample, 0.0)
        recording.sample(sample, 0.0)
    recording.abort("the recorder was stopped")
    decision = only_decision(live.bag_closed(good_take().id))
    assert (decision.verdict, decision.revision) == ("review", 1)
    assert live.event(ended(good_take()), 0.0) + live.tick(DRAIN_S) == []
    assert dataset.latest_decisions()[good_take().id] == decision


# --- who comes late, and who plays again --------------------------------------------------------


def test_curator_that_starts_again_does_not_decide_on_what_it_has_not_seen(
    dataset: Dataset,
) -> None:
    first = live_curator(dataset)
    watch(first, good_take(), stream_of("good"))
    record(dataset, good_take(), samples=stream_of("good"))
    first.bag_closed(good_take().id)
    before = dataset.decision_log(good_take().id).read_bytes()
    again = live_curator(dataset)
    assert again.event(started(good_take()), 0.0) == []  # latched, as is what follows
    assert again.event(ended(good_take()), 0.0) == []
    assert again.bag_closed(good_take().id) == []
    told = only_decision(again.tick(DRAIN_S))  # who listens to us hears the decision again
    assert (told.revision, told.verdict) == (1, "keep")
    assert dataset.latest_decisions()[good_take().id] == told
    assert told.evidence["bag"] == "equal"
    assert dataset.decision_log(good_take().id).read_bytes() == before


def test_curator_that_comes_in_mid_episode_says_what_is_missing(dataset: Dataset) -> None:
    [decided] = watch(live_curator(dataset), good_take(), stream_of("good")[700:])
    assert decided.decision.verdict == "review"
    assert {f.id for f in decided.decision.findings} == {"clipped-start", "gap", "incomplete"}


def test_replay_gives_the_same_decision_and_no_second_line(dataset: Dataset) -> None:
    live = live_curator(dataset)
    [first] = watch(live, good_take(), stream_of("good"))
    for curator in (live, live_curator(dataset), live):
        samples = interleaved(stream_of("good"), 5)
        [second] = watch(curator, good_take(), samples, source="replay")
        assert second.decision == first.decision
    assert len(dataset.decisions(good_take().id)) == 1


def test_replayed_episodes_may_lie_at_the_same_time(dataset: Dataset) -> None:
    live = live_curator(dataset)
    assert (good_take().start_ns, len(good_take())) == (early_take().start_ns, len(early_take()))
    failed = ["object-lost", "opened-early"]
    for name, verdict, found in (("good", "keep", []), ("early", "discard", failed)) * 2:
        episode = {"good": good_take, "early": early_take}[name]()
        [decided] = watch(live, episode, stream_of(name), source="replay")
        assert decided.decision.verdict == verdict
        assert [f.id for f in decided.decision.findings] == found


def test_replay_under_another_state_is_a_new_revision(dataset: Dataset) -> None:
    watch(live_curator(dataset), good_take(), stream_of("good"))
    other = Curation.fit(
        CurationSettings(scorers=SCORERS, length="none"), make_reference(np.random.default_rng(7))
    )
    [second] = watch(live_curator(dataset, other), good_take(), stream_of("good"), source="replay")
    assert second.decision.revision == 2
    assert second.decision.state_hash == other.rule.state_hash != fitted().rule.state_hash


def test_empty_replay_is_answered(dataset: Dataset) -> None:
    end = ended(good_take(), event="aborted", source="replay", reason="at once")
    [decided] = watch(live_curator(dataset), good_take(), [], end, source="replay")
    assert decided.decision.verdict == "review"


# --- people -------------------------------------------------------------------------------------


def test_person_outranks_whatever_the_curator_decides_later(dataset: Dataset) -> None:
    samples = list(stream_of("good"))
    live = live_curator(dataset)
    watch(live, good_take(), _lossy(samples))
    person = live.override("good", "discard", "the cup was chipped", "Ada")
    assert (person.revision, person.verdict, person.by) == (2, "discard", "Ada")
    assert person.reason == "Ada: the cup was chipped"
    record(dataset, good_take(), samples=samples)
    assert only_decision(live.bag_closed(good_take().id)) == person
    assert dataset.latest_decisions()[good_take().id] == person
    assert [(d.revision, d.by) for d in dataset.decisions(good_take().id)] == [
        (1, CURATOR),
        (2, "Ada"),
        (3, CURATOR),
    ]
    assert (
        dataset.decisions(good_take().id)[-1].scores
        == decision_on_bag(dataset, good_take()).scores
    )


def test_last_of_several_persons_counts(dataset: Dataset) -> None:
    live = live_curator(dataset)
    watch(live, good_take(), stream_of("good"))
    live.override(good_take().id[:8], "discard", "", "Ada")
    last = live.override(good_take().id, "keep", "", "Bob")
    assert (last.reason, last.revision) == ("Bob decided", 3)
    assert dataset.latest_decisions()[good_take().id] == last


def test_override_of_what_two_episodes_are_called_is_refused(dataset: Dataset) -> None:
    twin = replace(early_take(), name="good")
    live = live_curator(dataset)
    watch(live, good_take(), stream_of("good"))
    watch(live, twin, stream_of("early"))
    with pytest.raises(EpisodeError, match="means 2 episodes"):
        live.override("good", "keep", "", "Ada")
    assert live.override(twin.id, "keep", "", "Ada").episode == twin.id


def test_log_that_cannot_be_written_is_an_error_and_the_next_episode_is_decided(
    dataset: Dataset,
) -> None:
    live = live_curator(dataset)
    (dataset.path / "decisions").write_text("in the way")
    with pytest.raises(CurationError, match="decisions"):
        watch(live, good_take(), stream_of("good"))
    (dataset.path / "decisions").unlink()
    [decided] = watch(live, early_take(), stream_of("early"))
    assert decided.decision.verdict == "discard"


# --- labels -------------------------------------------------------------------------------------


def _pipeline(folder: Path, *, flipped: bool) -> tuple[list[Decision], dict[str, Any]]:
    """Record, decide and select, beside labels that say one thing or its opposite."""
    dataset = Dataset(folder, create=True)
    live = live_curator(dataset)
    for k, (episode, name) in enumerate(((good_take(), "good"), (early_take(), "early"))):
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
        watch(live, episode, stream_of(name))
        record(dataset, episode, samples=stream_of(name))
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
    found = [d for e in (good_take(), early_take()) for d in dataset.decisions(e.id)]
    return found, manifests


def test_flipping_every_label_changes_no_score_no_decision_and_no_selection(
    tmp_path: Path,
) -> None:
    assert _pipeline(tmp_path / "a", flipped=False) == _pipeline(tmp_path / "b", flipped=True)
    truths = [Dataset(tmp_path / k).truth() for k in "ab"]
    assert truths[0][good_take().id]["outcome"] != truths[1][good_take().id]["outcome"]


def test_removing_the_labels_changes_no_decision(dataset: Dataset) -> None:
    dataset.append_truth({"episode": good_take().id, "outcome": "failed"})
    record(dataset, good_take(), samples=stream_of("good"))
    before = live_curator(dataset).bag_closed(good_take().id)
    (dataset.path / "truth.jsonl").unlink()
    shutil.rmtree(dataset.path / "decisions")
    assert live_curator(dataset).bag_closed(good_take().id) == before
