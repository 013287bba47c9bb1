from __future__ import annotations

import json
import multiprocessing
import os
import resource
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import topic_map
from streams import (
    counts_of,
    ended,
    feed,
    make_recording,
    record,
    recorded_topics,
    same_arrays,
    samples_of,
    short_episode,
    started,
)

from curation_ros import __version__
from curation_ros.bags import open_bag, recover_bag
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.status import event_to_json
from curation_ros.core.episode.stream import Sample
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.dataset.dataset import Dataset
from curation_ros.dataset.episodes import read_episode
from curation_ros.live.recorder import Notice, RecordedTopic, Recording, recover_partials

STEP_NS = 50_000_000
STEP_S = 0.05
N_TOPICS = 7
FORK = multiprocessing.get_context("fork")


def _states(notices: list[Notice]) -> list[str]:
    return [n.state for n in notices]


def _notes(bag_path: Path) -> dict[str, Any]:
    """What the recorder noted about the recording itself."""
    noted: dict[str, Any] = json.loads(open_bag(bag_path).custom_data["recording"])
    return noted


def _in_bag(bag_path: Path) -> list[Sample]:
    names = {t.name: topic for topic, t in recorded_topics().items()}
    return [
        Sample(names[m.topic], 0, m.sequence, m.data, m.log_time_ns, m.publish_time_ns)
        for m in open_bag(bag_path).messages()
    ]


def _left(dataset: Dataset) -> list[str]:
    """Everything in `.partial`."""
    return sorted(p.name for p in dataset.partials.folder.iterdir())


# --- what is in a bag ---------------------------------------------------------------------------


def test_bag_has_every_sample_as_it_came(dataset: Dataset, rng: np.random.Generator) -> None:
    episode = short_episode(rng)
    samples = samples_of(episode)
    path = record(dataset, episode)
    assert _in_bag(path) == [s._replace(stamp_ns=0) for s in samples]
    assert same_arrays(read_episode(path), episode)
    assert read_episode(path).findings == ()
    assert _left(dataset) == []


