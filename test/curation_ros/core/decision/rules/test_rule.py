"""The contract of rules, for every one of them; and what the command line makes of them."""

from __future__ import annotations

import inspect

import pytest
from cases import case

from curation_ros.core.decision.rules import RULES, Rule, given_params, make_rule
from curation_ros.core.decision.rules.rule import parameter_names
from curation_ros.core.errors import ConfigError, EpisodeError, NotFittedError

SCORES = {f"e{k}": float(k) for k in range(8)}


def fitted(name: str) -> Rule:
    rule = make_rule(name, "s")
    rule.fit_consulted({})
    if rule.needs == "reference":
        rule.fit([1.0, 1.0, 1.0])
    return rule.fit_dataset(SCORES)


@pytest.mark.parametrize("name", RULES)
def test_rule_describes_itself_and_says_where_it_can_be_used(name: str) -> None:
    rule = make_rule(name, "s")
    assert rule.name == name
    assert rule.needs in ("nothing", "reference", "dataset")
    assert rule.summary
    assert rule.describe()
    assert rule.decides or rule.selects
    assert (rule.decides and rule.selects) or rule.instead


@pytest.mark.parametrize("name", RULES)
def test_parameters_are_keyword_only_and_come_back_as_they_were_given(name: str) -> None:
    kind = RULES[name]
    parameters = inspect.signature(kind).parameters.values()
    assert all(p.kind is p.KEYWORD_ONLY for p in parameters)
    given = {p.name: object() for p in parameters}
    rule = kind(**given)  # nothing is checked on construction
    assert rule.params() == given
    assert rule.fitted() == {}
    assert fitted(name).params() == make_rule(name, "s").params()


@pytest.mark.parametrize("name", RULES)
def test_parameters_of_another_type_are_refused_by_name(name: str) -> None:
    for parameter in parameter_names(RULES[name]):
        for bad in ("nonsense", [1], True):
            if parameter == "scorer" and isinstance(bad, str):
                continue
            rule = RULES[name](**{"scorer": "s", parameter: bad})
            with pytest.raises(ConfigError, match=f"rule '{name}': {parameter} is "):
                rule.check_params()


@pytest.mark.parametrize("name", [n for n in RULES if make_rule(n, "s").needs == "dataset"])
def test_rule_over_a_dataset_needs_one(name: str) -> None:
    with pytest.raises(NotFittedError):
        make_rule(name, "s").verdict(case(1.0))
    with pytest.raises(EpisodeError):
        make_rule(name, "s").fit_dataset({})


@pytest.mark.parametrize("name", [n for n in RULES if RULES[n].reads_scores])
def test_verdict_depends_on_the_score_and_abstention_is_for_review(name: str) -> None:
    rule = fitted(name)
    assert rule.verdict(case(None, why="no fingers"))[0] == "review"
    assert "no fingers" in rule.verdict(case(None, why="no fingers"))[1] or name == "evidence"
    assert rule.verdict(case(1e9))[0] in ("keep", "review")


@pytest.mark.parametrize("name", [n for n in RULES if not RULES[n].reads_scores])
def test_rule_that_reads_no_scores_gives_one_verdict(name: str) -> None:
    rule = fitted(name)
    assert len({rule.verdict(case(score)) for score in (None, 1e9, -1e9)}) == 1


def test_rule_that_does_not_exist_is_refused() -> None:
    for make in (lambda: make_rule("nose", "s"), lambda: given_params("nose")):
        with pytest.raises(ConfigError, match="no rule 'nose'; there are evidence, threshold"):
            make()


def test_parameter_that_does_not_exist_is_refused() -> None:
    with pytest.raises(ConfigError, match="rule 'gap' has no parameter 'value'; it has method"):
        make_rule("gap", "s", {"value": 3})
    with pytest.raises(ConfigError, match="rule 'all' has no parameter 'k'; it has none"):
        make_rule("all", "s", {"k": 3})


@pytest.mark.parametrize(
    ("name", "value", "method", "expected"),
    [
        ("threshold", 0.5, "", {"threshold": 0.5}),
        ("evidence", 0.5, "", {"threshold": 0.5}),
        ("top-k", 3, "", {"value": 3}),
        ("top-fraction", 0.25, "", {"value": 0.25}),
        ("top-k", None, "", {}),
        ("gap", None, "largest-gap", {"method": "largest-gap"}),
        ("all", None, "", {}),
    ],
)
def test_value_and_method_set_the_parameter_that_they_mean(
    name: str, value: float | None, method: str, expected: dict[str, object]
) -> None:
    assert given_params(name, value, method) == expected


@pytest.mark.parametrize("name", ["gap", "none", "all", "decisions"])
def test_value_of_a_rule_that_takes_none_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"rule '{name}' takes no value, found 3"):
        given_params(name, 3.0)


@pytest.mark.parametrize("name", [n for n in RULES if n != "gap"])
def test_method_of_a_rule_that_takes_none_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=f"rule '{name}' takes no method, found 'mixture'"):
        given_params(name, None, "mixture")
