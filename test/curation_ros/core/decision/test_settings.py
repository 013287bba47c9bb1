"""Settings name what exists where they name what does not."""

from __future__ import annotations

import pytest

from curation_ros.core.decision.rules import RULES
from curation_ros.core.decision.settings import CurationSettings
from curation_ros.core.errors import ConfigError
from curation_ros.core.scorers import DEFAULT_SCORERS, SCORERS


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"scorers": ["smoothnes"]}, ["smoothnes", *SCORERS]),
        ({"scorers": []}, ["expected names"]),
        ({"scorers": ["knn", "knn"]}, ["each once"]),
        ({"rule": "vote"}, ["vote", *RULES]),
        ({"rule_scorer": "knn", "scorers": ["length"]}, ["knn", "length"]),
        ({"length": "median"}, ["median", "shortest-reference"]),
        ({"scorer_params": {"nn": {}}}, ["nn", *SCORERS]),
        ({"scorer_params": {"knn": {"n": 3}}}, ["knn", "'n'", "scale_floor"]),
        ({"scorer_params": {"knn": {"k": "5"}}}, ["knn", "k is '5'"]),
        ({"scorer_params": {"smoothness": {"gripper_channel": "False"}}}, ["'False'"]),
        ({"scorer_params": {"entropy": {"over": "x"}}}, ["over", "values"]),
        ({"scorers": ["gripper_timing"], "scorer_params": {"knn": {}}}, ["knn"]),
        ({"rule_params": {"limit": 3}}, ["'limit'", "threshold", "false_alarm"]),
        ({"rule": "gap", "rule_params": {"value": 3}}, ["rule 'gap'", "'value'", "has method"]),
        ({"rule_params": {"threshold": "high"}}, ["threshold"]),
    ],
)
def test_bad_configuration_names_what_exists(config: dict[str, object], words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        CurationSettings(**config)  # type: ignore[arg-type]
    for word in words:
        assert word in str(caught.value)


def test_rule_that_only_selects_is_refused() -> None:
    for name in ("all", "decisions"):
        with pytest.raises(ConfigError, match=f"rule '{name}': .*it is for curation select"):
            CurationSettings(rule=name)


def test_lists_are_as_good_as_tuples_and_belong_to_the_settings_alone() -> None:
    names, params = list(DEFAULT_SCORERS), {"knn": {"k": 3}}
    settings = CurationSettings(scorers=names, scorer_params=params)
    assert settings == CurationSettings(scorer_params={"knn": {"k": 3}})
    names.clear()
    params["knn"]["k"] = 4
    assert settings.scorers == DEFAULT_SCORERS
    assert settings.make_scorer("knn").params()["k"] == 3
