"""The policy node without a graph: when it answers, with what, and when it does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import TOPIC_MAP
from episodes import make_episode
from mlps import mlp
from streams import samples_of
from toy_policies import ChunkedPolicy

from curation_ros.bags.cdr import CdrDecoder
from curation_ros.core.episode.status import EpisodeEvent
from curation_ros.core.errors import PolicyError
from policy_node.controller import PolicyController
from policy_node.joining import LatestSamples
from policy_node.live import LivePolicy

POLICIES = {
    "mlp": mlp,
    "chunked": ChunkedPolicy,
    "chunked, ensembles": lambda: ChunkedPolicy(horizon=6, ensembles=True),
}
policies = pytest.mark.parametrize("policy", POLICIES)


@pytest.fixture
def episode(rng):
    """It starts with its first step, as the simulator has it."""
    made = make_episode(rng, n_steps=12, close_at=None)
    return replace(made, start_ns=int(made.stamps_ns[0]))


@pytest.fixture
def rng():
    return np.random.default_rng(20260608)


def live(policy):
    return LivePolicy(POLICIES[policy](), TOPIC_MAP, CdrDecoder())


def started(episode, **changes):
    event = EpisodeEvent(episode.id, episode.name, "started", episode.start_ns)
    return replace(event, **changes)


def observations(episode, step):
    """Samples of one step, without commands."""
    commands = TOPIC_MAP.command_topics
    stamp_ns = episode.stamps_ns[step]
    return [s for s in samples_of(episode) if s.topic not in commands and s.stamp_ns == stamp_ns]


def fed(driven, samples):
    return [answer for sample in samples for answer in driven.sample(sample)]


def expected(policy, episode):
    """Commands of the same policy in one process."""
    controller = PolicyController(POLICIES[policy]())
    return [
        controller.answer(k, {name: values[k] for name, values in episode.fields.items()})
        for k in range(len(episode))
    ]


def assert_answers(answers, episode, commands, first=0):
    stamps = episode.stamps_ns[first : first + len(answers)].tolist()
    assert [answer.stamp_ns for answer in answers] == stamps
    for answer, command in zip(answers, commands[first:], strict=False):
        assert answer.command.keys() == command.keys()
        for name, values in command.items():
            np.testing.assert_array_equal(answer.command[name], values)


@policies
def test_each_complete_observation_is_answered_once_as_in_one_process(policy, episode):
    driven = live(policy)
    assert driven.event(started(episode)) == []
    assert driven.is_driving
    answers = []
    for k in range(len(episode)):
        now = fed(driven, observations(episode, k))
        assert len(now) == 1
        answers += now
    assert_answers(answers, episode, expected(policy, episode))
    assert driven.problem == ""


@policies
def test_repeated_observation_gets_the_same_command_again(policy, episode):
    driven, commands = live(policy), expected(policy, episode)
    driven.event(started(episode))
    for k in range(len(episode)):
        for _ in range(3 if k % 2 else 1):
            assert_answers(fed(driven, observations(episode, k)), episode, commands, k)


def test_topics_that_are_not_observed_are_not_awaited(episode):
    driven = live("chunked")
    assert list(driven.topic_map.topics) == ["eef_pose"]
    driven.event(started(episode))
    [pose] = [s for s in observations(episode, 0) if s.topic == "eef_pose"]
    assert len(driven.sample(pose)) == 1


@policies
def test_observations_that_overtake_the_start_are_answered_in_their_order(policy, episode):
    driven, answers = live(policy), []
    for k in (1, 0, 2):
        assert fed(driven, observations(episode, k)) == []
    answers = driven.event(started(episode))
    assert_answers(answers, episode, expected(policy, episode))
    assert len(answers) == 3


def test_incomplete_observation_waits_for_its_last_topic(episode):
    driven = live("mlp")
    driven.event(started(episode))
    *others, last = observations(episode, 0)
    assert fed(driven, [*others, *observations(episode, 1)[:-1]]) == []
    answers = driven.sample(last)
    assert_answers(answers, episode, expected("mlp", episode))
    assert len(answers) == 1


def test_episode_joined_in_its_middle_is_not_driven(episode):
    driven = live("mlp")
    driven.event(started(episode))
    assert fed(driven, observations(episode, 3)) == []
    assert driven.problem == "pick-1: its first observation was not received: not driving it"
    driven.event(started(episode))
    assert driven.problem == ""


def test_ended_episode_is_driven_no_further_and_another_begins_anew(episode):
    driven = live("chunked")
    driven.event(started(episode))
    fed(driven, observations(episode, 0))
    driven.event(started(episode, id="somebody-else", event="ended"))
    assert driven.is_driving
    driven.event(started(episode, event="ended"))
    assert not driven.is_driving
    assert fed(driven, observations(episode, 1)) == []
    again = replace(episode, id="another", start_ns=int(episode.stamps_ns[5]))
    driven.event(started(again))
    later = fed(driven, observations(episode, 5))
    controller = PolicyController(ChunkedPolicy())
    first = controller.answer(0, {n: v[5] for n, v in episode.fields.items()})
    np.testing.assert_array_equal(later[0].command["twist"], first["twist"])


def test_observation_of_the_past_is_not_answered(episode):
    driven = live("chunked")
    driven.event(started(episode))
    fed(driven, [*observations(episode, 0), *observations(episode, 1)])
    assert fed(driven, observations(episode, 0)) == []
    assert driven.problem == ""


def test_unusable_observation_is_a_problem_and_the_episode_goes_on(episode):
    fields = {**episode.fields, "eef_position": episode.fields["eef_position"].copy()}
    fields["eef_position"][1] = np.nan
    broken = replace(episode, fields=fields)
    driven = live("chunked")
    driven.event(started(episode))
    fed(driven, observations(broken, 0))
    assert fed(driven, observations(broken, 1)) == []
    assert driven.problem.startswith("pick-1: observation: eef_position is [nan")
    assert len(fed(driven, observations(broken, 2))) == 1


def test_malformed_sample_is_a_problem(episode):
    driven = live("chunked")
    driven.event(started(episode))
    [pose] = [s for s in observations(episode, 0) if s.topic == "eef_pose"]
    assert driven.sample(pose._replace(data=pose.data[:30])) == []
    assert "eef_pose" in driven.problem or "PoseStamped" in driven.problem


def test_samples_without_an_episode_do_not_pile_up(episode):
    driven = live("chunked")
    [pose] = [s for s in observations(episode, 0) if s.topic == "eef_pose"]
    stamps = [pose.stamp_ns + k for k in range(300)]
    for stamp_ns in stamps:
        driven.sample(pose._replace(stamp_ns=stamp_ns))
    answers = driven.event(started(episode, start_ns=stamps[-100]))
    assert [answer.stamp_ns for answer in answers] == stamps[-100:]
    assert driven.event(started(episode, start_ns=stamps[-101])) == []


def test_policy_that_does_not_fit_the_robot_is_refused():
    fields = {k: v for k, v in TOPIC_MAP.fields.items() if k != "eef_position"}
    with pytest.raises(PolicyError, match="no field 'eef_position'"):
        LivePolicy(ChunkedPolicy(), replace(TOPIC_MAP, fields=fields), CdrDecoder())


# --- topics whose stamps differ -----------------------------------------------------------------

EARLIER_NS, LATER_NS = -7_000_000, 7_000_000


def shifted(samples, by_ns):
    """Samples of a step with other stamps, but for the clock's, which comes last."""
    clock = TOPIC_MAP.clock_topic
    others = [s._replace(stamp_ns=s.stamp_ns + by_ns) for s in samples if s.topic != clock]
    return [*others, *(s for s in samples if s.topic == clock)]


