from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from streams import record, same_arrays, short_episode

from curation_ros.configuration import (
    read_reference,
    read_settings,
    share_file,
    topic_map_or_default,
)
from curation_ros.core.decision.rules import RULES
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.episode.topic_map import read_topic_map
from curation_ros.core.errors import ConfigError, EpisodeError
from curation_ros.core.scorers import DEFAULT_SCORERS
from curation_ros.dataset.dataset import Dataset

ROOT = Path(__file__).resolve().parents[2]


def _write(folder: Path, settings: Any) -> Path:
    path = folder / "curation.yaml"
    path.write_text(settings if isinstance(settings, str) else yaml.safe_dump(settings))
    return path


# --- files that we ship -------------------------------------------------------------------------


def test_share_file_is_that_of_the_source_tree() -> None:
    assert share_file("config/topics.yaml") == ROOT / "config" / "topics.yaml"


def test_share_file_that_does_not_exist_is_named() -> None:
    with pytest.raises(ConfigError, match=r"config/none\.yaml"):
        share_file("config/none.yaml")


def test_topic_map_of_an_empty_path_is_that_of_the_libero_robot(tmp_path: Path) -> None:
    assert topic_map_or_default("") == read_topic_map(ROOT / "config" / "topics.yaml")
    with pytest.raises(ConfigError, match=str(tmp_path / "none.yaml")):
        topic_map_or_default(str(tmp_path / "none.yaml"))


def test_shipped_config_has_every_scorer_and_makes_a_curation() -> None:
    curation = read_settings(share_file("config/curation.yaml"), {})
    assert set(curation.scorers) == set(DEFAULT_SCORERS)
    assert curation.rule_scorer in curation.scorers


# --- reading ------------------------------------------------------------------------------------


def test_every_key_of_the_file_is_used(tmp_path: Path) -> None:
    settings = {
        "scorers": ["knn", "smoothness"],
        "rule": "threshold",
        "rule_scorer": "knn",
        "length": "fixed",
        "length_value": 50,
        "scorer_params": {"knn": {"k": 3}},
        "rule_params": {"threshold": -1.5},
        "salvage_margin_s": 0.25,
    }
    assert set(settings) == set(inspect.signature(CurationSettings).parameters)
    curation = read_settings(_write(tmp_path, settings), {})
    assert {key: getattr(curation, key) for key in settings} == {
        **settings,
        "scorers": ("knn", "smoothness"),
    }


def test_no_file_takes_the_defaults() -> None:
    assert read_settings(None, {}) == CurationSettings()
    assert read_settings(None, {"scorers": None, "rule": ""}) == CurationSettings()


def test_override_wins_over_the_file_and_an_empty_one_does_not(tmp_path: Path) -> None:
    path = _write(tmp_path, {"scorers": ["gripper_timing", "length"], "rule": "threshold"})
    settings = read_settings(path, {"scorers": (), "rule": "none"})
    assert (settings.scorers, settings.rule) == (("gripper_timing", "length"), "none")


def test_zero_is_a_value(tmp_path: Path) -> None:
    path = _write(tmp_path, {"salvage_margin_s": 0.5})
    assert read_settings(path, {"salvage_margin_s": 0.0}).salvage_margin_s == 0.0
    assert read_settings(path, {"salvage_margin_s": None}).salvage_margin_s == 0.5


def test_scorer_that_decides_is_added_to_those_that_are_asked_for(tmp_path: Path) -> None:
    path = _write(tmp_path, {"rule": "threshold", "rule_scorer": "knn"})
    assert read_settings(path, {"scorers": ["length"]}).scorers == ("length", "knn")
    assert read_settings(path, {"scorers": ["knn", "length"]}).scorers == ("knn", "length")
    asked = RULES["evidence"].consults
    for scorers in (["length"], ["length", asked[0]]):
        expected = (*scorers, *(n for n in asked if n not in scorers), "gripper_timing")
        assert read_settings(None, {"scorers": scorers}).scorers == expected
    kept = _write(tmp_path, {"scorers": ["length", "gripper_timing"]})
    assert read_settings(kept, {}).scorers == ("length", "gripper_timing")  # as it says
    undecided = read_settings(path, {"scorers": ["length"], "rule": "none"})
    assert undecided.scorers == ("length",)


def test_scorer_that_is_asked_to_decide_is_computed(tmp_path: Path) -> None:
    curation = read_settings(None, {"rule_scorer": "knn_label_free"})
    assert curation.rule_scorer == "knn_label_free"
    assert curation.scorers == (*DEFAULT_SCORERS, "knn_label_free")


