from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import (
    PERIOD_NS,
    TOPIC_MAP,
    VARIANTS,
    demonstration,
    libero_observation,
    step_values,
)

from curation_ros.core.errors import PolicyError
from policy_node.observation import (
    ObservationSpec,
    observation_from_columns,
    observation_from_json,
    observation_spec,
)
from policy_node.observation_terms import ObservedField

variants = pytest.mark.parametrize("variant", VARIANTS)


def without(mapping, key):
    return {k: v for k, v in mapping.items() if k != key}


def start_of(episode):
    return step_values(episode, 0)


def test_widths_are_those_of_the_design():
    assert {v: libero_observation(v).width for v in VARIANTS} == {"relative": 21, "fingers": 23}


def test_default_has_no_fingers():
    assert not any("finger" in name for name in libero_observation().columns)


@variants
def test_columns_are_named_once_each(variant):
    spec = libero_observation(variant)
    assert len(set(spec.columns)) == spec.width == len(spec.is_one_hot)
    assert [n for n, hot in zip(spec.columns, spec.is_one_hot, strict=True) if hot] == [
        f"phase={label}" for label in TOPIC_MAP.fields["phase"].labels
    ]


@variants
def test_step_equals_episode_bit_for_bit(variant):
    spec, episode = libero_observation(variant), demonstration(3)
    rows = spec.from_episode(episode)
    steps = [spec.from_step(step_values(episode, k), start_of(episode)) for k in range(60)]
    np.testing.assert_array_equal(rows, np.array(steps))


def test_columns_hold_what_their_names_say():
    episode = demonstration(4)
    spec = libero_observation("fingers")
    rows = dict(zip(spec.columns, spec.from_episode(episode).T, strict=True))
    fields = episode.fields
    np.testing.assert_array_equal(rows["eef_position[1]"], fields["eef_position"][:, 1])
    np.testing.assert_array_equal(rows["finger_position[0]"], fields["finger_position"][:, 0])
    assert (rows["bowl_position@start[2]"] == fields["bowl_position"][0, 2]).all()
    np.testing.assert_array_equal(
        rows["(plate_position@start - eef_position)[0]"],
        fields["plate_position"][0, 0] - fields["eef_position"][:, 0],
    )
    np.testing.assert_array_equal(rows["phase=LIFT"], fields["phase"][:, 0] == 3)


@variants
def test_start_effect_is_what_moving_an_object_changes(variant):
    spec, values = libero_observation(variant), step_values(demonstration(7), 5)
    before = spec.from_step(values, values)
    k = 0
    for name in spec.start_fields:
        for axis in range(3):
            start = {**values, name: values[name] + np.eye(3)[axis]}
            np.testing.assert_allclose(
                spec.from_step(values, start) - before, spec.start_effect[k], atol=1e-12
            )
            k += 1
    assert k == len(spec.start_effect)


def test_live_objects_are_not_seen():
    episode = demonstration(5)
    moved = replace(
        episode,
        fields={
            **episode.fields,
            "bowl_position": np.vstack([episode.fields["bowl_position"][:1], np.ones((59, 3))]),
        },
    )
    spec = libero_observation()
    np.testing.assert_array_equal(spec.from_episode(moved), spec.from_episode(episode))


def test_span_that_begins_later_keeps_the_start_of_the_whole_episode():
    episode, spec = demonstration(6), libero_observation()
    span = (41 * PERIOD_NS, 50 * PERIOD_NS)  # step 0 is one period after the start stamp
    part = spec.from_episode(episode, span)
    np.testing.assert_array_equal(part, spec.from_episode(episode)[40:50])
    assert not np.array_equal(part, spec.from_episode(episode.within(span)))


@variants
def test_missing_field_is_named(variant):
    spec, episode = libero_observation(variant), demonstration(0)
    values = step_values(episode, 0)
    for name in spec.fields:
        with pytest.raises(PolicyError, match=name):
            spec.from_episode(replace(episode, fields=without(episode.fields, name)))
        fewer = replace(TOPIC_MAP, fields=without(TOPIC_MAP.fields, name))
        with pytest.raises(PolicyError, match=f"no field '{name}'"):
            spec.check(fewer, "policy x")
    for name in spec.step_fields:
        with pytest.raises(PolicyError, match=name):
            spec.from_step(without(values, name), values)
    for name in spec.start_fields:
        with pytest.raises(PolicyError, match=name):
            spec.from_step(values, without(values, name))


