"""Episodes of arrays that never were in a bag: equal to built ones, with their faults found."""

from __future__ import annotations

import doctest
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from episodes import make_episode, make_reference, topic_map

from curation_ros.core.episode import arrays
from curation_ros.core.episode import episode as episode_module
from curation_ros.core.episode.arrays import draft_topic_map
from curation_ros.core.episode.episode import Episode
from curation_ros.core.episode.findings import Finding
from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers import SCORERS, Abstain
from curation_ros.dataset.episodes import read_episode

SAMPLE_BAG = Path(__file__).resolve().parents[4] / "bags" / "sample"
START_NS, STEP_NS = 1_781_000_000_000_000_000, 50_000_000
ROLES = {"hand": "effector", "velocity": "action", "grip": "gripper", "block": "object"}


def _fields(n: int = 40) -> dict[str, Any]:
    rng = np.random.default_rng(3)
    return {
        "hand": rng.normal(size=(n, 3)),
        "velocity": rng.normal(size=(n, 3)),
        "grip": np.where(np.arange(n) < n // 2, -1, 1),
        "block": rng.normal(size=(n, 3)).tolist(),
    }


def _again(episode: Episode, **changes: Any) -> Episode:
    """The episode made of its own arrays."""
    values: dict[str, Any] = {
        "fields": episode.fields,
        "meaning": episode.topic_map,
        "stamps_ns": episode.stamps_ns,
        "name": episode.name,
        "episode_id": episode.id,
        "window": (episode.start_ns, episode.end_ns),
        **changes,
    }
    return Episode.from_arrays(**values)


# --- equal to built ones ------------------------------------------------------------------------


def test_episode_of_the_arrays_of_the_sample_bag_is_equal_and_scores_equal_to_the_bit() -> None:
    built = read_episode(SAMPLE_BAG)
    again = _again(built)
    assert again.digest == built.digest
    assert again.findings == built.findings
    assert again.topic_map == built.topic_map
    assert (again.id, again.name) == (built.id, built.name)
    scored = 0
    for name, kind in SCORERS.items():
        scorer = kind().fit(make_reference(np.random.default_rng(7)))
        try:
            expected = scorer.look(built)
        except Abstain as reason:
            with pytest.raises(Abstain, match=f"^{reason}$"):
                scorer.look(again)
            continue
        assert scorer.look(again) == expected, name
        scored += 1
    assert scored >= 8


@pytest.mark.parametrize("as_text", [False, True])
def test_phase_may_be_labels_or_indices(as_text: bool) -> None:
    episode = make_episode(n_steps=240)
    phase: Any = episode.fields["phase"]
    if as_text:
        phase = [episode.phase_labels[int(k)] for k in phase[:, 0]]
    again = _again(episode, fields={**episode.fields, "phase": phase})
    np.testing.assert_array_equal(again.fields["phase"], episode.fields["phase"])


def test_values_are_copied_and_of_one_kind() -> None:
    fields = _fields()
    episode = Episode.from_arrays(fields, ROLES, rate_hz=20.0)
    kept = episode.fields["hand"].copy()
    fields["hand"][:] = 9.0
    np.testing.assert_array_equal(episode.fields["hand"], kept)
    for name, width in (("hand", 3), ("velocity", 3), ("grip", 1), ("block", 3)):
        assert episode.fields[name].shape == (40, width)
        assert episode.fields[name].dtype == np.float64
    assert episode.stamps_ns.dtype == np.int64


# --- faults -------------------------------------------------------------------------------------


def _built_findings(**changes: Any) -> tuple[Finding, ...]:
    n = 40
    stamps = START_NS + STEP_NS * np.arange(n, dtype=np.int64)
    episode = Episode.from_arrays(
        **{"fields": _fields(n), "meaning": ROLES, "stamps_ns": stamps, **changes}
    )
    assert (np.diff(episode.stamps_ns) > 0).all()
    return episode.findings


def test_sound_arrays_have_no_finding() -> None:
    assert _built_findings() == ()


def test_nan_is_found_at_its_first_row() -> None:
    fields = _fields()
    fields["velocity"][[7, 9], 1] = [np.nan, np.inf]
    [finding] = _built_findings(fields=fields)
    assert finding.id == "not-finite"
    assert finding.span == (7 * STEP_NS, 7 * STEP_NS)
    assert finding.message == "topic 'velocity': 2 samples with NaN or infinite values"


def test_gap_is_found_in_every_topic_as_all_share_the_clock() -> None:
    stamps = START_NS + STEP_NS * np.arange(40, dtype=np.int64)
    stamps[20:] += 300_000_000
    found = _built_findings(stamps_ns=stamps)
    assert {f.id for f in found} == {"gap"}
    assert len(found) == len(ROLES)
    assert found[0].span == (19 * STEP_NS, 20 * STEP_NS + 300_000_000)


def test_silence_at_the_ends_of_the_window_is_found() -> None:
    window = (START_NS - 10**9, START_NS + 39 * STEP_NS)
    assert {f.id for f in _built_findings(window=window)} == {"gap"}


def test_stamps_that_go_back_or_come_twice_are_sorted_and_found() -> None:
    stamps = START_NS + STEP_NS * np.arange(40, dtype=np.int64)
    stamps[[10, 11]] = stamps[[11, 10]]
    stamps[31] = stamps[30]
    found = _built_findings(stamps_ns=stamps)
    assert {f.id for f in found} == {"clock-back", "duplicate-stamp"}


def test_phase_that_is_not_in_the_map_is_found() -> None:
    fields = {"hand": np.zeros((4, 3)), "stage": ["reach", "reach", "dance", "grasp"]}
    roles = {"hand": "effector", "stage": "phase"}
    episode = Episode.from_arrays(fields, roles, rate_hz=20.0, phases=("reach", "grasp"))
    assert episode.fields["stage"][:, 0].tolist() == [0, 0, -1, 1]
    assert episode.phase_labels == ("reach", "grasp")
    [finding] = episode.findings
    assert (finding.id, finding.span) == ("unknown-phase", (2 * STEP_NS, 2 * STEP_NS))


def test_findings_of_the_caller_are_kept_in_order() -> None:
    told = Finding("recovered", "recovered", (0, 5))
    fields = _fields()
    fields["hand"][0] = np.nan
    assert [f.id for f in _built_findings(fields=fields, findings=[told])] == [
        "not-finite",
        "recovered",
    ]


# --- identity and time --------------------------------------------------------------------------


def test_id_follows_from_the_content_unless_given() -> None:
    one, two = (Episode.from_arrays(_fields(), ROLES, rate_hz=20.0, name=n) for n in "ab")
    assert one.id == two.id
    assert Episode.from_arrays(_fields(39), ROLES, rate_hz=20.0).id != one.id
    assert Episode.from_arrays(_fields(), ROLES, rate_hz=20.0, episode_id="x").id == "x"


def test_rate_counts_from_the_window() -> None:
    episode = Episode.from_arrays(
        _fields(), ROLES, rate_hz=30.0, window=(START_NS, START_NS + 10**10)
    )
    assert episode.stamps_ns[0] == START_NS
    assert episode.rate_hz == pytest.approx(30.0)
    # Rounded, not summed up: after an hour the stamps still are those of the rate.
    assert int(episode.stamps_ns[-1]) - START_NS == round(39e9 / 30)
    assert Episode.from_arrays(_fields(), ROLES, rate_hz=30.0).start_ns == 0


def test_rows_outside_of_the_window_are_left_out() -> None:
    stamps = START_NS + STEP_NS * np.arange(40, dtype=np.int64)
    window = (START_NS + 5 * STEP_NS, START_NS + 20 * STEP_NS)
    episode = Episode.from_arrays(_fields(), ROLES, stamps_ns=stamps, window=window)
    np.testing.assert_array_equal(episode.stamps_ns, stamps[5:21])
    assert (episode.start_ns, episode.end_ns) == window


def test_arrays_without_a_row_are_an_episode_without_a_step() -> None:
    episode = Episode.from_arrays({"hand": np.zeros((0, 3))}, {"hand": "effector"}, rate_hz=20.0)
    assert len(episode) == 0
    assert [f.id for f in episode.findings] == ["missing-topic"]


# --- the drafted map ----------------------------------------------------------------------------


def test_drafted_map_has_what_scorers_expect_and_can_be_stored() -> None:
    fields = {**_fields(), "stage": ["a"] * 40, "fingers": np.zeros((40, 2))}
    roles = {**ROLES, "stage": "phase", "fingers": "observation"}
    gripper = {"opens": -1, "fingers": "fingers"}
    drafted = draft_topic_map(fields, roles, phases=("a", "b"), gripper=gripper)
    assert drafted.clock == "hand"
    assert drafted.state == ("hand", "stage", "fingers", "block@start")
    assert drafted.action == ("velocity", "grip")
    assert drafted.gripper is not None
    assert (drafted.gripper.field, drafted.gripper.fingers) == ("grip", "fingers")
    assert topic_map_from_json(drafted.to_json()) == drafted
    episode = Episode.from_arrays(fields, drafted, rate_hz=20.0)
    assert episode.state.shape == (40, 3 + 2 + 2 + 3)
    assert episode.action.shape == (40, 4)


def test_clock_is_any_field_where_no_role_says_more() -> None:
    assert draft_topic_map(_fields(), dict.fromkeys(ROLES, "observation")).clock == "hand"
    roles = {**dict.fromkeys(ROLES, "observation"), "grip": "clock"}
    assert draft_topic_map(_fields(), roles).clock == "grip"


# --- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"meaning": {**ROLES, "nose": "object"}}, "roles: 'nose' is no field; there are hand, "),
        ({"meaning": {"hand": "effector"}}, "roles: none for the field 'velocity'"),
        ({"meaning": {**ROLES, "hand": "leg"}}, "role 'leg' is none of clock, observation"),
        ({"meaning": {**ROLES, "block": "phase"}}, "'block' is a phase: give the names"),
        ({"gripper": {"opens": 0}}, "opens must be -1 or 1, found 0"),
        ({"gripper": {"open": 1}}, "unknown key 'open'"),
        (
            {"meaning": {**ROLES, "grip": "action"}, "gripper": {}},
            "0 fields have the role gripper",
        ),
    ],
)
def test_roles_that_make_no_map_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Episode.from_arrays(**{"fields": _fields(), "meaning": ROLES, "rate_hz": 20.0, **changes})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"rate_hz": None}, "expected either stamps_ns or rate_hz"),
        ({"stamps_ns": np.arange(40)}, "expected either stamps_ns or rate_hz"),
        ({"rate_hz": 0.0}, "rate_hz is 0.0, expected a positive number"),
        ({"rate_hz": float("nan")}, "rate_hz is nan"),
        ({"rate_hz": None, "stamps_ns": np.arange(39)}, r"shape \(39,\) and type int64, expected"),
        ({"rate_hz": None, "stamps_ns": np.arange(40.0)}, "type float64, expected"),
        ({"rate_hz": None, "stamps_ns": np.arange(40) - 1}, "from -1 to 38"),
        ({"rate_hz": None, "stamps_ns": np.full(40, 2**63, np.uint64)}, "expected 0 to 2"),
        ({"window": (5, 4)}, r"window is \(5, 4\)"),
        ({"fields": {}}, "roles: 'hand' is no field"),
        ({"fields": {**_fields(), "hand": np.zeros((39, 3))}}, "hand 39, velocity 40"),
        ({"fields": {**_fields(), "hand": 7.0}}, "field 'hand' is no array of rows"),
        ({"fields": {**_fields(), "hand": np.zeros((40, 3, 1))}}, r"shape \(40, 3, 1\)"),
        (
            {"fields": {**_fields(), "hand": [["x"]] * 40}},
            "field 'hand' has <U1, expected numbers",
        ),
        ({"fields": {**_fields(), "hand": np.zeros((40, 3), complex)}}, "has complex128"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(changes: dict[str, Any], said: str) -> None:
    with pytest.raises((EpisodeError, ConfigError), match=said):
        Episode.from_arrays(**{"fields": _fields(), "meaning": ROLES, "rate_hz": 20.0, **changes})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"success": np.ones(240)},
            "field 'success' is not in the topic map; it has eef_position",
        ),
        ({"bowl_position": None}, "no field 'bowl_position'; there are eef_position"),
        ({"twist": np.zeros((240, 2))}, r"'twist' has shape \(240, 2\), expected \(240, 3\)"),
        ({"phase": np.full(240, 6)}, "phase 'phase' has other values than -1 to 5"),
        ({"phase": np.full(240, 0.5)}, "phase 'phase' has other values than -1 to 5"),
    ],
)
def test_arrays_that_a_given_map_does_not_have_are_refused(
    change: dict[str, Any], said: str
) -> None:
    episode = make_episode(n_steps=240)
    fields = {k: v for k, v in {**episode.fields, **change}.items() if v is not None}
    with pytest.raises(EpisodeError, match=said):
        _again(episode, fields=fields)


def test_two_fields_that_read_one_value_must_agree() -> None:
    shipped = topic_map()
    spec = shipped.fields["eef_position"]
    twice = replace(
        shipped,
        fields={**shipped.fields, "height": replace(spec, name="height", values=spec.values[2:])},
    )
    episode = make_episode(n_steps=240)
    height = episode.fields["eef_position"][:, 2]
    again = _again(episode, meaning=twice, fields={**episode.fields, "height": height})
    np.testing.assert_array_equal(again.fields["height"][:, 0], height)
    with pytest.raises(EpisodeError, match=r"'height' has other values at 'pose.position.z'"):
        _again(episode, meaning=twice, fields={**episode.fields, "height": height + 1})


@pytest.mark.parametrize("module", [arrays, episode_module])
def test_examples_run(module: Any) -> None:
    assert doctest.testmod(module, extraglobs={"np": np}).failed == 0
    assert doctest.testmod(module).attempted > 0