def test_bag_says_whose_it_is_and_what_its_topics_mean(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    bag = open_bag(record(dataset, episode))
    assert set(bag.custom_data) == {"episode", "topic_map", "topics", "recorder", "recording"}
    assert json.loads(bag.custom_data["episode"]) == event_to_json(ended(episode))
    assert topic_map_from_json(json.loads(bag.custom_data["topic_map"])) == topic_map()
    assert json.loads(bag.custom_data["topics"])["command/twist"] == "/command/twist"
    assert bag.custom_data["recorder"] == f"curation_ros {__version__}"
    assert bag.mcap_paths[0].name == f"{episode.id}_0.mcap"
    assert {t: x.type for t, x in bag.topics.items()} == {
        f"/{t}": kind for t, kind in topic_map().topics.items()
    }


def test_topics_of_a_namespace_are_recorded_under_their_resolved_names(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    topics = {
        t: RecordedTopic(f"/robot1/{t}", r.type, r.qos) for t, r in recorded_topics().items()
    }
    recording = Recording(dataset, topic_map(), topics, min_free_mb=1.0)
    assert _states(feed(recording, episode)) == ["recording", "closed"]
    bag = open_bag(dataset.bag_path(episode.id))
    assert "/robot1/eef_pose" in bag.topics
    assert same_arrays(read_episode(dataset.bag_path(episode.id)), episode)


def test_samples_that_came_before_started_are_in_the_bag(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    samples = samples_of(episode)
    recording = make_recording(dataset)
    n_early = 3 * N_TOPICS
    for sample in samples[:n_early]:
        assert recording.sample(sample, 0.0) == []
    notices = recording.event(started(episode), 0.0)
    for sample in samples[n_early:]:
        notices += recording.sample(sample, 0.0)
    notices += recording.event(ended(episode), 0.0)
    assert _states(notices) == ["recording", "closed"]
    path = dataset.bag_path(episode.id)
    assert _in_bag(path) == [s._replace(stamp_ns=0) for s in samples]
    assert _notes(path)["topics"]["eef_pose"]["stamps_back"] == 0


def test_samples_outside_the_window_are_not_in_the_bag(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    whole = short_episode(rng, 30)
    inner = whole.steps(20, 10)
    begin = started(whole, start_ns=int(inner.stamps_ns[0]))
    end = ended(inner, start_ns=begin.start_ns, end_ns=int(inner.stamps_ns[-1]))
    recording = make_recording(dataset)
    samples = samples_of(whole)
    early, late = samples[: 12 * N_TOPICS], samples[12 * N_TOPICS :]
    for sample in early:
        recording.sample(sample, 0.0)
    recording.event(begin, 0.0)
    recording.event(end, 0.0)  # known before most of its samples are here
    notices = [n for sample in late for n in recording.sample(sample, 0.0)]
    assert _states(notices) == ["closed"]
    published = {s.publish_ns - 1000 for s in _in_bag(dataset.bag_path(whole.id))}
    assert sorted(published) == inner.stamps_ns.tolist()


def test_notices_tell_what_happened(dataset: Dataset, rng: np.random.Generator) -> None:
    episode = short_episode(rng, name="pick-7")
    opened, closed = feed(make_recording(dataset), episode)
    assert opened == Notice("recording", episode.id, "pick-7")
    counts = dict.fromkeys(topic_map().topics, len(episode))
    assert closed == Notice("closed", episode.id, "pick-7", "", counts)


def test_open_episode_can_be_watched(dataset: Dataset, rng: np.random.Generator) -> None:
    episode = short_episode(rng)
    recording = make_recording(dataset)
    assert (recording.open_ids, recording.counts(episode.id)) == ((), {})
    recording.event(started(episode), 0.0)
    samples = samples_of(episode)[: 2 * N_TOPICS + 1]
    for sample in samples:
        recording.sample(sample, 0.0)
    assert recording.open_ids == (episode.id,)
    assert recording.counts(episode.id) == counts_of(samples)


def test_episodes_one_after_the_other_get_a_bag_each(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first = short_episode(rng)
    second = short_episode(rng, start_ns=first.end_ns + 1)
    recording = make_recording(dataset)
    recording.event(started(first), 0.0)
    late = [s for s in samples_of(first) if s.topic == "phase"][-3:]
    for sample in samples_of(first):
        if sample not in late:
            recording.sample(sample, 0.0)
    notices = recording.event(ended(first), 0.0)
    notices += recording.event(started(second), 0.0)
    for sample in sorted([*late, *samples_of(second)], key=lambda s: s.topic):
        notices += recording.sample(sample, 0.0)
    notices += recording.event(ended(second), 0.0)
    assert [(n.state, n.id) for n in notices] == [
        ("recording", second.id),
        ("closed", first.id),
        ("closed", second.id),
    ]
    for episode in (first, second):
        assert same_arrays(read_episode(dataset.bag_path(episode.id)), episode)


# --- what the recorder notes --------------------------------------------------------------------


def test_lost_messages_are_counted_from_their_numbers(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    lost = {("joint_states", 4), ("joint_states", 5), ("joint_states", 11), ("phase", 1)}
    samples = [s for s in samples_of(episode) if (s.topic, s.seq) not in lost]
    path = record(dataset, episode, samples=samples)
    noted = _notes(path)["topics"]
    # What is lost before the first message of an episode cannot be seen in the numbers.
    assert {t: n["lost"] for t, n in noted.items() if n["lost"]} == {"joint_states": 3}
    assert (noted["joint_states"]["count"], noted["joint_states"]["expected"]) == (17, 20)
    assert [f.id for f in read_episode(path).findings] == ["incomplete", "incomplete"]


def test_messages_without_numbers_count_as_none_lost(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    samples = [s._replace(seq=0) for s in samples_of(episode)]
    noted = _notes(record(dataset, episode, samples=samples))["topics"]
    assert {n["lost"] for n in noted.values()} == {0}


def test_gaps_and_stamps_that_went_back_are_noted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng, 40)
    samples = samples_of(episode)
    silent = [s for s in samples if s.topic != "phase" or not 10 < s.seq < 20]
    twist = [s for s in silent if s.topic == "command/twist"]
    i, j = silent.index(twist[20]), silent.index(twist[21])
    silent[i], silent[j] = silent[j], silent[i]
    noted = _notes(record(dataset, episode, samples=silent))["topics"]
    assert (noted["phase"]["gaps"], noted["phase"]["longest_gap_ns"]) == (1, 10 * STEP_NS)
    assert noted["command/twist"]["stamps_back"] == 1
    healthy = noted["eef_pose"]
    assert (healthy["gaps"], healthy["longest_gap_ns"], healthy["stamps_back"]) == (0, STEP_NS, 0)


def test_several_publishers_make_the_loss_unknown(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    recording = make_recording(dataset, publishers=lambda t: 2 if t == "phase" else 1)
    assert _states(feed(recording, episode)) == ["recording", "closed"]
    path = dataset.bag_path(episode.id)
    noted = _notes(path)["topics"]
    assert (noted["phase"]["lost"], noted["phase"]["publishers"]) == (None, 2)
    assert noted["eef_pose"]["lost"] == 0
    [finding] = read_episode(path).findings
    assert (finding.id, finding.message) == ("unknown-loss", "topic 'phase' has 2 publishers")


def test_publisher_that_came_later_makes_the_loss_unknown(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    now = {"publishers": 1}
    recording = make_recording(dataset, publishers=lambda _topic: now["publishers"])
    recording.event(started(episode), 0.0)
    for sample in samples_of(episode):
        recording.sample(sample, 0.0)
    now["publishers"] = 2
    [closed] = recording.event(ended(episode), 0.0)
    assert "topic 'eef_pose' has 2 publishers" in closed.reason


def test_change_of_publisher_makes_the_loss_unknown(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    samples = [
        s._replace(seq=s.seq - 9) if s.topic == "phase" and s.seq > 9 else s
        for s in samples_of(episode)
    ]
    path = record(dataset, episode, samples=samples)
    assert _notes(path)["topics"]["phase"]["lost"] is None
    assert [f.id for f in read_episode(path).findings] == ["unknown-loss"]


def test_what_is_still_missing_after_the_drain_time_is_noted(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    samples = [s for s in samples_of(episode) if s.topic != "phase"][: -2 * (N_TOPICS - 1)]
    recording = make_recording(dataset, drain_timeout_s=3.0)
    recording.event(started(episode), 10.0)
    for sample in samples:
        recording.sample(sample, 10.0)
    assert recording.event(ended(episode), 10.0) == []
    assert recording.tick(12.9) == []
    [closed] = recording.tick(13.0)
    assert closed.state == "closed"
    path = dataset.bag_path(episode.id)
    assert set(_notes(path)["missing"]) == set(topic_map().topics)
    assert {f.id for f in read_episode(path).findings} == {"incomplete", "missing-topic"}


# --- what is refused ----------------------------------------------------------------------------


def test_episode_that_the_dataset_has_is_refused_and_its_bag_stays(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    path = record(dataset, episode)
    before = (path / f"{episode.id}_0.mcap").read_bytes()
    notices = feed(make_recording(dataset), episode)
    assert [(n.state, n.reason) for n in notices] == [
        ("failed", "the dataset already has this episode")
    ]
    assert (path / f"{episode.id}_0.mcap").read_bytes() == before
    assert _left(dataset) == []


def test_latched_words_on_an_episode_that_was_recorded_are_no_fault(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    record(dataset, episode)
    recording = make_recording(dataset)
    notices = recording.event(started(episode), 0.0) + recording.event(ended(episode), 0.0)
    assert notices + recording.tick(1e6) == []


def test_episode_without_any_message_leaves_no_bag(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    notices = feed(make_recording(dataset), episode, samples=[])
    assert _states(notices) == ["recording", "failed"]
    assert "no message" in notices[-1].reason
    assert list(dataset.bags()) == []
    assert _left(dataset) == []


def test_second_recorder_of_an_episode_stays_out_of_it(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    first, second = make_recording(dataset), make_recording(dataset)
    assert _states(first.event(started(episode), 0.0)) == ["recording"]
    [refused] = second.event(started(episode), 0.0)
    assert (refused.state, refused.reason) == ("failed", "another recorder has this episode")
    for sample in samples_of(episode):
        first.sample(sample, 0.0)
        assert second.sample(sample, 0.0) == []
    assert second.event(ended(episode), 0.0) == []
    assert _states(first.event(ended(episode), 0.0)) == ["closed"]
    assert same_arrays(read_episode(dataset.bag_path(episode.id)), episode)


def test_no_episode_starts_below_the_floor_of_free_space(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    recording = make_recording(dataset, min_free_mb=1e12)
    notices = feed(recording, episode)
    assert _states(notices) == ["failed"]
    assert f"{recording.free_mb():.0f} MB free"[:3] == notices[0].reason[:3]
    assert notices[0].reason.endswith("at least 1e+12 are wanted")
    assert _left(dataset) == []


def test_running_episode_is_closed_when_space_falls_below_the_floor(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    samples = samples_of(episode)
    recording = make_recording(dataset)
    recording.event(started(episode), 0.0)
    for sample in samples[: 10 * N_TOPICS]:
        recording.sample(sample, 0.0)
    recording.tick(10.0)
    recording.min_free_mb = 1e12
    assert recording.tick(10.5) == []  # looked at once a second
    [notice] = recording.tick(11.0)
    assert (notice.state, notice.reason) == (
        "closed",
        "aborted: free space fell below 1e+12 MB",
    )
    built = read_episode(dataset.bag_path(episode.id))
    assert [f.id for f in built.findings] == ["aborted"]
    assert len(built) == 10


def test_type_without_a_definition_fails_the_episode_and_lets_go_of_it(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    topics = recorded_topics()
    recording = make_recording(dataset)
    recording.topics["phase"] = RecordedTopic("/phase", "no_msgs/msg/Thing", topics["phase"].qos)
    n_open = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        [failed] = recording.event(started(short_episode(rng)), 0.0)
        assert "no_msgs/msg/Thing" in failed.reason
    assert len(os.listdir("/proc/self/fd")) == n_open
    assert _left(dataset) == []
    recording.topics["phase"] = topics["phase"]
    assert _states(feed(recording, episode)) == ["recording", "closed"]


def test_dataset_that_vanishes_is_a_notice_and_no_crash(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first, second = short_episode(rng), short_episode(rng)
    recording = make_recording(dataset)
    recording.event(started(first), 0.0)
    for sample in samples_of(first):
        recording.sample(sample, 0.0)
    shutil.rmtree(dataset.path)
    notices = recording.tick(1.0) + recording.event(ended(first), 1.0) + recording.tick(2.0)
    assert "failed" in _states(notices)
    assert _states(recording.event(started(second), 2.0)) == ["failed"]
    assert recording.open_ids == ()


def test_claim_that_cannot_be_made_fails_the_episode(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    shutil.rmtree(dataset.partials.folder)
    dataset.partials.folder.write_text("in the way")
    recording = make_recording(dataset)
    [failed] = recording.event(started(short_episode(rng)), 0.0)
    assert failed.state == "failed"
    assert str(dataset.partials.folder) in failed.reason
    dataset.partials.folder.unlink()
    dataset.partials.folder.mkdir()
    assert _states(feed(recording, short_episode(rng))) == ["recording", "closed"]


# --- abort --------------------------------------------------------------------------------------


def test_abort_closes_the_bag_with_all_it_has(dataset: Dataset, rng: np.random.Generator) -> None:
    episode = short_episode(rng)
    samples = samples_of(episode)[: 12 * N_TOPICS]
    recording = make_recording(dataset)
    recording.event(started(episode), 0.0)
    for sample in samples:
        recording.sample(sample, 0.0)
    [notice] = recording.abort("the recorder was stopped")
    assert (notice.state, notice.reason) == ("closed", "aborted: the recorder was stopped")
    path = dataset.bag_path(episode.id)
    assert _in_bag(path) == [s._replace(stamp_ns=0) for s in samples]
    built = read_episode(path)
    assert (len(built), built.end_ns) == (12, int(episode.stamps_ns[11]))
    [finding] = built.findings
    assert (finding.id, finding.message) == ("aborted", "the recorder was stopped")
    assert recording.abort("again") == []


def test_what_comes_after_an_abort_is_not_recorded_and_the_next_episode_is(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    first = short_episode(rng)
    second = short_episode(rng, start_ns=first.end_ns + 1)
    recording = make_recording(dataset)
    recording.event(started(first), 0.0)
    samples = samples_of(first)
    for sample in samples[:50]:
        recording.sample(sample, 0.0)
    recording.abort("space")
    after = [n for s in samples[50:] for n in recording.sample(s, 0.0)]
    assert after + recording.event(ended(first), 0.0) == []
    assert _states(feed(recording, second)) == ["recording", "closed"]
    assert same_arrays(read_episode(dataset.bag_path(second.id)), second)


def test_abort_of_the_owner_is_kept_with_its_reason(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    episode = short_episode(rng)
    path = dataset.bag_path(episode.id)
    event = ended(episode, event="aborted", end_ns=None, counts={}, reason="no command for 5 s")
    feed(make_recording(dataset), episode, end=event)
    built = read_episode(path)
    assert [(f.id, f.message) for f in built.findings] == [("aborted", "no command for 5 s")]
    assert built.stamps_ns.tolist() == episode.stamps_ns.tolist()


# --- a disk that fails --------------------------------------------------------------------------


def _in_child(work: Callable[..., Any], *arguments: Any) -> Any:
    """Run a function in a process of its own, for what it does to that process."""
    with FORK.Pool(1) as pool:
        return pool.apply(work, arguments)


def _record_with_little_space(path: Path) -> list[tuple[str, str, str]]:
    rng = np.random.default_rng(1)
    first, second = short_episode(rng, 400), short_episode(rng)
    recording = make_recording(Dataset(path))
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    notices = recording.event(started(first), 0.0)
    for k, sample in enumerate(samples_of(first)):
        notices += recording.sample(sample, k / N_TOPICS * STEP_S)
        if k % N_TOPICS == 0:
            notices += recording.tick(k / N_TOPICS * STEP_S)
    notices += recording.event(ended(first), 100.0)
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    notices += feed(recording, second)
    return [(n.state, n.id, n.reason) for n in notices]


def test_failing_disk_costs_the_rest_of_one_episode_and_nothing_else(dataset: Dataset) -> None:
    rng = np.random.default_rng(1)
    first, second = short_episode(rng, 400), short_episode(rng)
    told = _in_child(_record_with_little_space, dataset.path)
    assert [(state, episode_id) for state, episode_id, _ in told] == [
        ("recording", first.id),
        ("failed", first.id),
        ("recording", second.id),
        ("closed", second.id),
    ]
    assert "File too large" in told[1][2]
    assert same_arrays(read_episode(dataset.bag_path(second.id)), second)
    [recovered] = recover_partials(dataset)
    assert (recovered.state, recovered.id) == ("closed", first.id)
    kept = _in_bag(dataset.bag_path(first.id))
    whole = [s._replace(stamp_ns=0) for s in samples_of(first)]
    assert kept == whole[: len(kept)]
    assert len(kept) > 100


# --- recovery -----------------------------------------------------------------------------------


def _interrupted() -> Episode:
    """What a recorder that is killed was recording."""
    return short_episode(np.random.default_rng(1), 60)


def _record_and_hang(path: Path, n_steps: int, told: Any) -> None:
    """Record some steps, flush by the clock of the recorder, then hang."""
    episode = _interrupted()
    recording = make_recording(Dataset(path), flush_period_s=0.1)
    notices = recording.event(started(episode), 100.0)
    now_s = 100.0
    for k, sample in enumerate(samples_of(episode)[: n_steps * N_TOPICS]):
        now_s = 100.0 + k // N_TOPICS * STEP_S
        recording.tick(now_s)
        notices += recording.sample(sample, now_s)
    told.send(([n.state for n in notices], now_s))
    signal.pause()


def _killed_recorder(dataset: Dataset, n_steps: int) -> float:
    """A recorder that was killed in mid-episode; returns its clock at its end."""
    here, there = FORK.Pipe()
    child = FORK.Process(target=_record_and_hang, args=(dataset.path, n_steps, there), daemon=True)
    child.start()
    there.close()
    states, now_s = here.recv()
    assert states == ["recording"]
    child.kill()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    return float(now_s)


def test_killed_recorder_loses_at_most_one_flush_period(dataset: Dataset) -> None:
    episode = _interrupted()
    n_steps = 33
    killed_s = _killed_recorder(dataset, n_steps)
    torn = dataset.partials.path(episode.id)
    original = (torn / f"{episode.id}_0.mcap").read_bytes()

    [notice] = recover_partials(dataset)
    assert (notice.state, notice.id, notice.name) == ("closed", episode.id, episode.name)
    kept = _in_bag(dataset.bag_path(episode.id))
    assert notice.reason.startswith(f"recovered {len(kept)} messages (")
    whole = [s._replace(stamp_ns=0) for s in samples_of(episode)]
    assert kept == whole[: len(kept)]
    n_old = round((killed_s - 0.1 - 100.0) / STEP_S)
    assert n_steps * N_TOPICS > len(kept) >= n_old * N_TOPICS

    built = read_episode(dataset.bag_path(episode.id))
    assert [f.id for f in built.findings] == ["recovered"]
    assert same_arrays(built, replace(episode.steps(len(built)), end_ns=built.end_ns))
    quarantined = dataset.path / "quarantine" / f"{episode.id}.partial"
    assert (quarantined / f"{episode.id}_0.mcap").read_bytes() == original
    assert _left(dataset) == []
    assert recover_partials(dataset) == []
    dataset.refresh()
    [row] = dataset.index.episodes()
    assert (row.is_recovered, row.name, row.end_ns) == (True, episode.name, built.stamps_ns[-1])


def test_bag_of_a_living_recorder_is_left_alone(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    living = short_episode(rng)
    recording = make_recording(dataset)
    notices = recording.event(started(living), 0.0)
    samples = samples_of(living)
    for sample in samples[:70]:
        recording.sample(sample, 0.0)
    _killed_recorder(dataset, 12)
    assert [n.id for n in recover_partials(dataset)] == [_interrupted().id]
    assert dataset.partials.path(living.id).is_dir()
    for sample in samples[70:]:
        recording.sample(sample, 0.0)
    notices += recording.event(ended(living), 0.0)
    assert _states(notices) == ["recording", "closed"]
    assert same_arrays(read_episode(dataset.bag_path(living.id)), living)


def test_recorders_that_recover_at_once_recover_once(dataset: Dataset) -> None:
    _killed_recorder(dataset, 12)
    with FORK.Pool(3) as pool:
        notices = pool.map(recover_partials, [dataset] * 3, chunksize=1)
    assert [n.state for found in notices for n in found] == ["closed"]
    assert _left(dataset) == []
    assert len(list(dataset.bags())) == 1


def test_episode_of_a_killed_recorder_can_go_on_with_its_successor(
    dataset: Dataset, rng: np.random.Generator
) -> None:
    _killed_recorder(dataset, 12)
    recover_partials(dataset)
    episode = short_episode(rng)
    recording = make_recording(dataset)
    # What is still latched of the old one is no fault: it has its bag.
    assert recording.event(started(_interrupted()), 0.0) == []
    assert _states(feed(recording, episode)) == ["recording", "closed"]


def test_what_cannot_be_recovered_is_reported_and_stays(dataset: Dataset) -> None:
    empty, foreign = dataset.partials.path("a-empty"), dataset.partials.path("b-foreign")
    for folder in (empty, foreign):
        folder.mkdir()
    (foreign / "x_0.mcap").write_bytes(b"no mcap at all")
    _killed_recorder(dataset, 12)
    notices = recover_partials(dataset)
    assert {n.id: n.state for n in notices} == {
        "a-empty": "failed",
        "b-foreign": "failed",
        _interrupted().id: "closed",
    }
    assert all(n.reason.startswith("not recovered: ") for n in notices if n.state == "failed")
    assert (foreign / "x_0.mcap").read_bytes() == b"no mcap at all"
    assert empty.is_dir()


def test_leftovers_of_an_interrupted_recovery_are_no_partial_bag(dataset: Dataset) -> None:
    dataset.partials.path("x.recovering").mkdir()
    (dataset.partials.path("x.recovering") / "y").write_text("")
    assert recover_partials(dataset) == []


def test_recovery_that_was_interrupted_after_its_bag_was_whole_is_finished(
    dataset: Dataset,
) -> None:
    _killed_recorder(dataset, 12)
    [partial] = [p for p in dataset.partials.folder.iterdir() if p.is_dir()]
    recover_bag(partial, dataset.bag_path(partial.name))  # and then it was killed
    before = _in_bag(dataset.bag_path(partial.name))
    [notice] = recover_partials(dataset)
    assert (notice.state, notice.id) == ("closed", partial.name)
    assert _in_bag(dataset.bag_path(partial.name)) == before
    assert (dataset.path / "quarantine" / f"{partial.name}.partial").is_dir()
    assert recover_partials(dataset) == []


def test_living_recorder_has_flushed_what_is_older_than_its_period(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    episode = short_episode(rng, 40)
    recording = make_recording(dataset, flush_period_s=0.1)
    recording.event(started(episode), 100.0)
    for k, sample in enumerate(samples_of(episode)):
        now_s = 100.0 + k // N_TOPICS * STEP_S
        recording.tick(now_s)
        recording.sample(sample, now_s)
        if k % 35 == 0 and k:
            copy = tmp_path / f"copy{k}"
            shutil.copytree(dataset.partials.path(episode.id), copy)
            report = recover_bag(copy, tmp_path / f"saved{k}")
            n_old = int((now_s - 0.1 - 100.0) / STEP_S)
            assert sum(report.messages.values()) >= n_old * N_TOPICS


@pytest.mark.parametrize("n_steps", [1, 2])
def test_episode_of_a_step_or_two_is_a_bag_like_any_other(
    dataset: Dataset, rng: np.random.Generator, n_steps: int
) -> None:
    episode = short_episode(rng, n_steps)
    assert same_arrays(read_episode(record(dataset, episode)), episode)
