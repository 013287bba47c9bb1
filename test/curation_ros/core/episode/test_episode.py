from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from episodes import copied, make_episode, shifted, topic_map, with_fields

from curation_ros.core.errors import EpisodeError

STEP_NS = 50_000_000
FIRST_NS = 10_000_000  # from the start stamp to the first step of make_episode


def test_length_and_rate_are_those_of_the_clock() -> None:
    episode = make_episode(n_steps=30, rate_hz=20.0)
    assert len(episode) == 30
    assert episode.rate_hz == 20.0
    late = replace(episode, stamps_ns=np.delete(episode.stamps_ns, [5, 6, 7]))
    assert late.rate_hz == 20.0  # the median does not mind a gap
    assert np.isnan(episode.steps(1).rate_hz)
    assert np.isnan(episode.steps(0).rate_hz)


def test_repr_shows_shapes_and_no_numbers() -> None:
    text = repr(make_episode(n_steps=30))
    assert text.startswith("Episode(pick-1, T=30, eef_position 3, ")
    assert len(text) < 200
    nameless = replace(make_episode(n_steps=30), name="")
    assert nameless.id[:8] in repr(nameless)


def test_missing_field_is_named_beside_those_there_are() -> None:
    with pytest.raises(EpisodeError, match=r"no field 'nose'; it has eef_position, ") as refused:
        make_episode(n_steps=30).field("nose")
    assert make_episode(n_steps=30).id in str(refused.value)


def test_phase_and_its_names_come_from_the_map() -> None:
    episode = make_episode()
    assert episode.phase_labels == topic_map().fields["phase"].labels != ()
    phase = episode.phase
    assert phase is not None
    assert phase.tolist() == episode.field("phase")[:, 0].tolist()
    without = topic_map().only(["eef_position", "twist"])
    bare = replace(episode, topic_map=without)
    assert bare.phase is None
    assert bare.phase_labels == ()


def test_state_and_action_are_the_columns_of_the_map() -> None:
    episode = make_episode()
    assert topic_map().state == ("eef_position", "finger_position", "bowl_position@start", "phase")
    state = episode.state
    assert state.shape == (len(episode), 3 + 2 + 3 + len(episode.phase_labels))
    np.testing.assert_array_equal(state[:, :3], episode.field("eef_position"))
    np.testing.assert_array_equal(
        state[:, 5:8], np.tile(episode.field("bowl_position")[0], (240, 1))
    )
    one_hot = state[:, 8:]
    assert one_hot.sum(axis=1).tolist() == [1.0] * len(episode)
    np.testing.assert_array_equal(one_hot.argmax(axis=1), episode.field("phase")[:, 0])
    np.testing.assert_array_equal(episode.action[:, 3:], episode.field("gripper"))


def test_state_and_action_are_made_once_shared_read_only_and_stay_at_home() -> None:
    episode = make_episode()
    assert episode.action is episode.action
    assert episode.state is episode.state
    with pytest.raises(ValueError, match="read-only"):
        episode.action[0] = 0.0
    fields = episode.fields["twist"]
    fields[0] = 1.0  # what they were made of stays the owner's
    sent = pickle.loads(pickle.dumps(episode))
    assert "action" not in vars(sent)
    assert sent.digest == episode.digest
    np.testing.assert_array_equal(sent.action[0, :3], 1.0)
    assert "action" not in vars(episode.steps(10))


def test_rate_of_the_recording_wins_where_steps_were_selected() -> None:
    episode = make_episode(rate_hz=20.0)
    thinned = replace(episode.steps(100), sampled_hz=250.0)
    assert thinned.rate_hz == 250.0
    assert thinned.steps(50).rate_hz == 250.0
    assert thinned.digest == episode.steps(100).digest


def test_unknown_phase_is_no_column_of_the_one_hot() -> None:
    episode = make_episode(n_steps=30)
    lost = with_fields(episode, phase=np.full((30, 1), -1.0))
    assert lost.columns(("phase",)).sum() == 0.0


def test_columns_of_nothing_are_refused() -> None:
    episode = make_episode(n_steps=30)
    for names, of in (((), episode), (("twist",), episode.steps(0))):
        with pytest.raises(EpisodeError, match="no columns"):
            of.columns(names)
    with pytest.raises(EpisodeError, match="no field 'nose'"):
        episode.columns(("twist", "nose@start"))


def test_steps_cut_every_array_and_keep_the_rest() -> None:
    episode = make_episode()
    cut = episode.steps(20, 5)
    assert len(cut) == 15
    assert (cut.id, cut.start_ns, cut.end_ns) == (episode.id, episode.start_ns, episode.end_ns)
    np.testing.assert_array_equal(cut.stamps_ns, episode.stamps_ns[5:20])
    for name, values in cut.fields.items():
        np.testing.assert_array_equal(values, episode.fields[name][5:20])


def test_span_and_within_are_inverse() -> None:
    episode = make_episode()
    span = episode.span(3, 9)
    assert span == (FIRST_NS + 3 * STEP_NS, FIRST_NS + 9 * STEP_NS)
    assert episode.within(span).stamps_ns.tolist() == episode.stamps_ns[3:10].tolist()
    assert len(episode.within((span[0] + 1, span[1] - 1))) == 5
    assert len(episode.within((0, episode.end_ns - episode.start_ns))) == len(episode)
    assert len(episode.within((0, 0))) == 0


def test_digest_is_equal_exactly_when_the_arrays_are() -> None:
    episode = make_episode(n_steps=30)
    assert copied(episode).digest == episode.digest
    turned = replace(episode, fields=dict(reversed(episode.fields.items())))
    assert turned.digest == episode.digest
    transposed = {k: np.asfortranarray(v) for k, v in episode.fields.items()}
    assert replace(episode, fields=transposed).digest == episode.digest
    nan = with_fields(episode, gripper=np.full((30, 1), np.nan))
    assert copied(nan).digest == nan.digest


def test_digest_changes_with_any_bit() -> None:
    episode = make_episode(n_steps=30)
    nudged = episode.field("twist").copy()
    nudged[7, 1] = np.nextafter(nudged[7, 1], 1.0)
    others = [
        with_fields(episode, twist=nudged),
        replace(episode, id=episode.id[::-1]),
        replace(episode, end_ns=episode.end_ns + 1),
        shifted(episode, 1),
        episode.steps(29),
        replace(episode, stamps_ns=episode.stamps_ns + 1),
        replace(episode, fields={k: v for k, v in episode.fields.items() if k != "twist"}),
    ]
    assert len({e.digest for e in [episode, *others]}) == len(others) + 1


def test_labels_have_no_place_in_an_episode() -> None:
    names = set(vars(make_episode(n_steps=30)))
    assert names == {
        "id", "name", "start_ns", "end_ns", "stamps_ns", "fields", "topic_map", "findings",
        "sampled_hz",
    }  # fmt: skip
