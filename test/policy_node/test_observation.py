from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from demonstrations import PERIOD_NS, TOPIC_MAP, demonstration, step_values

from curation_ros.core.errors import PolicyError
from policy_node.observation import VARIANTS, ObservationSpec

variants = pytest.mark.parametrize("variant", VARIANTS)


def without(mapping, key):
    return {k: v for k, v in mapping.items() if k != key}


def start_of(episode):
    return step_values(episode, 0)


def test_widths_are_those_of_the_design():
    assert {v: ObservationSpec(v).width for v in VARIANTS} == {"relative": 21, "fingers": 23}


def test_default_has_no_fingers():
    assert not any("finger" in name for name in ObservationSpec().columns)


@variants
def test_columns_are_named_once_each(variant):
    spec = ObservationSpec(variant)
    assert len(set(spec.columns)) == spec.width == len(spec.is_one_hot)
    assert [n for n, hot in zip(spec.columns, spec.is_one_hot, strict=True) if hot] == [
        f"phase={label}" for label in spec.phase_labels
    ]


@variants
def test_step_equals_episode_bit_for_bit(variant):
    spec, episode = ObservationSpec(variant), demonstration(3)
    rows = spec.from_episode(episode)
    steps = [spec.from_step(step_values(episode, k), start_of(episode)) for k in range(60)]
    np.testing.assert_array_equal(rows, np.array(steps))


def test_columns_hold_what_their_names_say():
    episode = demonstration(4)
    spec = ObservationSpec("fingers")
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
    spec, values = ObservationSpec(variant), step_values(demonstration(7), 5)
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
    spec = ObservationSpec()
    np.testing.assert_array_equal(spec.from_episode(moved), spec.from_episode(episode))


def test_span_that_begins_later_keeps_the_start_of_the_whole_episode():
    episode, spec = demonstration(6), ObservationSpec()
    span = (41 * PERIOD_NS, 50 * PERIOD_NS)  # step 0 is one period after the start stamp
    part = spec.from_episode(episode, span)
    np.testing.assert_array_equal(part, spec.from_episode(episode)[40:50])
    assert not np.array_equal(part, spec.from_episode(episode.within(span)))


@variants
def test_missing_field_is_named(variant):
    spec, episode = ObservationSpec(variant), demonstration(0)
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
    spec = ObservationSpec()

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
        ObservationSpec().from_step(values, values)


def test_value_that_is_not_finite_is_refused_inside_the_span_only():
    episode, spec = demonstration(0), ObservationSpec()
    eef = episode.fields["eef_position"].copy()
    eef[50, 1] = np.nan
    broken = replace(episode, fields={**episode.fields, "eef_position": eef})
    with pytest.raises(PolicyError, match=r"eef_position\[1\] is nan in row 50"):
        spec.from_episode(broken)
    assert len(spec.from_episode(broken, (0, 30 * PERIOD_NS))) == 30


def test_span_without_steps_is_refused():
    with pytest.raises(PolicyError, match="none of its 60 steps"):
        ObservationSpec().from_episode(demonstration(0), (0, 10))


def test_wrong_shape_of_a_step_is_refused():
    values = step_values(demonstration(0), 0)
    with pytest.raises(PolicyError, match=r"'eef_position' has shape \(2,\), expected \(3,\)"):
        ObservationSpec().from_step({**values, "eef_position": [0.0, 1.0]}, values)


def test_unknown_variant_is_refused():
    with pytest.raises(PolicyError, match="'pixels' is none of relative, fingers"):
        ObservationSpec("pixels")
