from __future__ import annotations

from dataclasses import replace

import pytest
import yaml
from demonstrations import RELATIVE, TOPIC_MAP, VARIANTS

from curation_ros.core.episode.topic_map import topic_map_from_json
from curation_ros.core.errors import ConfigError, PolicyError
from policy_node.action import CommandTerm
from policy_node.settings import DEFAULTS, TrainingSettings
from policy_node.variants import (
    choose_variant,
    draft_variant,
    read_training_config,
)


def config(tmp_path, **raw):
    path = tmp_path / "training.yaml"
    path.write_text(yaml.safe_dump(raw, sort_keys=False))
    return read_training_config(path)


def without(*names):
    """The topic map of LIBERO without some fields."""
    fields = {name: spec for name, spec in TOPIC_MAP.fields.items() if name not in names}
    return replace(TOPIC_MAP, fields=fields)


def test_variants_of_libero_are_two_and_fit_its_topic_map():
    assert list(VARIANTS) == ["relative", "fingers"]
    for variant in VARIANTS.values():
        variant.check(TOPIC_MAP, "x")
        assert variant.action == (CommandTerm("twist", (0.2,)), CommandTerm("gripper"))
    added = set(VARIANTS["fingers"].observation) - set(RELATIVE.observation)
    assert added == {"finger_position"}


def test_settings_that_are_left_out_have_their_defaults(tmp_path):
    assert config(tmp_path).settings == DEFAULTS
    made = config(tmp_path, settings={"steps": 7, "lr": 1, "hidden": [8, 9]}).settings
    assert made == TrainingSettings(steps=7, lr=1.0, hidden=(8, 9))


def test_numbers_are_one_or_one_per_value_or_from_the_data(tmp_path):
    action = {
        "a": {"scale": 2},
        "b": {"scale": [1.0, 2.0], "center": "data"},
        "c": {},
        "d": None,
        "e": {"scale": "data", "center": [0.5, -1]},
    }
    made = config(tmp_path, variants={"x": {"observation": ["o"], "action": action}})
    assert made.variant("x").action == (
        CommandTerm("a", (2.0,)),
        CommandTerm("b", (1.0, 2.0), ()),
        CommandTerm("c"),
        CommandTerm("d"),
        CommandTerm("e", (), (0.5, -1.0)),
    )


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ({"nose": 1}, "unknown key 'nose'; known are settings, variants"),
        ({"settings": {"nose": 1}}, "settings: unknown key 'nose'; known are steps"),
        ({"settings": {"steps": "many"}}, "'steps' is 'many', expected a whole number"),
        ({"settings": {"steps": 1.5}}, "'steps' is 1.5, expected a whole number"),
        ({"settings": {"lr": True}}, "'lr' is True, expected a number"),
        ({"settings": {"hidden": 256}}, "'hidden' is 256, expected a list"),
        ({"settings": {"hidden": [1.5]}}, r"'hidden' is \[1.5\], expected a list"),
        ({"settings": {"lr": -1}}, "lr is -1.0, expected more than 0"),
        ({"variants": 5}, "variants are 5"),
        ({"variants": {"x": 5}}, "variant 'x': expected a mapping"),
        ({"variants": {"x": {"action": {"a": {}}}}}, "variant 'x': 'observation' is None"),
        ({"variants": {"x": {"observation": ["o"]}}}, "variant 'x': 'action' is None"),
        ({"variants": {"x": {"observation": [1], "action": {"a": {}}}}}, "list of terms"),
        ({"variants": {"x": {"observation": ["o"], "action": ["a"]}}}, "mapping of fields"),
    ],
)
def test_file_that_makes_no_sense_is_refused(tmp_path, raw, words):
    with pytest.raises(ConfigError, match=words) as caught:
        config(tmp_path, **raw)
    assert str(tmp_path / "training.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"scale": 0}, "command 'a': scale is 0, expected numbers above 0"),
        ({"scale": [1.0, -2.0]}, "expected numbers above 0"),
        ({"scale": "large"}, "scale is 'large', expected a number, one number per value"),
        ({"scale": []}, "one number per value"),
        ({"scale": True}, "one number per value"),
        ({"center": float("nan")}, "center is nan"),
        ({"nose": 1}, "command 'a': unknown key 'nose'; known are scale, center"),
        (0.2, "command 'a': expected a mapping, found 0.2"),
    ],
)
def test_command_that_makes_no_sense_is_refused(tmp_path, numbers, words):
    with pytest.raises(ConfigError, match=words):
        config(tmp_path, variants={"x": {"observation": ["o"], "action": {"a": numbers}}})


@pytest.mark.parametrize("text", ["{", "5", "a: 2026-13-45"])
def test_file_that_is_no_yaml_or_no_mapping_is_refused(tmp_path, text):
    path = tmp_path / "training.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="training config") as caught:
        read_training_config(path)
    assert "\n" not in str(caught.value)