def latest(policy):
    return LivePolicy(POLICIES[policy](), TOPIC_MAP, CdrDecoder(), LatestSamples)


@policies
def test_latest_samples_before_the_clock_are_the_observation(policy, episode):
    driven, answers = latest(policy), []
    driven.event(started(episode, start_ns=episode.start_ns - 1))  # as a person starts it
    for k in range(len(episode)):
        *others, clock = shifted(observations(episode, k), EARLIER_NS)
        assert fed(driven, others) == []
        answers += driven.sample(clock)
    assert_answers(answers, episode, expected(policy, episode))
    assert (len(answers), driven.problem) == (len(episode), "")


def test_samples_after_the_clock_belong_to_the_next_observation(episode):
    driven = latest("mlp")
    fed(driven, shifted(observations(episode, 0), LATER_NS))
    driven.event(started(episode, start_ns=episode.start_ns + 1))
    *others, clock = shifted(observations(episode, 1), LATER_NS)
    fed(driven, others)  # they overtake the clock
    [answer] = driven.sample(clock)
    controller = PolicyController(mlp())
    values = {
        name: rows[1 if TOPIC_MAP.fields[name].topic == TOPIC_MAP.clock_topic else 0]
        for name, rows in episode.fields.items()
    }
    expected_twist = controller.answer(0, values)["twist"]
    np.testing.assert_array_equal(answer.command["twist"], expected_twist)


def test_topic_that_falls_silent_stops_the_answers_and_is_named(episode):
    driven = latest("mlp")
    driven.event(started(episode))
    answers = fed(driven, shifted(observations(episode, 0), EARLIER_NS))
    for k in range(1, 9):
        others = observations(episode, k)
        silent = [s for s in shifted(others, EARLIER_NS) if s.topic != "phase"]
        answers += fed(driven, silent)
    # Of 0.25 s: the sample of step 0 is 7 ms older than its step, and serves four more steps.
    assert len(answers) == 5
    assert driven.problem == "pick-1: no sample on phase within 0.25 s"
    assert len(fed(driven, shifted(observations(episode, 9), EARLIER_NS))) == 1
    assert driven.problem == ""


def test_repeated_clock_is_answered_again(episode):
    driven = latest("chunked")
    driven.event(started(episode))
    first = fed(driven, observations(episode, 0))
    again = fed(driven, observations(episode, 0))
    assert [a.stamp_ns for a in first] == [a.stamp_ns for a in again]
    np.testing.assert_array_equal(first[0].command["twist"], again[0].command["twist"])