def test_other_width_unit_or_phases_are_refused():
    spec = libero_observation()

    def changed(name, **changes):
        return replace(
            TOPIC_MAP,
            fields={**TOPIC_MAP.fields, name: replace(TOPIC_MAP.fields[name], **changes)},
        )

    with pytest.raises(PolicyError, match="2 values, expected 3"):
        spec.check(changed("eef_position", values=("a", "b")), "policy x")
    with pytest.raises(PolicyError, match="'mm', expected 'm'"):
        spec.check(changed("bowl_position", unit="mm"), "policy x")
    with pytest.raises(PolicyError, match=r"phases are PREGRASP, LIFT, expected PREGRASP, DES"):
        spec.check(changed("phase", labels=("PREGRASP", "LIFT")), "policy x")


@pytest.mark.parametrize("index", [-1.0, 6.0, 2.5, np.nan])
def test_unknown_phase_is_refused(index):
    values = {**step_values(demonstration(0), 0), "phase": [index]}
    with pytest.raises(PolicyError, match="phase index"):
        libero_observation().from_step(values, values)


def test_value_that_is_not_finite_is_refused_inside_the_span_only():
    episode, spec = demonstration(0), libero_observation()
    eef = episode.fields["eef_position"].copy()
    eef[50, 1] = np.nan
    broken = replace(episode, fields={**episode.fields, "eef_position": eef})
    with pytest.raises(PolicyError, match=r"eef_position\[1\] is nan in row 50"):
        spec.from_episode(broken)
    assert len(spec.from_episode(broken, (0, 30 * PERIOD_NS))) == 30


def test_span_without_steps_is_refused():
    with pytest.raises(PolicyError, match="none of its 60 steps"):
        libero_observation().from_episode(demonstration(0), (0, 10))


def test_wrong_shape_of_a_step_is_refused():
    values = step_values(demonstration(0), 0)
    with pytest.raises(PolicyError, match=r"'eef_position' has shape \(2,\), expected \(3,\)"):
        libero_observation().from_step({**values, "eef_position": [0.0, 1.0]}, values)


# --- any fields -----------------------------------------------------------------------------


def changed_map(**fields):
    """The topic map with other units, values or roles of some fields."""
    made = dict(TOPIC_MAP.fields)
    for name, changes in fields.items():
        made[name] = replace(made[name], **changes)
    return replace(TOPIC_MAP, fields=made)


def test_terms_over_any_fields_have_the_widths_of_the_topic_map():
    spec = observation_spec(
        ["joint_position", "eef_quat_xyzw@start", "bowl_position - eef_position"], TOPIC_MAP, "x"
    )
    assert spec.width == 7 + 4 + 3
    assert spec.columns[0] == "joint_position[0]"
    assert spec.columns[7] == "eef_quat_xyzw@start[0]"
    assert spec.columns[-1] == "(bowl_position - eef_position)[2]"
    assert spec.fields == ("joint_position", "eef_quat_xyzw", "bowl_position", "eef_position")
    assert spec.start_fields == ("eef_quat_xyzw",)
    episode = demonstration(1)
    rows = spec.from_episode(episode)
    live = episode.fields["bowl_position"] - episode.fields["eef_position"]
    np.testing.assert_array_equal(rows[:, -3:], live)


def test_phases_are_not_needed():
    spec = observation_spec(["eef_position"], TOPIC_MAP, "x")
    assert not spec.is_one_hot.any()
    assert spec.from_step({"eef_position": [1.0, 2.0, 3.0]}, {}).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize(
    ("terms", "words"),
    [
        (["nose"], "no field 'nose'; it has eef_position"),
        (["twist"], "field 'twist' has role action: a policy gives commands"),
        (["gripper"], "field 'gripper' has role gripper"),
        (["bowl_position - joint_position"], "'joint_position' has 7 in 'rad'; a difference"),
        (["bowl_position - finger_position"], "'finger_position' has 2 in 'm'"),
        (["phase@start"], "a phase has one value and stands alone"),
        (["phase - phase"], "a phase has one value and stands alone"),
        (["eef_position", "eef_position - phase"], "a phase has one value and stands alone"),
        ([], "at least one term"),
    ],
)
def test_term_that_makes_no_sense_is_refused(terms, words):
    with pytest.raises(PolicyError, match=words) as caught:
        observation_spec(terms, TOPIC_MAP, "variant x")
    assert str(caught.value).startswith("variant x: ")


