from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from curation_ros.bags import CdrDecoder
from curation_ros.core.episode.topic_map import (
    ROLES,
    TopicMap,
    read_topic_map,
    topic_map_from_json,
)
from curation_ros.core.errors import ConfigError

CONFIG = Path(__file__).resolve().parents[4] / "config" / "topics.yaml"
#: Of the file that the package ships; bags and policies carry it, so a change must be meant.
SHIPPED_HASH = "3469afe22dd720a7"


def _raw() -> dict[str, Any]:
    return {
        "max_gap_s": 0.5,
        "fields": {
            "tip": {
                "topic": "tip",
                "type": "geometry_msgs/msg/PoseStamped",
                "role": "effector",
                "values": ["pose.position.x"],
                "unit": "m",
            },
            "arm": {
                "topic": "joints",
                "type": "sensor_msgs/msg/JointState",
                "role": "observation",
                "values": ["position.j1", "position.j2"],
                "interpolate": True,
            },
            "fingers": {
                "topic": "joints",
                "type": "sensor_msgs/msg/JointState",
                "role": "observation",
                "values": ["position.f1"],
            },
            "phase": {
                "topic": "phase",
                "type": "diagnostic_msgs/msg/DiagnosticArray",
                "role": "phase",
                "values": ["status.0.message"],
                "labels": ["A", "B"],
            },
            "twist": {
                "topic": "twist",
                "type": "geometry_msgs/msg/Twist",
                "role": "action",
                "values": ["linear.x"],
                "stamp": "source",
            },
            "grip": {
                "topic": "grip",
                "type": "sensor_msgs/msg/JointState",
                "role": "gripper",
                "values": ["position.g"],
            },
        },
        "gripper": {
            "field": "grip",
            "opens": 1,
            "kind": "continuous",
            "open_value": 1.0,
            "closed_value": 0.0,
            "fingers": "fingers",
        },
        "state": ["tip", "tip@start", "phase"],
        "action": ["twist", "grip"],
        "command": {"frame": "world", "scale": 0.05},
    }


def _changed(path: str, value: Any) -> dict[str, Any]:
    """The raw map with one key set (`...` removes it)."""
    raw = copy.deepcopy(_raw())
    *parents, last = path.split(".")
    node = raw
    for key in parents:
        node = node[key]
    if value is ...:
        del node[last]
    else:
        node[last] = value
    return raw


# --- reading ------------------------------------------------------------------------------------


def test_shipped_map_loads_and_every_path_exists() -> None:
    shipped = read_topic_map(CONFIG)
    assert shipped.clock == "eef_position"
    assert shipped.clock_topic == "eef_pose"
    assert len(shipped.topics) == 7
    assert shipped.command_topics == {"command/twist", "command/gripper"}
    assert shipped.source_stamped == frozenset()
    decoder = CdrDecoder()
    for spec in shipped.fields.values():
        assert decoder.has_header(spec.type)
        columns = decoder.decode(spec.type, spec.values, [])
        assert [len(c) for c in columns] == [0] * len(spec.values)


def test_shipped_map_has_the_hash_that_bags_and_policies_carry() -> None:
    assert read_topic_map(CONFIG).hash == SHIPPED_HASH


def test_every_key_is_read() -> None:
    found = topic_map_from_json(_raw())
    assert list(found.fields) == ["tip", "arm", "fingers", "phase", "twist", "grip"]
    arm = found.fields["arm"]
    assert (arm.values, arm.interpolate, arm.stamp) == (
        ("position.j1", "position.j2"),
        True,
        "header",
    )
    assert found.topics == {
        "tip": "geometry_msgs/msg/PoseStamped",
        "joints": "sensor_msgs/msg/JointState",
        "phase": "diagnostic_msgs/msg/DiagnosticArray",
        "twist": "geometry_msgs/msg/Twist",
        "grip": "sensor_msgs/msg/JointState",
    }
    assert found.gripper is not None
    assert (found.gripper.opens, found.gripper.fingers) == (1, "fingers")
    assert (found.max_gap_s, found.state[1]) == (0.5, "tip@start")
    assert found.source_stamped == {"twist"}
    assert found.command["scale"] == 0.05
    assert [s.name for s in found.with_role("action", "gripper")] == ["twist", "grip"]


