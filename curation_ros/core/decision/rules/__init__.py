"""Rules: from scores to verdicts. `RULES` is the only list of them.

`curation score --rule` and `curation select --rule` take their rules from here. A rule that both
can use gives both the same answer on the same scored episodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from curation_ros.core.decision.rules.best import TopFraction, TopK
from curation_ros.core.decision.rules.evidence import Evidence
from curation_ros.core.decision.rules.gap import Gap
from curation_ros.core.decision.rules.rule import Case, Rule, parameter_names
from curation_ros.core.decision.rules.threshold import Threshold
from curation_ros.core.decision.rules.without_scores import AllEpisodes, LoggedDecisions, NoRule
from curation_ros.core.errors import ConfigError

__all__ = ["RULES", "Case", "Rule", "given_params", "make_rule"]

#: Name -> class. The only list of rules.
RULES: dict[str, type[Rule]] = {
    "evidence": Evidence,
    "threshold": Threshold,
    "top-fraction": TopFraction,
    "top-k": TopK,
    "gap": Gap,
    "none": NoRule,
    "decisions": LoggedDecisions,
    "all": AllEpisodes,
}


def make_rule(name: str, scorer: str, params: Mapping[str, Any] | None = None) -> Rule:
    """A rule, not fitted, with its hyper-parameters checked.

    Args:
        name: one of RULES.
        scorer: name of the scorer that decides.
        params: hyper-parameters that are not the defaults.

    Raises:
        ConfigError: if there is no such rule, or a parameter makes no sense.
    """
    kind = _kind(name)
    known = [n for n in parameter_names(kind) if n != "scorer"]
    for key in params or {}:
        if key not in known:
            raise ConfigError(
                f"rule {name!r} has no parameter {key!r}; it has {', '.join(known) or 'none'}"
            )
    rule = kind(scorer=scorer, **(params or {}))
    rule.check_params()
    return rule


def given_params(name: str, value: float | None = None, method: str = "") -> dict[str, Any]:
    """Hyper-parameters of a rule from `--value` and `--method`.

    Args:
        name: one of RULES.
        value: a threshold, share or number; None: not given.
        method: how `gap` separates groups; empty: not given.

    Raises:
        ConfigError: if there is no such rule, or it takes no value or no method.
    """
    kind = _kind(name)
    params: dict[str, Any] = {}
    if value is not None:
        if not kind.value_param:
            raise ConfigError(f"rule {name!r} takes no value, found {value:g}")
        params[kind.value_param] = value
    if method:
        if "method" not in parameter_names(kind):
            raise ConfigError(f"rule {name!r} takes no method, found {method!r}")
        params["method"] = method
    return params


def _kind(name: str) -> type[Rule]:
    if name not in RULES:
        raise ConfigError(f"no rule {name!r}; there are {', '.join(RULES)}")
    return RULES[name]