def test_missing_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        read_training_config(tmp_path / "nothing.yaml")


def test_unknown_variant_is_refused_with_those_that_there_are(tmp_path):
    with pytest.raises(ConfigError, match="no variant 'nose'; its variants are none"):
        config(tmp_path).variant("nose")


def test_first_variant_that_fits_is_taken(tmp_path):
    variants = {
        "other": {"observation": ["nose"], "action": {"twist": {}}},
        "units": {"observation": ["eef_position - finger_position"], "action": {"twist": {}}},
        "scales": {"observation": ["eef_position"], "action": {"twist": {"scale": [1.0, 2.0]}}},
        "fits": {"observation": ["eef_position"], "action": {"twist": {"center": "data"}}},
        "also": {"observation": ["eef_position"], "action": {"twist": {}}},
    }
    made = config(tmp_path, variants=variants)
    assert made.fitting(TOPIC_MAP).name == "fits"
    assert made.fitting(without("twist")) is None


# --- drafts ---------------------------------------------------------------------------------


def test_draft_takes_fields_by_their_roles():
    made = draft_variant(TOPIC_MAP)
    assert made.observation == (
        "eef_position",
        "eef_quat_xyzw",
        "joint_position",
        "finger_position",
        "bowl_position",
        "plate_position",
        "phase",
    )
    assert made.action == (CommandTerm("twist"), CommandTerm("gripper"))
    made.check(TOPIC_MAP, "x")


def test_draft_centers_commands_that_are_places():
    raw = {
        "fields": {
            name: {
                "topic": name,
                "type": "sensor_msgs/msg/JointState",
                "role": role,
                "values": ["position.a"],
                "unit": unit,
            }
            for name, role, unit in (
                ("joints", "clock", "rad"),
                ("goal", "action", "rad"),
                ("speed", "action", "rad/s"),
                ("hand", "gripper", ""),
            )
        }
    }
    made = draft_variant(topic_map_from_json(raw))
    assert made.observation == ("joints",)
    # The meaning of the hand's numbers is not declared, so it is a command like any other.
    assert made.action == (
        CommandTerm("goal", center=()),
        CommandTerm("speed"),
        CommandTerm("hand", center=()),
    )
    raw["gripper"] = {"field": "hand", "fingers": "joints"}
    assert draft_variant(topic_map_from_json(raw)).action[2] == CommandTerm("hand")


def test_draft_is_a_config_that_is_read_back(tmp_path):
    path = tmp_path / "training.yaml"
    made = draft_variant(TOPIC_MAP)
    centered = replace(made, action=(CommandTerm("twist", (0.1, 1.0, 2.0), ()), *made.action[1:]))
    for variant in (made, centered, RELATIVE):
        path.write_text(variant.to_yaml())
        assert read_training_config(path).variants == {variant.name: variant}


def test_robot_without_commands_or_observations_has_no_draft():
    with pytest.raises(PolicyError, match=r"no field to command; .* role action or gripper"):
        draft_variant(without("twist", "gripper"))
    with pytest.raises(PolicyError, match=r"no field to observe; .* role clock, effector"):
        draft_variant(replace(TOPIC_MAP.only(["twist"])))


# --- the variant that a person asks for -----------------------------------------------------


def chosen(tmp_path, **asked):
    variants = {"some": {"observation": ["eef_position"], "action": {"twist": {}}}}
    return choose_variant(config(tmp_path, variants=variants), TOPIC_MAP, **asked)


def test_first_fitting_variant_is_chosen_else_a_draft(tmp_path):
    assert chosen(tmp_path).name == "some"
    assert chosen(tmp_path, name="draft") == draft_variant(TOPIC_MAP)
    assert choose_variant(config(tmp_path), TOPIC_MAP) == draft_variant(TOPIC_MAP)


def test_observation_and_action_are_replaced_and_the_name_says_so(tmp_path):
    made = chosen(tmp_path, observation="phase, bowl_position@start - eef_position")
    assert made.observation == ("phase", "bowl_position@start - eef_position")
    assert (made.name, made.action) == ("some-changed", (CommandTerm("twist"),))
    made = chosen(tmp_path, action="twist=0.2, gripper,b=data")
    assert made.action == (CommandTerm("twist", (0.2,)), CommandTerm("gripper"), CommandTerm("b"))
    assert (made.name, made.observation) == ("some-changed", ("eef_position",))


@pytest.mark.parametrize("text", ["twist,", "=0.2", "twist=fast", "twist=0", "twist=nan"])
def test_action_that_makes_no_sense_is_refused(tmp_path, text):
    with pytest.raises(ConfigError, match="action"):
        chosen(tmp_path, action=text)