def test_clock_is_what_is_named_else_the_role_else_the_effector() -> None:
    assert topic_map_from_json(_raw()).clock == "tip"
    assert topic_map_from_json(_changed("fields.arm.role", "clock")).clock == "arm"
    assert topic_map_from_json({**_raw(), "clock": "fingers"}).clock == "fingers"


@pytest.mark.parametrize("raw", [_raw(), yaml.safe_load(CONFIG.read_text())])
def test_map_survives_json(raw: dict[str, Any]) -> None:
    first = topic_map_from_json(raw)
    again = topic_map_from_json(json.loads(json.dumps(first.to_json())))
    assert again == first
    assert again.hash == first.hash
    assert list(again.fields) == list(first.fields)


# --- its hash -----------------------------------------------------------------------------------


def test_equal_maps_have_one_hash() -> None:
    plain = topic_map_from_json(_raw())
    turned = topic_map_from_json(dict(reversed(_raw().items())))
    whole = topic_map_from_json(_changed("gripper.open_value", 1))
    spelt = topic_map_from_json(_changed("fields.tip.stamp", "header"))
    for other in (turned, whole, spelt):
        assert other == plain
        assert other.hash == plain.hash


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("max_gap_s", 0.25),
        ("fields.tip.unit", "mm"),
        ("fields.tip.values", ["pose.position.y"]),
        ("fields.arm.interpolate", False),
        ("fields.arm.values", ["position.j2", "position.j1"]),
        ("fields.phase.labels", ["B", "A"]),
        ("fields.tip.topic", "tip2"),
        ("clock", "arm"),
        ("gripper.fingers", ""),
        ("state", ["tip"]),
        ("command.scale", 0.1),
    ],
)
def test_any_change_of_meaning_changes_the_hash(path: str, value: Any) -> None:
    assert topic_map_from_json(_changed(path, value)).hash != topic_map_from_json(_raw()).hash


# --- a part of it -------------------------------------------------------------------------------


def test_only_keeps_the_fields_that_are_named_in_the_order_of_the_map() -> None:
    part = topic_map_from_json(_raw()).only(["twist", "tip"])
    assert list(part.fields) == ["tip", "twist"]
    assert (part.clock, part.gripper, part.state, part.action) == ("tip", None, (), ())
    assert part.max_gap_s == 0.5


def test_only_without_the_clock_takes_the_first_field() -> None:
    assert topic_map_from_json(_raw()).only(["phase", "arm"]).clock == "arm"


def test_only_of_a_field_that_does_not_exist_names_those_that_do() -> None:
    found = topic_map_from_json(_raw())
    with pytest.raises(ConfigError, match=r"no field 'nose'; it has tip, arm, fingers, phase"):
        found.only(["tip", "nose"])
    with pytest.raises(ConfigError, match=r"no field"):
        found.only([])