def test_difference_of_lengths_in_other_units_is_refused():
    with pytest.raises(PolicyError, match="'m', 'bowl_position' has 3 in 'mm'"):
        observation_spec(
            ["eef_position - bowl_position"], changed_map(bowl_position={"unit": "mm"}), "x"
        )


def test_start_effect_is_per_metre_and_of_lengths_alone():
    topic_map = changed_map(bowl_position={"unit": "mm"}, plate_position={"unit": "cm"})
    terms = ["joint_position@start", "bowl_position@start", "plate_position@start"]
    spec = observation_spec([*terms, "bowl_position@start - bowl_position"], topic_map, "x")
    assert spec.start_effect.shape == (6, 7 + 3 + 3 + 3)
    assert (spec.start_effect[:, :7] == 0.0).all()  # angles do not move
    np.testing.assert_array_equal(spec.start_effect[:3, 7:10], 1000.0 * np.eye(3))
    np.testing.assert_array_equal(spec.start_effect[3:, 10:13], 100.0 * np.eye(3))
    np.testing.assert_array_equal(spec.start_effect[:3, 13:], 1000.0 * np.eye(3))
    late = observation_spec(["bowl_position - bowl_position@start"], topic_map, "x")
    np.testing.assert_array_equal(late.start_effect, -1000.0 * np.eye(3))


def test_units_are_compared_with_metres_and_radians():
    topic_map = changed_map(
        eef_position={"unit": "mm"}, joint_position={"unit": "deg"}, bowl_position={"unit": "N"}
    )
    terms = ["eef_position", "joint_position", "bowl_position", "plate_position", "phase"]
    spec = observation_spec(terms, topic_map, "x")
    np.testing.assert_allclose(
        spec.per_si, [1000.0] * 3 + [57.29577951308232] * 7 + [1.0] * 3 + [1.0] * 3 + [1.0] * 6
    )


def test_no_unit_may_be_written_as_nothing_or_as_1():
    spec = observation_spec(["eef_quat_xyzw"], TOPIC_MAP, "x")
    spec.check(changed_map(eef_quat_xyzw={"unit": ""}), "policy x")
    with pytest.raises(PolicyError, match="'rad', expected '1'"):
        spec.check(changed_map(eef_quat_xyzw={"unit": "rad"}), "policy x")


# --- on cards -------------------------------------------------------------------------------


@variants
def test_plain_data_and_columns_give_the_same_spec_back(variant):
    spec = libero_observation(variant)
    assert observation_from_json(spec.to_json(), "x") == spec
    assert observation_from_columns(spec.columns, "m", "x") == spec


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (["eef_position[0]", "eef"], "column 'eef', expected a name such as"),
        (["eef_position[1]"], r"found 'eef_position\[1\]', expected 'eef_position\[0\]'"),
        (["(a - b)[0]", "b[0]", "b[1]"], "found 3, expected 2"),
        ([], "at least one term"),
    ],
)
def test_columns_of_no_spec_are_refused(columns, words):
    with pytest.raises(PolicyError, match=words):
        observation_from_columns(columns, "m", "card x")


@pytest.mark.parametrize(
    "raw",
    [
        None,
        [],
        {"terms": ["a"]},
        {"terms": 5, "fields": []},
        {"terms": ["a"], "fields": [{"name": "a"}]},
        {"terms": ["a"], "fields": [{"name": "a", "width": "x", "unit": "", "labels": []}]},
        {"terms": ["a"], "fields": []},
        {"terms": ["a"], "fields": [{"name": "a", "width": 0, "unit": "", "labels": []}]},
    ],
)
def test_plain_data_of_no_spec_are_refused(raw):
    with pytest.raises(PolicyError, match="card x"):
        observation_from_json(raw, "card x")


def test_spec_whose_fields_are_others_than_its_terms_is_refused():
    with pytest.raises(PolicyError, match="the terms name a, the observed fields are b"):
        ObservationSpec(("a",), (ObservedField("b", 1),))