def test_parameters_of_the_file_s_rule_are_not_those_of_another(tmp_path: Path) -> None:
    config = tmp_path / "c.yaml"
    config.write_text("rule: threshold\nrule_params: {threshold: 0.5}\n")
    assert read_settings(config, {}).rule_params == {"threshold": 0.5}
    assert read_settings(config, {"rule": "threshold"}).rule_params == {"threshold": 0.5}
    assert read_settings(config, {"rule": "gap"}).rule_params == {}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("scorers: [", "is not YAML"),
        ("a: 2020-13-45", "is not YAML"),
        ("", "expected a mapping, found None"),
        ("- knn", r"expected a mapping, found \['knn'\]"),
        ({"nose": 1}, "unknown key 'nose'; known are scorers, rule, "),
        ({1: 1}, "unknown key 1"),
        ({"scorers": "knn"}, "'scorers' is 'knn', expected a list"),
        ({"scorers": None}, "'scorers' is None, expected a list"),
        ({"scorers": [1]}, r"'scorers' is \[1\], expected names"),
        ({"scorers": [["knn"]]}, "'scorers' is .* expected names"),
        ({"scorers": []}, "expected names, each once"),
        ({"scorers": ["knn", "knn"]}, "expected names, each once"),
        ({"scorers": ["nose"]}, "no scorer 'nose'; there are smoothness"),
        ({"rule": ["threshold"]}, "'rule' is .* expected a name"),
        ({"rule": "nose"}, "no rule 'nose'; there are evidence, threshold"),
        ({"rule_scorer": "nose"}, "rule_scorer 'nose'"),
        ({"length": "nose"}, "length control 'nose' is none of"),
        ({"length": "fixed"}, "'fixed' takes steps"),
        ({"length": "fixed", "length_value": "5"}, "'length_value' is '5', expected a number"),
        ({"length": "fixed", "length_value": True}, "'length_value' is True"),
        ({"scorer_params": 5}, "'scorer_params' is 5, expected a mapping"),
        ({"scorer_params": {"knn": 5}}, "parameters of 'knn' are 5"),
        ({"scorer_params": {"knn": {1: 2}}}, "parameters of 'knn' are {1: 2}"),
        ({"scorer_params": {"knn": {"nose": 2}}}, "'knn' has no parameter 'nose'"),
        ({"scorer_params": {"knn": {"k": "many"}}}, "k is 'many'"),
        ({"rule_params": [1]}, r"'rule_params' is \[1\], expected a mapping"),
        ({"rule_params": {"nose": 1}}, "rule 'evidence'.*nose"),
        ({"rule_params": {"threshold": "high"}}, "rule 'evidence'"),
        ({"salvage_margin_s": "long"}, "expected a number of seconds, or null"),
        ({"salvage_margin_s": -1}, "salvage_margin_s is -1"),
        ({"salvage_margin_s": float("nan")}, "salvage_margin_s is nan"),
        ({"rule_params": {"threshold": float("nan")}}, "expected a finite number"),
    ],
)
def test_config_that_makes_no_sense_is_refused_by_file(
    tmp_path: Path, settings: Any, said: str
) -> None:
    path = _write(tmp_path, settings)
    with pytest.raises(ConfigError, match=said) as refused:
        read_settings(path, {})
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_config_that_cannot_be_read_is_refused_by_name(tmp_path: Path) -> None:
    for path in (tmp_path / "none.yaml", tmp_path):
        with pytest.raises(ConfigError, match=str(path)):
            read_settings(path, {})


def test_mistake_on_the_command_line_is_not_blamed_on_the_file(tmp_path: Path) -> None:
    path = _write(tmp_path, {"scorers": ["gripper_timing"]})
    with pytest.raises(ConfigError, match="no scorer 'nose'") as refused:
        read_settings(path, {"scorers": ["nose"]})
    assert str(path) not in str(refused.value)


# --- references ---------------------------------------------------------------------------------


def test_reference_is_every_bag_of_what_is_named(
    dataset: Dataset, rng: np.random.Generator, tmp_path: Path
) -> None:
    episodes = [short_episode(rng, 3) for _ in range(3)]
    paths = [record(dataset, e) for e in episodes]
    for named in ([dataset.path], paths, [dataset.path, paths[0]]):
        read = {e.id: e for e in read_reference(named, None)}
        assert set(read) == {e.id for e in episodes}
        assert all(same_arrays(read[e.id], e) for e in episodes)
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "empty", tmp_path / "none"):
        with pytest.raises(EpisodeError, match=str(path)):
            read_reference([path], None)
    with pytest.raises(ConfigError, match="no episode"):
        read_reference([], None)