# --- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "value", "parts"),
    [
        ("fields", ..., ["'fields'"]),
        ("fields", [], ["'fields'"]),
        ("fields", {}, ["no clock"]),
        ("speed", 3, ["'speed'", "max_gap_s"]),
        ("fields.tip", "tip", ["'tip'", "mapping"]),
        ("fields.tip.topic", ..., ["'tip'", "'topic'", "missing"]),
        ("fields.tip.type", "", ["'tip'", "'type'", "missing"]),
        ("fields.tip.role", ..., ["'tip'", "'role'", "missing"]),
        ("fields.tip.values", [], ["'tip'", "'values'", "missing"]),
        ("fields.tip.colour", "red", ["'tip'", "'colour'", "interpolate"]),
        ("fields.tip.role", "nose", ["'tip'", "'nose'", *ROLES]),
        ("fields.tip.role", ["clock"], ["'tip'", "role"]),
        ("fields.tip.stamp", "now", ["'tip'", "'now'", "header, source"]),
        ("fields.tip.values", "pose.position.x", ["'tip'", "'values'", "list"]),
        ("fields.tip.values", [1, 2], ["'tip'", "'values'", "[1, 2]"]),
        ("fields.tip.values", 5, ["'tip'", "'values'", "5"]),
        ("fields.tip.type", "PoseStamped", ["'tip'", "'PoseStamped'", "package/msg/Type"]),
        ("fields.tip.type", "a/srv/B", ["'tip'", "'a/srv/B'", "package/msg/Type"]),
        ("fields.tip.interpolate", "no", ["'tip'", "'interpolate'", "'no'", "true or false"]),
        ("fields.phase.labels", ..., ["'phase'", "'labels'"]),
        ("fields.phase.labels", "AB", ["'phase'", "'labels'", "'AB'"]),
        ("fields.phase.labels", [True, False], ["'phase'", "'labels'", "[True, False]"]),
        ("fields.phase.labels", 3, ["'phase'", "'labels'", "3"]),
        ("fields.phase.values", ["a", "b"], ["'phase'", "one value"]),
        ("fields.fingers.type", "a/msg/B", ["'joints'", "two types", "a/msg/B"]),
        ("fields.fingers.stamp", "source", ["'joints'", "source"]),
        ("fields.tip.role", "observation", ["no clock"]),
        ("clock", "nose", ["clock", "'nose'"]),
        ("state", ["tip", "nose"], ["state", "'nose'"]),
        ("action", ["nose@start"], ["action", "'nose@start'"]),
        ("state", "tip", ["state", "list", "'tip'"]),
        ("state", 5, ["state", "list", "5"]),
        ("max_gap_s", 0, ["max_gap_s", "0"]),
        ("max_gap_s", -1, ["max_gap_s", "-1"]),
        ("max_gap_s", "soon", ["max_gap_s", "'soon'"]),
        ("max_gap_s", float("nan"), ["max_gap_s", "nan"]),
        ("max_gap_s", float("inf"), ["max_gap_s", "inf"]),
        ("command", 5, ["command", "mapping", "5"]),
        ("command", {"since": {1, 2}}, ["command", "texts and numbers", "set"]),
        ("gripper", "grip", ["gripper", "mapping", "'grip'"]),
        ("gripper", {}, ["gripper", "'field'", "missing"]),
        ("gripper.colour", 1, ["gripper", "'colour'"]),
        ("gripper.field", "arm", ["gripper", "'arm'", "role gripper"]),
        ("gripper.field", ["grip"], ["gripper", "['grip']"]),
        ("gripper.fingers", "nose", ["gripper", "'nose'"]),
        ("gripper.opens", 0, ["gripper", "opens", "0"]),
        ("gripper.opens", True, ["gripper", "opens", "True"]),
        ("gripper.opens", "left", ["gripper", "opens", "'left'"]),
        ("gripper.kind", "soft", ["gripper", "kind", "'soft'", "binary", "continuous"]),
        ("gripper.opens", -1, ["gripper", "opens -1 contradicts"]),
        ("gripper.open_value", 0.0, ["gripper", "contradicts"]),
        ("gripper.open_value", "wide", ["gripper", "open_value", "'wide'"]),
    ],
)
def test_map_that_makes_no_sense_is_refused_by_file_and_key(
    path: str, value: Any, parts: list[str]
) -> None:
    with pytest.raises(ConfigError) as refused:
        topic_map_from_json(_changed(path, value), "my_robot.yaml")
    message = str(refused.value)
    assert message.startswith("my_robot.yaml")
    assert "\n" not in message
    for part in parts:
        assert part in message


@pytest.mark.parametrize("raw", [None, 5, "text", [], {}, {1: 2, "a": 3, None: 4}])
def test_anything_but_a_map_is_refused(raw: object) -> None:
    with pytest.raises(ConfigError, match="expected a mapping with the key 'fields'"):
        topic_map_from_json(raw)


def test_unknown_keys_of_any_type_are_refused() -> None:
    with pytest.raises(ConfigError, match="unknown key"):
        topic_map_from_json({**_raw(), 1: 2, None: 3, "zzz": 4})


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"fields: [", "is not YAML"),
        (b"\xff\xfe\x00", "is not YAML"),
        (b"a: 2020-13-45", "is not YAML"),
        (b"a: !!python/object:os.system x", "is not YAML"),
        (b"", "expected a mapping"),
        (b"fields: 3", "expected a mapping"),
    ],
)
def test_file_that_is_no_map_is_refused_by_its_name(
    tmp_path: Path, content: bytes, said: str
) -> None:
    path = tmp_path / "robot.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=said) as refused:
        read_topic_map(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_file_that_cannot_be_read_is_refused_by_its_name(tmp_path: Path) -> None:
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(ConfigError, match=str(path)):
            read_topic_map(path)


def test_map_that_was_read_is_the_one_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    path.write_text(yaml.safe_dump(_raw(), sort_keys=False))
    found: TopicMap = read_topic_map(path)
    assert found == topic_map_from_json(_raw())
